"""Accumulators, against the dense Gaussian law of sums between observations.

The reference adds up what each step brings between two observations; nothing in it is reset.
"""

import pickle

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from scipy.stats import multivariate_normal, norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.pymc_model.step_refinement import path_eigenvalues
from tests.filters.test_ekf_states import assert_drawn_from
from tests.states.models import posterior

pytestmark = pytest.mark.usefixtures("interpreted")

STEPS = np.array([0, 3, 4, 8])  # step 0 too; irregular
DATA = np.array([0.1, 1.9, np.nan, 2.5])  # a missing row ends a sum as well
PUSH = np.array([0.1, 0.2, -0.3, 0.4, 0.1, 0.0, 0.2, 0.3, 0.5, -0.1, 0.2, 0.1, 0.4, 0.2])
OTHER_STEPS = np.array([2, 5, 6, 9])
A, Q, R = 0.8, np.diag([1.0, 0.4]), 0.2
M0, P0 = np.array([0.5, 0.3]), np.diag([1.0, 0.2])
FUTURE = np.array([10, 13])
RATE = 1e-3  # of right implementations fail each statistical test


def rate_and_total(**changes):
    """A rate, pushed by an input, and its noisy sum, which alone is seen."""
    settings = dict(
        transition=lambda x, q, u, a: [a * x[0] + u[0] + q[0], x[1] + x[0] + 0.3 * q[1]],
        process_noise=Q,
        observation=lambda x: [x[1]],
        observation_noise=[[R]],
        initial_mean=M0,
        initial_cov=P0,
        states=["rate", "total"],
        inputs=["push"],
        accumulators=["total"],
        resets="row",
    )
    return psf.StateSpaceModel(**settings | changes)


SYSTEM = rate_and_total()


def path(start, noise, push, steps):
    """Rates and totals (K + 1, 2): each total is a sum since the last observation before it."""
    rates, brought = [start[0]], []
    for u, q in zip(push, noise, strict=True):
        brought.append(rates[-1] + 0.3 * q[1])
        rates.append(A * rates[-1] + u + q[0])
    totals = []
    for k in range(len(rates)):
        earlier = [s for s in steps if s < k]
        totals.append(sum(brought[max(earlier, default=0) : k]) + (not earlier) * start[1])
    return np.column_stack([rates, totals])


def law(rows, steps, push=PUSH):
    """Mean (2 R,) and covariance of the states at ``rows``, before any datum: column by column."""
    K = max(rows)
    push = np.asarray(push)[:K]
    noises = np.linalg.cholesky(np.kron(np.eye(K), Q))
    columns = [
        path([0.0, 0.0], c.reshape(K, 2), 0 * push, steps)[rows].ravel() for c in noises.T
    ] + [path(c, np.zeros((K, 2)), 0 * push, steps)[rows].ravel() for c in np.sqrt(P0)]
    gain = np.column_stack(columns)
    return path(M0, np.zeros((K, 2)), push, steps)[rows].ravel(), gain @ gain.T


def given_data(rows, steps=STEPS, observed=DATA):
    """Mean and covariance of the states at ``rows`` given the record, and its log-density."""
    known = np.isfinite(observed)
    seen, d = steps[known], observed[known]
    all_rows = np.concatenate([rows, seen])
    mean, cov = law(all_rows, np.union1d(steps, rows[rows > steps[-1]]))
    n = 2 * len(rows)
    show = np.arange(n, len(mean))[1::2]
    spread = cov[np.ix_(show, show)] + R * np.eye(len(d))
    gain = np.linalg.solve(spread, cov[show, :n]).T
    log_density = multivariate_normal.logpdf(d, mean[show], spread)
    return mean[:n] + gain @ (d - mean[show]), cov[:n, :n] - gain @ cov[show, :n], log_density


def model_of(filter=None, steps=STEPS, observed=DATA, inputs=PUSH):
    with pm.Model() as model:
        pm.Normal("a", A)
        filter = filter or psf.EKF()
        psf.StateSpace("d", SYSTEM, filter, steps=steps, observed=observed, inputs=inputs)
    return model


@pytest.mark.parametrize("filter", [psf.EKF(), psf.UKF(), psf.IPLF()])
def test_the_likelihood_is_that_of_the_sums(filter):
    terms = psf.log_likelihood(SYSTEM, filter, {"a": A}, DATA, steps=STEPS, inputs=PUSH)
    np.testing.assert_allclose(terms.sum(), given_data(STEPS)[2], rtol=1e-10)
    assert terms.ravel()[2] == 0.0


def test_a_particle_filter_estimates_it_without_bias():
    terms = psf.log_likelihood(
        SYSTEM, psf.BootstrapPF(300), {"a": np.full(400, A)}, DATA, steps=STEPS, inputs=PUSH,
        seed=np.arange(400),
    )  # fmt: skip
    ratio = np.exp(terms.sum(axis=-1) - given_data(STEPS)[2])
    assert abs(ratio.mean() - 1.0) < norm.isf(RATE / 2) * ratio.std() / 20


@pytest.mark.slow
def test_other_ensembles_come_close():
    """GuidedPF is exact for a linear system, the others in the limit of many members."""
    for filter, tolerance in (
        (psf.GuidedPF(100), 1e-10),
        (psf.EnKF(20_000), 0.1),
        (psf.PFEnKF(20_000), 0.1),
    ):
        terms = psf.log_likelihood(SYSTEM, filter, {"a": A}, DATA, steps=STEPS, inputs=PUSH)
        assert abs(terms.sum() - given_data(STEPS)[2]) < tolerance


def test_a_grid_is_set_to_one_point():
    """A single state that sums noise: independent Gaussian sums."""
    system = psf.StateSpaceModel(
        transition=lambda x, q: [x[0] + 0.5 + q[0]], process_noise=[[0.3]],
        observation=lambda x: [x[0]], observation_noise=[[0.2]],
        initial_mean=[0.3], initial_cov=[[0.2]], accumulators=["x0"], resets="row",
    )  # fmt: skip
    lengths = np.diff(STEPS)
    means, variances = np.r_[0.3, 0.5 * lengths], np.r_[0.2, 0.3 * lengths] + 0.2
    exact = np.nan_to_num(norm.logpdf(DATA, means, np.sqrt(variances)))
    for filter in (psf.EKF(), psf.GridFilter(tolerance=1e-8)):
        terms = psf.log_likelihood(system, filter, {}, DATA, steps=STEPS)
        np.testing.assert_allclose(terms.ravel(), exact, atol=1e-7)


@pytest.mark.parametrize("at", ["observations", "steps"])
def test_smoothed_states_are_the_posterior_of_the_sums(at):
    found = psf.smoothed_states(posterior(a=np.full((1, 2), A)), model_of(), at=at, random_seed=1)
    rows = STEPS if at == "observations" else np.arange(9)
    mean, cov, _ = given_data(rows)
    group = found["smoothed_states"]
    np.testing.assert_allclose(group["d_mean"].values[0, 0].ravel(), mean, rtol=1e-8)
    np.testing.assert_allclose(
        group["d_sd"].values[0, 0].ravel(), np.sqrt(cov.diagonal()), atol=1e-7
    )


def test_the_gradient_and_a_record_with_other_steps():
    """Steps, data and inputs are shared data; a record of other steps resets at those."""
    model = model_of(
        steps=pytensor.shared(STEPS), observed=pytensor.shared(DATA[:, None]),
        inputs=pytensor.shared(PUSH[:, None]),
    )  # fmt: skip
    density, gradient = model.compile_fn(model.logp(vars=[model["d"]])), model.compile_dlogp()
    np.testing.assert_allclose(density({"a": A}), given_data(STEPS)[2], rtol=1e-10)
    whole = model.compile_logp()
    slope = (whole({"a": A + 1e-5}) - whole({"a": A - 1e-5})) / 2e-5
    np.testing.assert_allclose(gradient({"a": A}), slope, rtol=1e-6)


def test_set_data_with_other_steps():
    for inputs in (PUSH, None):
        system = SYSTEM
        if inputs is None:
            system = rate_and_total(
                transition=lambda x, q, a: [a * x[0] + q[0], x[1] + x[0] + 0.3 * q[1]], inputs=None
            )
        with pm.Model() as model:
            steps = pm.Data("steps", STEPS)
            observed = pm.Data("observed", np.nan_to_num(DATA)[:, None])
            psf.StateSpace(
                "d", system, psf.EKF(), params={"a": A}, steps=steps, observed=observed,
                inputs=inputs,
            )  # fmt: skip
            density = model.compile_fn(model.logp())
            push = PUSH if inputs is not None else 0.0 * PUSH
            for at in (STEPS, OTHER_STEPS, OTHER_STEPS[:2]):
                data = np.linspace(0.0, 2.0, at.size)
                with model:
                    pm.set_data({"steps": at, "observed": data[:, None]}, coords={"d_time": at})
                mean, cov = law(at, at, push)
                exact = multivariate_normal.logpdf(
                    data, mean[1::2], cov[1::2, 1::2] + R * np.eye(at.size)
                )
                np.testing.assert_allclose(density({}), exact, rtol=1e-10)


@pytest.mark.parametrize("inputs", [None, PUSH])
def test_forecasts_go_on_from_zero_and_sum_between_the_steps_asked_for(inputs):
    draws = posterior(a=np.full((2, 2000), A))
    future = psf.forecast(draws, model_of(), steps=FUTURE, inputs=inputs, random_seed=1)
    found = future["predictions"]["d_states"].values.reshape(4000, 4)
    mean, cov, _ = given_data(FUTURE)
    assert_drawn_from(found, mean, cov, RATE)


def test_simulations_and_predictive_draws_have_the_law_of_the_sums():
    one = psf.simulate(SYSTEM, {"a": A}, steps=STEPS, inputs=PUSH, random_seed=2)
    states = one["states"].values
    rows = np.arange(1, 9)
    expected = (
        states[0, 1],
        *(states[k, 1] * (k not in STEPS) + states[k, 0] for k in range(8)),
    )  # without the total's own noise
    assert np.abs(states[:, 1] - expected)[rows].max() < 5 * 0.3 * np.sqrt(0.4)
    with model_of():
        draws = pm.sample_posterior_predictive(
            posterior(a=np.full((2, 2000), A)), random_seed=1, progressbar=False
        )
    mean, cov = law(STEPS, STEPS)
    seen = draws["posterior_predictive"]["d"].values.reshape(4000, 4)
    assert_drawn_from(seen, mean[1::2], cov[1::2, 1::2] + R * np.eye(4), RATE)


def test_free_runs_sum_between_their_own_steps():
    draws, later = posterior(a=np.full((1, 2), A)), np.array([4, 6])
    for steps, options in ((STEPS, {}), (later, {"steps": later})):
        found = psf.free_run(draws, model_of(), random_seed=1, **options)["free_run"]
        np.testing.assert_allclose(
            found["d_states"].values[0, 0].ravel(), law(steps, steps)[0], rtol=1e-10
        )


def test_the_inputs_remain_the_users():
    assert (SYSTEM.inputs, SYSTEM.n_inputs, SYSTEM.accumulators) == (("push",), 1, ("total",))
    copy = pickle.loads(pickle.dumps(SYSTEM))
    assert copy == SYSTEM
    assert copy.fingerprint == SYSTEM.fingerprint
    assert rate_and_total(accumulators=[]).fingerprint != SYSTEM.fingerprint
    with pytest.raises(
        psf.errors.ModelError, match=r"shape \(steps, 1\), a column for each of \['push'\]"
    ):
        psf.simulate(SYSTEM, {"a": A}, steps=STEPS, inputs=np.zeros((14, 2)))
    with pytest.raises(psf.errors.ModelError, match=r"inputs must have at least 8 rows"):
        model_of(inputs=PUSH[:6])
    found = psf.filter_diagnostics(
        posterior(a=np.full((1, 3), A)), model_of(), random_seed=1, progressbar=False
    )["filter_diagnostics"]
    assert list(found["input"].values) == ["push"]


def test_names_that_are_no_states_are_refused():
    message = r"accumulators must name states, \['rate', 'total'\], got \['cases'\]"
    with pytest.raises(psf.errors.ModelError, match=message):
        rate_and_total(accumulators=["cases"])
    with pytest.raises(
        psf.errors.ModelError, match="accumulators must be a list of names, got 'total'"
    ):
        rate_and_total(accumulators="total")
    with pytest.raises(psf.errors.ModelError, match="accumulators must be distinct names"):
        rate_and_total(accumulators=["total", "total"])


def test_a_reset_happens_once_in_a_step_of_substeps_and_is_no_overshoot():
    integrator = psf.EulerMaruyama(
        lambda x, k: [-k * x[0], k * x[0]], [[0.0], [0.0]], dt=1.0, substeps=4
    )
    system = psf.StateSpaceModel(
        integrator, observation=lambda x: [x[1]], observation_noise=[[1.0]],
        initial_mean=[1.0, 0.0], initial_cov=np.zeros((2, 2)), accumulators=["x1"],
    )  # fmt: skip
    found = psf.simulate(system, {"k": 0.4}, steps=[1, 2, 3], noise=False)["states"].values
    np.testing.assert_allclose(found[:, 0], 0.9 ** (4 * np.arange(4)))
    np.testing.assert_allclose(found[1:, 1], -np.diff(found[:, 0]))
    refined = system.with_integrator(integrator.refined())
    assert refined.accumulators == ("x1",)
    ones = np.ones((1, 3, 1))
    [eigenvalues] = path_eigenvalues(
        [system], np.array([[0.4]]), np.array([[1, 2, 3]]), ones, np.zeros(1)
    )
    assert (eigenvalues.real > 0.89).all()


def test_a_carried_state_may_be_an_accumulator():
    system = psf.StateSpaceModel(
        lambda x, q, a: [a * x[0] + q[0], x[1] + pt.switch(x[0] > 0, 1.0, 0.0)],
        process_noise=[[1.0]], observation=lambda x: [x[0] + x[1]], observation_noise=[[1.0]],
        initial_mean=[0.0, 0.0], initial_cov=np.diag([1.0, 0.0]), states=["x", "ups"],
        carried=["ups"], accumulators=["ups"],
    )  # fmt: skip
    states = psf.simulate(system, {"a": 0.5}, steps=[3, 6, 9], random_seed=1)["states"].values
    ups = states[:-1, 0] > 0
    assert [states[k, 1] for k in (3, 6, 9)] == [ups[k - 3 : k].sum() for k in (3, 6, 9)]
    terms = psf.log_likelihood(system, psf.BootstrapPF(64), {"a": 0.5}, [1.0, 2.0], steps=[3, 6])
    assert np.isfinite(terms).all()


def test_counts_that_jump_are_summed_too():
    system = psf.StateSpaceModel(
        lambda x, q: [x[0] - q[0], x[1] + q[0]],
        process_dist=lambda x: [pm.Binomial.dist(x[0], 0.1)],
        observation_dist=lambda x: [pm.Poisson.dist(x[1] + 0.1)],
        initial_mean=[1000.0, 0.0], initial_cov=np.zeros((2, 2)), accumulators=["x1"],
    )  # fmt: skip
    states = psf.simulate(system, {}, steps=[3, 4, 9], random_seed=1)["states"].values
    left = -np.diff(states[[0, 3, 4, 9], 0])
    assert states[[3, 4, 9], 1].tolist() == left.tolist()
