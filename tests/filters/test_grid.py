"""The point-mass filter against exact answers: Kalman's, and sums on grids of the tests' own."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy.stats import norm, poisson

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.filters.outcomes import (
    GRID_TOO_LARGE,
    INITIAL_COV,
    NO_PROCESS_NOISE,
    OBSERVATION_NOISE,
    STATE_NOT_FINITE,
    TOO_FAR,
    Failure,
)
from pymc_statespace_filters.pymc_model.inspection import exactness, noise_seeds
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references.records import (
    BROAD_DOUBLE_WELL,
    DOUBLE_WELL,
    PRECISE_DOUBLE_WELL,
    DoubleWell,
    broad_double_well,
    double_well,
    double_well_with_surprises,
)
from tests.systems import DOUBLE_WELL_SYSTEM, double_well_parameters, forced

STEPS = np.array([0, 1, 2, 5, 9, 30, 31, 40, 41, 100])


def grid_terms(reference, observed, steps=STEPS, tolerance=1e-8):
    """Terms of a double well, or of one without its cubic force: a linear system."""
    parameters = double_well_parameters(reference)
    filter = psf.GridFilter(tolerance=tolerance)
    return psf.log_likelihood(DOUBLE_WELL_SYSTEM, filter, parameters, observed, steps=steps)


def kalman_terms(reference, observed, steps=STEPS):
    return kalman_log_likelihood(
        [[1.0 + reference.alpha * reference.dt]],
        [[reference.sigma**2 * reference.dt]],
        [[1.0]],
        reference.R,
        [reference.initial_mean],
        [[reference.initial_var]],
        steps=steps,
        observed=np.reshape(observed, (-1, 1)),
    )


def linear(growth, noise, sensor, spread, start=0.4):
    """x' = growth x + N(0, noise^2), seen with an error of this deviation."""
    dt = DoubleWell.dt
    return DoubleWell(
        alpha=(growth - 1.0) / dt,
        beta=0.0,
        sigma=noise / np.sqrt(dt),
        noise_var=sensor**2,
        initial_mean=start,
        initial_var=spread**2,
    )


def simulated(reference, steps=STEPS, seed=0):
    """A record with its fourth row missing."""
    rng = np.random.default_rng(seed)
    x, observed = reference.start(1, rng), []
    for k in range(steps[-1] + 1):
        if k in steps:
            observed.append(x[0, 0] + np.sqrt(reference.noise_var) * rng.standard_normal())
        x = reference.move(x, rng)
    return np.where(np.arange(len(steps)) == 3, np.nan, observed)


@pytest.mark.parametrize("growth", [0.9, 1.0, 0.2, -0.7, 1.03])
@pytest.mark.parametrize("noise", [1.0, 0.05])
def test_it_is_the_kalman_filter_on_linear_systems(growth, noise):
    """Sensors far finer than the noise of a step, starts known and far broader than it."""
    for sensor in (1.0, 0.3, 0.03, 0.003):
        for spread in (0.0, 1e-20, 1e-6, 0.3, 5.0):
            system = linear(growth, noise, sensor, spread)
            observed = simulated(system)
            terms = grid_terms(system, observed)
            exact = kalman_terms(system, observed)
            np.testing.assert_allclose(terms, exact, rtol=0.0, atol=1e-9)
            assert terms[3] == 0.0


@pytest.mark.parametrize("spread", [0.0, 1e-20])
@pytest.mark.parametrize("start", [0.0, -1e6])
def test_a_known_start_may_be_zero_or_far_off(start, spread):
    system = linear(0.9, 1.0, 0.3, spread, start)
    observed = simulated(system)
    np.testing.assert_allclose(
        grid_terms(system, observed), kalman_terms(system, observed), rtol=0.0, atol=1e-7
    )


@pytest.mark.parametrize("first_step", [0, 4])
@pytest.mark.parametrize("spread", [0.0, 0.7])
def test_inputs_and_time(first_step, spread):
    steps = first_step + np.array([0, 2, 3, 7])
    inputs = np.random.default_rng(4).normal(size=steps[-1] + 1)
    observed = np.array([0.7, -0.4, np.nan, 1.1])
    terms = psf.log_likelihood(
        DRIVEN, psf.GridFilter(), {"spread": spread}, observed, steps=steps, inputs=inputs, t0=0.3
    )
    k = np.arange(steps[-1])
    force = inputs[k] + np.sin(0.3 + 0.5 * k)
    exact = kalman_log_likelihood(
        [[0.8]],
        [[0.3**2 + 0.2**2]],
        [[1.0]],
        [[0.1]],
        [0.5],
        [[spread**2]],
        steps=steps,
        observed=(observed - 0.5 * inputs[steps])[:, None],
        forcing=force[:, None],
    )
    np.testing.assert_allclose(terms, exact, rtol=0.0, atol=1e-9)


DRIVEN = psf.StateSpaceModel(
    lambda x, q, u, t: [0.8 * x[0] + u[0] + pt.sin(t) + 0.3 * q[0] + 0.2 * q[1]],
    lambda x, u: [x[0] + 0.5 * u[0]],
    process_noise=np.eye(2),
    observation_noise=[[0.1]],
    initial_mean=[0.5],
    initial_cov=lambda spread: [[spread**2]],
    dt=0.5,
    inputs=["force"],
)


@pytest.mark.parametrize(
    ("reference", "record"),
    [
        (DOUBLE_WELL, double_well()),
        (PRECISE_DOUBLE_WELL, double_well_with_surprises()),
        (BROAD_DOUBLE_WELL, broad_double_well()),
    ],
    ids=["crossing", "surprises", "broad"],
)
def test_it_is_the_independent_point_mass_filter(reference, record):
    exact = reference.point_mass_filter().run(*record).terms
    terms = grid_terms(reference, record.observed, record.steps)
    np.testing.assert_allclose(terms, exact, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("sensor", "tolerance"), [(0.3, 1e-8), (0.03, 1e-4), (0.003, 1e-8)])
def test_tolerance_is_kept_against_a_much_finer_grid(sensor, tolerance):
    reference = DoubleWell(noise_var=sensor**2, initial_var=0.02)
    steps = np.arange(5, 41, 5)
    observed = simulated(reference, steps)
    x = np.linspace(-1.2, 3.2, 2935)  # half the finest sensor's deviation
    exact = dense_terms(
        x,
        lambda x: x + reference.dt * reference.drift(x),
        lambda x: 0.0 * x + reference.sigma * np.sqrt(reference.dt),
        norm.pdf(x, reference.initial_mean, np.sqrt(reference.initial_var)),
        [None if np.isnan(d) else norm.pdf(d, x, sensor) for d in observed],
        steps,
    )
    terms = grid_terms(reference, observed, steps, tolerance)
    assert abs(terms - exact).max() < tolerance


def dense_terms(x, mean, sd, density, likelihoods, steps):
    """Terms by a full matrix on a fixed grid."""
    spacing, now, terms = x[1] - x[0], 0, []
    matrix = norm.pdf(x[:, None], mean(x), sd(x)) * spacing
    for step, seen in zip(steps, likelihoods, strict=True):
        for _ in range(now, step):
            density = matrix @ density
        now = step
        if seen is None:
            terms.append(0.0)
            continue
        density = density * seen
        terms.append(np.log(spacing * density.sum()))
        density = density / (spacing * density.sum())
    return np.array(terms)


COUNTED = psf.StateSpaceModel(
    lambda x, q: [0.9 * x[0] + 0.3 * pt.cos(x[0]) + pt.sqrt(0.1 + 0.02 * x[0] ** 2) * q[0]],
    observation_dist=lambda x: [pm.Poisson.dist(mu=pt.exp(0.5 + x[0]))],
    process_noise=[[1.0]],
    initial_mean=[0.2],
    initial_cov=[[0.3]],
)


def test_counts_and_noise_that_depends_on_the_state():
    steps, counts = np.array([0, 1, 2, 5, 6, 9]), np.array([2.0, 0.0, np.nan, 7.0, 9.0, 1.0])
    x = np.linspace(-12.0, 12.0, 1601)
    exact = dense_terms(
        x,
        lambda x: 0.9 * x + 0.3 * np.cos(x),
        lambda x: np.sqrt(0.1 + 0.02 * x**2),
        norm.pdf(x, 0.2, np.sqrt(0.3)),
        [None if np.isnan(d) else poisson.pmf(d, np.exp(0.5 + x)) for d in counts],
        steps,
    )
    terms = psf.log_likelihood(COUNTED, psf.GridFilter(), {}, counts, steps=steps)
    np.testing.assert_allclose(terms, exact, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("deviations", [6.0, 9.0, 20.0])
@pytest.mark.parametrize("spread", [0.02, 0.3])
def test_observations_beyond_the_rounding_of_the_density(deviations, spread):
    system = linear(0.9, 0.1, 0.05, spread)
    predicted = np.sqrt(0.9**2 * spread**2 + 0.1**2 + 0.05**2)
    observed = np.array([0.9 * 0.4 + deviations * predicted, 0.3])
    steps = np.array([1, 20])
    terms = grid_terms(system, observed, steps)
    np.testing.assert_allclose(terms, kalman_terms(system, observed, steps), rtol=0.0, atol=1e-8)


def reason(observed=(1.0, 0.8), steps=(5, 10), **changes):
    """Terms of a double well and the code of the failure that the warning names."""
    parameters = double_well_parameters(DOUBLE_WELL) | changes
    with pytest.warns(psf.errors.FilterWarning, match="-inf") as caught:
        terms = psf.log_likelihood(
            DOUBLE_WELL_SYSTEM, psf.GridFilter(), parameters, observed, steps=steps
        )
    (code,) = (f for f in Failure if f.message in str(caught[0].message))
    return terms, code


def test_failures_are_minus_infinity_and_a_reason():
    assert reason(sigma=0.0)[1] == NO_PROCESS_NOISE
    assert reason(initial_var=-0.1)[1] == INITIAL_COV
    assert reason(noise_var=-0.1)[1] == OBSERVATION_NOISE
    assert reason(alpha=np.inf)[1] == STATE_NOT_FINITE
    assert reason(initial_var=1e8)[1] == GRID_TOO_LARGE
    terms, code = reason(observed=[1.0, 50.0, 1.0], steps=[5, 10, 15])
    assert code == TOO_FAR
    assert np.isfinite(terms[0])
    assert (terms[1:] == -np.inf).all()


def test_mass_that_explodes_is_left_out():
    """The start lies beyond the stability limit with probability 0.002."""
    parameters = double_well_parameters(DOUBLE_WELL) | {"beta": -20.0}
    record = {"observed": [1.0, 1.0, 0.8], "steps": [5, 10, 15]}
    terms = psf.log_likelihood(DOUBLE_WELL_SYSTEM, psf.GridFilter(), parameters, **record)
    x = np.linspace(-3.3, 3.3, 3301)  # a point beyond leaves for good
    exact = dense_terms(
        x,
        lambda x: x + 0.01 * (4.0 * x - 20.0 * x**3),
        lambda x: 0.0 * x + 0.06,
        norm.pdf(x, 1.0, np.sqrt(0.5)),
        [norm.pdf(d, x, np.sqrt(0.08)) for d in record["observed"]],
        record["steps"],
    )
    np.testing.assert_allclose(terms, exact, rtol=0.0, atol=1e-6)


def free(transition=lambda x, q: [0.9 * x[0] + q[0]], **changes):
    return forced(transition=transition, inputs=(), **changes)


def refused(**changes):
    with pytest.raises(psf.errors.ModelError) as error:
        psf.log_likelihood(free(**changes), psf.GridFilter(), {}, [0.0], steps=[1])
    return str(error.value)


def test_systems_that_it_cannot_treat_are_refused_with_advice():
    two = {
        "transition": lambda x, q: [x[0] + q[0], x[1]],
        "initial_mean": [0.0, 0.0],
        "initial_cov": np.eye(2),
    }
    assert "one state, got 2 states" in refused(**two)
    assert "carried states ['x0']" in refused(carried=["x0"])
    assert "needs process noise" in refused(transition=lambda x: [0.9 * x[0]], process_noise=None)
    message = refused(transition=lambda x, q: [0.9 * x[0] + q[0] ** 3])
    assert "dg/dq depends on q" in message
    assert "BootstrapPF" in message
    substeps = psf.EulerMaruyama(lambda x: [-(x[0] ** 3)], [[1.0]], dt=0.1, substeps=2)
    assert "smaller dt" in refused(transition=substeps, process_noise=None)
    multiplied = refused(transition=lambda x, q: [0.9 * x[0] * pt.exp(q[0])])
    assert "substeps" not in multiplied
    assert "as in x * exp(q), make log(x) the state" in multiplied


def test_in_a_model_it_is_a_deterministic_likelihood_for_dram():
    record = double_well()
    parameters = double_well_parameters(DOUBLE_WELL)
    with pm.Model() as model:
        sigma = pm.Flat("sigma")
        psf.StateSpace(
            "d",
            DOUBLE_WELL_SYSTEM,
            psf.GridFilter(),
            params=parameters | {"sigma": sigma},
            steps=record.steps,
            observed=record.observed,
        )
    expected = grid_terms(DOUBLE_WELL, record.observed, record.steps).sum()
    assert model.compile_logp()({"sigma": 0.6}) == pytest.approx(expected, rel=1e-12)
    assert exactness(model)
    assert not noise_seeds(model)
    with pytest.raises(psf.errors.GradientUnavailableError, match="does not come with a gradient"):
        model.compile_dlogp()


def test_exact_means_smooth_equations_and_a_density_without_approximation():
    grid = psf.GridFilter()
    assert grid.is_exact_for(compile_system(free()))
    assert grid.is_exact_for(compile_system(COUNTED))
    assert grid.is_exact_for(compile_system(DOUBLE_WELL_SYSTEM))
    assert not grid.is_exact_for(compile_system(free(lambda x, q: [0.9 * abs(x[0]) + q[0]])))
    assert not grid.is_exact_for(
        compile_system(free(observation=lambda x, e: [x[0] * pt.exp(e[0])]))
    )


def test_tails_that_a_surprise_asks_for_were_not_cut_off_before():
    """An observation eight deviations off, several steps after the last."""
    system, steps = linear(1.0, 0.35, 0.03, 1.0), np.array([4])
    for deviations in (6.0, 7.25, 8.25, 9.5):
        sd = np.sqrt(1.0 + 4 * 0.35**2 + 0.03**2)
        data = np.array([0.4 + deviations * sd])
        expected = kalman_terms(system, data, steps)
        np.testing.assert_allclose(grid_terms(system, data, steps), expected, rtol=1e-9)


def test_the_coarse_form_is_not_finer_than_the_filter():
    assert psf.GridFilter().coarse() == psf.GridFilter(tolerance=1e-3)
    assert psf.GridFilter(tolerance=1e-2).coarse() == psf.GridFilter(tolerance=1e-2)


def test_a_sensor_with_a_kink_has_a_tolerance_that_the_largest_grid_allows():
    """Beside the kink of |x| the trapezoidal rule is of second order: 1e-8 would need 10^5 points.

    The exact terms are by folding: a start at zero and a symmetric step make |x| of a walk the
    state, with a smooth sensor.
    """
    walk = {
        "process_noise": [[0.25]],
        "observation_noise": [[0.04]],
        "initial_mean": [0.0],
        "initial_cov": [[1.0]],
    }
    kinked = psf.StateSpaceModel(lambda x, q: [0.9 * x[0] + q[0]], lambda x: [abs(x[0])], **walk)
    observed, steps = np.array([0.8, 0.1, np.nan, 1.4, 0.05, 0.6]), np.arange(1, 7)
    x = np.linspace(0.0, 6.0, 3001)  # the half line, with weights of the trapezoidal rule
    weights = np.full(x.size, x[1])
    weights[[0, -1]] *= 0.5
    density, terms = 2.0 * norm.pdf(x), []
    kernel = norm.pdf(x[:, None], 0.9 * x, 0.5) + norm.pdf(x[:, None], -0.9 * x, 0.5)
    for d in observed:
        density = kernel @ (weights * density)
        seen = 1.0 if np.isnan(d) else norm.pdf(d, x, 0.2)
        terms.append(np.log(weights @ (density * seen)))
        density = density * seen / np.exp(terms[-1])
    for tolerance in (1e-8, 1e-5):
        found = psf.log_likelihood(
            kinked, psf.GridFilter(tolerance=tolerance), {}, observed, steps=steps
        )
        np.testing.assert_allclose(found, terms, rtol=0.0, atol=1e-5)
    assert not compile_system(kinked).has_smooth_sensor
    assert compile_system(COUNTED).has_smooth_sensor
    assert compile_system(DOUBLE_WELL_SYSTEM).has_smooth_sensor
