"""Simulated paths: exact where nothing is random, right in law where something is."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf

# Every statistical check below is at 5 standard errors: one false alarm in two million.
ERRORS = 5.0


def deterministic(**changes):
    """x' = a x + u + t, seen with noise of next to no size."""
    arguments = dict(
        transition=lambda x, u, t, a: [a * x[0] + u[0] + t],
        observation=lambda x: [x[0]],
        observation_noise=[[1e-24]],
        initial_mean=[1.0],
        initial_cov=[[0.0]],
        dt=0.5,
        inputs=["force"],
        states=["place"],
        observables=["sensor"],
    )
    return psf.StateSpaceModel(**(arguments | changes))


def test_row_k_of_the_inputs_holds_during_step_k():
    inputs, t0, a = np.array([10.0, 20.0, 30.0]), 100.0, 0.9
    path = psf.simulate(deterministic(), {"a": a}, steps=[1, 3], inputs=inputs, t0=t0)
    x = [1.0]
    for k in range(3):
        x.append(a * x[k] + inputs[k] + t0 + 0.5 * k)
    np.testing.assert_allclose(path.states.values[:, 0], x, rtol=1e-14)
    np.testing.assert_allclose(path.observations.values[:, 0], [x[1], x[3]], rtol=1e-11)


def test_an_observation_at_step_k_sees_the_inputs_and_time_of_step_k():
    system = deterministic(
        transition=lambda x: x, observation=lambda x, u, t: [x[0] + 10 * u[0] + 1000 * t]
    )
    path = psf.simulate(system, {}, steps=[0, 3], inputs=np.array([1.0, 2.0, 3.0, 4.0]), t0=2.0)
    np.testing.assert_allclose(
        path.observations.values[:, 0], [1 + 10 + 2000, 1 + 40 + 3500], rtol=1e-12
    )


def test_dimensions_and_coordinates():
    path = psf.simulate(deterministic(), {"a": 0.5}, steps=[0, 2, 4], inputs=np.zeros(4), t0=1.0)
    assert dict(path.sizes) == {"step": 5, "state": 1, "obs": 3, "observable": 1}
    assert path.states.dims == ("step", "state")
    assert path.observations.dims == ("obs", "observable")
    assert path.state.values.tolist() == ["place"]
    assert path.observable.values.tolist() == ["sensor"]
    np.testing.assert_allclose(path.time, 1.0 + 0.5 * np.arange(5))


def test_steps_and_times_are_the_same_grid():
    system, inputs = deterministic(), np.arange(6.0)
    by_steps = psf.simulate(system, {"a": 0.5}, steps=[2, 5], inputs=inputs, t0=3.0, random_seed=1)
    by_times = psf.simulate(
        system, {"a": 0.5}, times=[4.0, 5.5 + 4e-7], inputs=inputs, t0=3.0, random_seed=1
    )
    assert by_steps.identical(by_times)


def test_a_seed_gives_the_same_draw_and_another_seed_another():
    system = deterministic(observation_noise=[[1.0]])
    arguments = dict(steps=[1, 2], inputs=np.zeros(2))

    def draw(seed):
        return psf.simulate(system, {"a": 0.5}, random_seed=seed, **arguments).observations.values

    assert (draw(5) == draw(5)).all()
    assert (draw(5) == draw(np.random.default_rng(5))).all()
    assert (draw(5) != draw(6)).all()
    assert (draw(None) != draw(None)).all()


def test_moments_of_a_linear_system():
    """Stationary from the start: every state has the variance q / (1 - a^2)."""
    a, q, r = 0.8, [[0.36, 0.1], [0.1, 0.2]], [[0.5, 0.2], [0.2, 0.4]]
    stationary = np.array(q) / (1 - a * a)
    system = psf.StateSpaceModel(
        transition=lambda x, q: a * x + q,
        process_noise=q,
        observation=lambda x: x,
        observation_noise=r,
        initial_mean=[0.0, 0.0],
        initial_cov=stationary,
    )
    n = 200_000
    path = psf.simulate(system, {}, steps=np.arange(n + 1), random_seed=8)
    x, d = path.states.values, path.observations.values

    # The effective number of independent pairs for products of an AR(1): n (1 - a^2) / (1 + a^2).
    n_free = n * (1 - a * a) / (1 + a * a)
    scale = np.sqrt((stationary**2 + np.outer(np.diag(stationary), np.diag(stationary))) / n_free)
    assert (abs(x.T @ x / n - stationary) < ERRORS * scale).all()

    shocks, noises = x[1:] - a * x[:-1], d - x
    for values, cov in ((shocks, np.array(q)), (noises, np.array(r))):
        error = np.sqrt((cov**2 + np.outer(np.diag(cov), np.diag(cov))) / len(values))
        assert (abs(values.T @ values / len(values) - cov) < ERRORS * error).all()
        assert (abs(values.mean(0)) < ERRORS * np.sqrt(np.diag(cov) / len(values))).all()
    # shocks and noises belong together nowhere
    cross = shocks.T @ noises[1:] / n
    assert (abs(cross) < ERRORS * np.sqrt(np.outer(np.diag(q), np.diag(r)) / n)).all()


def test_initial_state_is_drawn_from_its_covariance():
    cov = np.array([[0.5, 0.3], [0.3, 0.18]])  # singular: the states move together
    system = psf.StateSpaceModel(
        transition=lambda x: x,
        observation=lambda x: [x[0]],
        observation_noise=[[1.0]],
        initial_mean=[1.0, 2.0],
        initial_cov=cov,
    )
    rng, n = np.random.default_rng(2), 800
    x = np.array([
        psf.simulate(system, {}, steps=[0], random_seed=rng).states.values[0] for _ in range(n)
    ])  # fmt: skip
    np.testing.assert_allclose(x[:, 1] - 2.0, 0.6 * (x[:, 0] - 1.0), atol=1e-7)
    assert abs(x[:, 0].mean() - 1.0) < ERRORS * np.sqrt(0.5 / n)
    assert abs(x[:, 0].var() - 0.5) < ERRORS * 0.5 * np.sqrt(2 / n)


def test_counts_are_drawn_from_the_users_distributions():
    system = psf.StateSpaceModel(
        transition=lambda x: x,
        observation_dist=lambda x, c: [
            pm.Poisson.dist(mu=pt.exp(c + x[0])), pm.Normal.dist(x[0], 0.5),
        ],
        initial_mean=[0.3],
        initial_cov=[[0.0]],
    )  # fmt: skip
    n = 40_000
    path = psf.simulate(system, {"c": 1.0}, steps=np.arange(n), random_seed=3)
    counts, normals = path.observations.values.T
    mu = np.exp(1.3)
    assert (counts == np.round(counts)).all()
    assert abs(counts.mean() - mu) < ERRORS * np.sqrt(mu / n)
    # the variance of a Poisson sample variance: (mu + 2 mu^2) / n
    assert abs(counts.var() - mu) < ERRORS * np.sqrt((mu + 2 * mu * mu) / n)
    assert abs(normals.mean() - 0.3) < ERRORS * 0.5 / np.sqrt(n)
    assert abs(np.corrcoef(counts, normals)[0, 1]) < ERRORS / np.sqrt(n)
    again = psf.simulate(system, {"c": 1.0}, steps=np.arange(n), random_seed=3)
    assert (again.observations.values == path.observations.values).all()


def test_general_noise_enters_where_it_is_written():
    system = deterministic(
        transition=lambda x: x, inputs=None, initial_mean=[2.0],
        observation=lambda x, e: [x[0] * pt.exp(e[0])], observation_noise=[[0.09]],
    )  # fmt: skip
    n = 40_000
    d = psf.simulate(system, {}, steps=np.arange(n), random_seed=4).observations.values[:, 0]
    logs = np.log(d / 2.0)
    assert abs(logs.mean()) < ERRORS * 0.3 / np.sqrt(n)
    assert abs(logs.var() - 0.09) < ERRORS * 0.09 * np.sqrt(2 / n)


def test_a_density_with_an_observation_is_simulated_by_the_observation():
    system = deterministic(
        transition=lambda x: x, inputs=None, observation_logp=lambda d, x: -abs(d[0] - x[0])
    )
    path = psf.simulate(system, {}, steps=[0, 1], random_seed=1)
    np.testing.assert_allclose(path.observations.values, 1.0, rtol=1e-10)


@pytest.mark.parametrize("t0", [0.0, -3.0, 1e4])
def test_nearest_steps_round_to_the_grid(t0):
    steps = np.array([0, 3, 7, 1000])
    jitter = np.array([0.0, 0.4, -0.4, 0.2]) * 0.01
    assert psf.nearest_steps(t0 + steps * 0.01 + jitter, 0.01, t0=t0).tolist() == steps.tolist()


def test_times_lie_on_the_grid_to_a_millionth_of_a_step():
    system = deterministic()
    arguments = dict(params={"a": 0.5}, inputs=np.zeros(9))
    psf.simulate(system, times=[0.5 * (4 + 9e-7)], **arguments)
    with pytest.raises(psf.errors.ModelError, match=r"off the grid.*nearest_steps"):
        psf.simulate(system, times=[0.5 * (4 + 2e-6)], **arguments)


# Without noise.


def noisy(**changes):
    """The same with noise everywhere, seen beside inputs and time."""
    return deterministic(
        **dict(
            transition=lambda x, q, u, t, a: [a * x[0] + u[0] + t + q[0]],
            process_noise=[[4.0]],
            observation=lambda x, u, t: [x[0] + 10 * u[0] + 1000 * t],
            observation_noise=[[9.0]],
            initial_cov=[[2.0]],
        )
        | changes
    )


def test_without_noise_every_noise_is_zero():
    inputs, steps = np.array([10.0, 20.0, 30.0, 40.0]), [1, 3]
    path = psf.simulate(noisy(), {"a": 0.9}, steps=steps, inputs=inputs, t0=100.0, noise=False)
    x = [1.0]
    for k in range(3):
        x.append(0.9 * x[k] + inputs[k] + 100.0 + 0.5 * k)
    seen = [x[k] + 10 * inputs[k] + 1000 * (100.0 + 0.5 * k) for k in steps]
    np.testing.assert_allclose(path.states.values[:, 0], x, rtol=1e-14)
    np.testing.assert_allclose(path.observations.values[:, 0], seen, rtol=1e-14)


def test_without_noise_an_observation_is_that_at_no_noise_or_its_mean():
    """exp(e) at e = 0, not its mean exp(0.045); and the means of distributions, not rounded."""
    settings = dict(transition=lambda x: x, inputs=None, initial_mean=[0.3], process_noise=None)
    general = noisy(
        **settings, observation=lambda x, e: [x[0] * pt.exp(e[0])], observation_noise=[[0.09]]
    )
    counted = noisy(
        **settings, observation=None, observation_noise=None, observables=None,
        observation_dist=lambda x, c: [
            pm.Poisson.dist(mu=pt.exp(c + x[0])), pm.Normal.dist(x[0], c),
            pm.ZeroInflatedPoisson.dist(psi=0.25, mu=c), pm.Gamma.dist(alpha=c, beta=2.0),
        ],
    )  # fmt: skip
    path = psf.simulate(general, {}, steps=[0], noise=False)
    assert path.observations.item() == 0.3
    path = psf.simulate(counted, {"c": 1.0}, steps=[0, 2], noise=False)
    np.testing.assert_allclose(path.observations, [[np.exp(1.3), 0.3, 0.25, 0.5]] * 2, rtol=1e-12)


def test_a_distribution_without_a_mean_has_no_simulation_without_noise():
    system = noisy(
        observation=None, observation_noise=None,
        observation_dist=lambda x: [pm.Cauchy.dist(x[0], 1.0)],
    )  # fmt: skip
    arguments = dict(steps=[0], inputs=[0.0])
    assert psf.simulate(system, {"a": 0.5}, **arguments).observations.notnull().all()
    with pytest.raises(
        psf.errors.ModelError, match=r"the mean of every .*got cauchy_rv.*use noise=True"
    ):
        psf.simulate(system, {"a": 0.5}, noise=False, **arguments)
    with pytest.raises(psf.errors.ModelError, match="noise must be True or False, got 0"):
        psf.simulate(system, {"a": 0.5}, noise=0, **arguments)


def test_observations_that_are_not_finite_are_not_taken_for_missing_ones():
    system = psf.StateSpaceModel(
        transition=lambda x: [x[0] ** 2],
        observation=lambda x: [x[0]],
        observation_noise=lambda v: [[v]],
        initial_mean=lambda start: [start],
        initial_cov=[[0.0]],
    )
    at = {"steps": [0, 2, 9, 10, 12], "t0": 5.0, "random_seed": 1}
    with pytest.warns(
        psf.errors.ModelWarning, match=r"^5 of 5 .* in row 0, at time 5.0: .* invalid"
    ):
        psf.simulate(system, {"v": -1.0, "start": 0.5}, **at)
    with pytest.warns(psf.errors.ModelWarning, match=r"^2 of 5 .* in row 3, at time 15.0: .* over"):
        psf.simulate(system, {"v": 1.0, "start": 3.0}, **at)
    panel = {"panel": ["A", "A", "B", "B"], "steps": [0, 9, 0, 10], "random_seed": 1}
    with pytest.warns(psf.errors.ModelWarning, match="^1 of 4 .* in row 3, of record 'B'"):
        psf.simulate(system, {"v": 1.0, "start": 3.0}, **panel)
