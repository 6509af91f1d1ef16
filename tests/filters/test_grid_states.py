"""States of the point-mass filter against exact answers, and against sums on a grid of our own."""

from functools import cache

import numpy as np
import pytest
from numba import njit
from scipy.stats import kstest, norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.filters.outcomes import NONE, TOO_FAR
from pymc_statespace_filters.filters.point_mass.moments import draw
from pymc_statespace_filters.ops.base import evaluator, kernel
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.ops.states import States as StatesOp
from pymc_statespace_filters.system.parameters import flat_parameters
from tests.filters.test_ekf_states import States
from tests.filters.test_grid import linear
from tests.references.grid import PointMassFilter
from tests.references.grid_states import GridStates
from tests.references.linear_states import linear_states
from tests.references.records import (
    BROAD_DOUBLE_WELL,
    DOUBLE_WELL,
    PRECISE_DOUBLE_WELL,
    DoubleWell,
    broad_double_well,
    double_well,
    double_well_with_surprises,
)
from tests.systems import DOUBLE_WELL_SYSTEM, FORCE, FORCED, FORCED_DATA, double_well_parameters
from tests.systems import STEPS as FORCED_STEPS

MOMENTS = ("predicted", "filtered", "smoothed")


@cache
def compiled(system, moment):
    return evaluator(StatesOp(system, psf.GridFilter(), moment))


def states(system, parameters, steps, observed, rows, moment, *, draw_seed=0, inputs=None):
    """States of a system with one state, as vectors (R,)."""
    if inputs is None:
        inputs = np.empty((steps[-1] + 1, 0))
    found = compiled(system, moment)(
        flat_parameters(system, parameters),
        np.asarray(steps, np.int64),
        np.reshape(np.asarray(observed, float), (-1, 1)),
        inputs,
        0.0,
        0,
        np.asarray(rows, np.int64),
        draw_seed,
    )
    R = len(rows)
    assert [part.shape for part in found] == [(R, 1)] * 3 + [(R,), (3,)]
    return States(*(part[:, 0] for part in found[:3]), *found[3:])


def well_states(reference, steps, observed, rows, moment, seed=0):
    """States of a double well, or of one without its cubic force: a linear system."""
    parameters = double_well_parameters(reference)
    return states(DOUBLE_WELL_SYSTEM, parameters, steps, observed, rows, moment, draw_seed=seed)


def assert_law(found, mean, sd, atol):
    np.testing.assert_allclose(found.mean, mean, rtol=0.0, atol=atol)
    np.testing.assert_allclose(found.sd, sd, rtol=0.0, atol=atol)
    assert (found.n_effective == np.inf).all()
    np.testing.assert_array_equal(found.health, [np.inf, NONE, -1.0])


def linear_law(system, steps, observed, rows, moment):
    law = linear_states(
        1.0 + system.alpha * system.dt,
        system.sigma**2 * system.dt,
        1.0,
        system.noise_var,
        system.initial_mean,
        system.initial_var,
        steps=steps,
        observed=observed,
        rows=rows,
        moment=moment,
    )
    return law.mean[:, 0], law.sd[:, 0]


STEPS = np.array([2, 3, 5, 9, 20, 26])
DATA = np.array([0.9, 0.2, np.nan, -0.6, 0.4, 0.8])
ROWS = np.array([0, 1, 2, 3, 5, 7, 9, 19, 20, 24, 26])


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("growth", [0.95, 0.2, -0.7])
def test_linear_systems_have_exact_states(growth, moment):
    """Sensors far finer than the noise of a step, starts known and far broader than it."""
    for noise in (1.0, 0.05):
        for sensor in (1.0, 0.03):
            for start, spread in ((0.0, 0.0), (0.4, 0.0), (0.4, 1e-6), (-0.4, 3.0)):
                system = linear(growth, noise, sensor, spread, start)
                data = DATA if noise == 1.0 else 0.1 * DATA
                found = well_states(system, STEPS, data, ROWS, moment)
                mean, sd = linear_law(system, STEPS, data, ROWS, moment)
                assert_law(found, mean, sd, 1e-8)


@pytest.mark.parametrize("deviations", [6.0, 9.0, 20.0])
def test_a_surprise_moves_the_states_before_it(deviations):
    """Back to where the density of the filter is below the rounding of its largest value."""
    system = linear(0.9, 0.1, 0.05, 0.3)
    steps = np.array([1, 5, 9])
    at_5 = np.sqrt(linear_law(system, steps[:1], [0.4], [5], "filtered")[1][0] ** 2 + 0.05**2)
    data = np.array([0.4, 0.9**4 * 0.4 + deviations * at_5, 0.3])
    rows = np.arange(10)
    found = well_states(system, steps, data, rows, "smoothed")
    assert_law(found, *linear_law(system, steps, data, rows, "smoothed"), 1e-8)


@pytest.mark.parametrize("gap", [2, 4])
def test_states_before_a_surprise_may_need_a_longer_grid_than_the_filter(gap):
    """Where the filter's masses end, with nothing that it can see of it at the observation."""
    system = linear(1.0, 0.35, 0.03, 1.0)
    steps, rows = np.array([gap]), np.arange(gap + 1)
    data = 0.4 + 8.25 * np.sqrt([1.0 + gap * 0.35**2 + 0.03**2])
    found = well_states(system, steps, data, rows, "smoothed")
    assert_law(found, *linear_law(system, steps, data, rows, "smoothed"), 1e-9)


@pytest.mark.parametrize("moment", MOMENTS)
def test_inputs(moment):
    rows = np.arange(7)[:6]
    law = linear_states(
        0.8, 1.0, 1.0, 0.5, 0.0, 1.0,
        steps=FORCED_STEPS, observed=FORCED_DATA, rows=rows, moment=moment, forcing=FORCE,
    )  # fmt: skip
    inputs = np.append(FORCE, 0.0)[:, None]
    found = states(FORCED, {"a": 0.8}, FORCED_STEPS, FORCED_DATA, rows, moment, inputs=inputs)
    assert_law(found, law.mean[:, 0], law.sd[:, 0], 1e-9)


def thinned(record):
    """A record with missing rows, and steps at, between and before its observations."""
    steps, observed = record
    observed = observed.copy()
    observed[[3, 4, 11]] = np.nan
    around = steps[steps.size // 4] + np.arange(-25, 26, 5)
    return steps, observed, np.unique([*steps[:20], *around, *steps[-3:]])


RECORDS = {
    "crossing": (DOUBLE_WELL, double_well),
    "surprises": (PRECISE_DOUBLE_WELL, double_well_with_surprises),
    "broad": (BROAD_DOUBLE_WELL, broad_double_well),
}


@cache
def reference_states(name):
    """The record, the steps, and their law by the independent grid, itself good to 1e-10."""
    reference, record = RECORDS[name]
    steps, observed, rows = thinned(record())
    return (steps, observed, rows), GridStates(reference.point_mass_filter(), steps, observed, rows)


@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("name", RECORDS)
def test_double_wells_have_the_states_of_an_independent_grid(name, moment):
    record, reference = reference_states(name)
    law = getattr(reference, moment)()
    found = well_states(RECORDS[name][0], *record, moment)
    assert_law(found, law.mean, law.sd, 1e-9)


def test_mass_that_will_explode_counts_until_it_does():
    """The start lies beyond the stability limit with probability 0.002."""
    system = DoubleWell(beta=-20.0)
    grid = PointMassFilter(  # a point beyond its ends leaves for good
        system.drift,
        sigma=system.sigma,
        dt=system.dt,
        noise_var=system.noise_var,
        initial_mean=system.initial_mean,
        initial_var=system.initial_var,
        low=-3.3,
        high=3.3,
        n_points=661,
    )
    steps, data, rows = [5, 10], [1.0, 0.8], [0, 5, 7, 10]
    reference = GridStates(grid, steps, data, rows)
    start = well_states(system, np.array(steps), data, rows, "filtered")
    assert start.mean[0] == pytest.approx(1.0, abs=1e-9)  # the whole Gaussian
    assert start.sd[0] == pytest.approx(np.sqrt(0.5), abs=1e-9)
    np.testing.assert_allclose(start.mean[1:], reference.filtered().mean[1:], atol=1e-6)
    smoothed = reference.smoothed()
    found = well_states(system, np.array(steps), data, rows, "smoothed")
    assert_law(found, smoothed.mean, smoothed.sd, 1e-6)


# Half of the law in either well, and draws of it that a right implementation makes.
SHORT_STEPS, SHORT_DATA = np.array([0, 20, 60, 80]), np.array([0.3, np.nan, -0.2, 0.5])
SHORT_ROWS = np.array([0, 1, 19, 20, 45, 60, 80])
N_DRAWS = 2000


@cache
def short_reference():
    grid = BROAD_DOUBLE_WELL.point_mass_filter()
    return GridStates(grid, SHORT_STEPS, SHORT_DATA, SHORT_ROWS)


@cache
def draws(moment):
    """(N_DRAWS, R)."""
    parameters = flat_parameters(DOUBLE_WELL_SYSTEM, double_well_parameters(BROAD_DOUBLE_WELL))
    run, data = compiled(DOUBLE_WELL_SYSTEM, moment), SHORT_DATA[:, None]
    record = (parameters, SHORT_STEPS, data, np.empty((81, 0)), 0.0, 0, SHORT_ROWS)
    return np.array([run(*record, seed)[2][:, 0] for seed in range(N_DRAWS)])


@pytest.mark.parametrize("moment", MOMENTS)
def test_draws_have_the_law_of_the_state(moment):
    """Seven Kolmogorov-Smirnov tests: a right implementation fails one time in 10^5."""
    reference = short_reference()
    density = getattr(reference, moment)().density
    ends = reference.x + 0.5 * reference.grid.spacing
    for drawn, p in zip(draws(moment).T, density, strict=True):
        cdf = reference.grid.spacing * np.cumsum(p)
        assert np.unique(drawn).size > 0.999 * N_DRAWS  # on no lattice
        assert kstest(drawn, lambda x, cdf=cdf: np.interp(x, ends, cdf)).pvalue > 1e-6


def test_smoothed_draws_are_trajectories():
    """28 means of products, and 28 of products of signs made smooth, each within 5.5 deviations:
    a right implementation fails one time in 5 * 10^5."""
    reference, drawn = short_reference(), draws("smoothed")
    for f in (lambda x: x, lambda x: np.tanh(4.0 * x)):
        for i in range(SHORT_ROWS.size):
            for j in range(i, SHORT_ROWS.size):
                product = f(drawn[:, i]) * f(drawn[:, j])
                error = product.std() / np.sqrt(N_DRAWS)
                exact = reference.smoothed_mean(i, j, f, f)
                assert abs(product.mean() - exact) < 5.5 * error
    # A step apart: the noise of a step is far smaller than the spread of the state.
    moved = drawn[:, 1] - drawn[:, 0]
    assert moved.std() < 2.0 * BROAD_DOUBLE_WELL.sigma * np.sqrt(BROAD_DOUBLE_WELL.dt)


def test_other_draws_are_independent():
    """21 correlations for each, within 5 deviations: 1 in 40,000."""
    for moment in ("predicted", "filtered"):
        correlations = np.corrcoef(draws(moment), rowvar=False)[np.triu_indices(7, 1)]
        assert abs(correlations).max() < 5.0 / np.sqrt(N_DRAWS)


@njit(error_model="numpy", nogil=True)
def quantiles(low, spacing, mass, u, out):
    for i in range(u.size):
        out[i] = draw(low, spacing, mass, u[i])


@pytest.mark.parametrize(("sd", "distance"), [(1.2, 0.0), (1.5, 7.0), (4.0, 0.4)])
def test_draws_have_mean_and_variance_of_the_masses(sd, distance):
    """From the coarsest grid in use on, of 1.2 points to a deviation."""
    points = np.arange(-30, 31)
    peaks = np.array([0.3, 0.3 + distance])
    mass = 0.1 * norm.pdf(points[:, None], peaks, sd) @ [0.4, 0.6]
    u = (np.arange(100_000) + 0.5) / 100_000
    out = np.empty(u.size)
    quantiles(970, 0.01, mass, u, out)
    mean = mass @ (points + 1000) / mass.sum()
    variance = mass @ (points + 1000 - mean) ** 2 / mass.sum()
    assert 100.0 * out.mean() == pytest.approx(mean, abs=1e-4)
    assert 1e4 * out.var() == pytest.approx(variance, rel=1e-3 if sd == 1.2 else 1e-4)
    exact = norm.cdf((100.0 * out - 1000.0)[:, None], peaks, sd) @ [0.4, 0.6]
    assert abs(exact - u).max() < 0.004


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_state_does_not_depend_on_which_others_are_asked_for(moment):
    record = BROAD_DOUBLE_WELL, SHORT_STEPS, SHORT_DATA
    many = well_states(*record, np.arange(81), moment, seed=-3)
    rows = SHORT_ROWS[2:-1]
    few = well_states(*record, rows, moment, seed=-3)
    for one, other in zip(many[:3], few[:3], strict=True):
        np.testing.assert_array_equal(one[rows], other)
    again = well_states(*record, rows, moment, seed=4)
    np.testing.assert_array_equal(again.mean, few.mean)
    assert (again.drawn != few.drawn).all()


def test_a_known_start_is_drawn_as_it_is():
    system = linear(0.9, 0.1, 0.3, 0.0, start=0.7)
    for moment in MOMENTS:
        found = well_states(system, STEPS, DATA, ROWS, moment)
        assert found.mean[0] == found.drawn[0] == 0.7
        assert found.sd[0] == 0.0
        assert (found.drawn[1:] != found.mean[1:]).all()


def test_all_observations_missing():
    record = BROAD_DOUBLE_WELL, SHORT_STEPS, np.full(4, np.nan), SHORT_ROWS
    predicted, filtered, smoothed = (well_states(*record, moment) for moment in MOMENTS)
    np.testing.assert_array_equal(predicted.mean, filtered.mean)
    assert_law(smoothed, filtered.mean, filtered.sd, 1e-9)


def test_states_from_a_failure_on_are_nan():
    steps, data, rows = np.array([5, 10, 15]), [1.0, 50.0, 1.0], [0, 5, 9, 10, 12, 15]
    for moment in MOMENTS:
        found = well_states(DOUBLE_WELL, steps, data, rows, moment)
        known = 0 if moment == "smoothed" else 3
        for part in found[:4]:
            assert np.isfinite(part[:known]).all() or part is found.n_effective
            assert not np.isnan(part[:known]).any()
            assert np.isnan(part[known:]).all()
        np.testing.assert_array_equal(found.health, [np.inf, TOO_FAR, 1.0])


def test_no_rows():
    for moment in MOMENTS:
        found = well_states(DOUBLE_WELL, STEPS, DATA, np.empty(0, np.int64), moment)
        assert found.mean.size == 0
        assert found.health[1] == NONE


def test_what_identifies_the_code_and_the_words_for_it():
    filter = psf.GridFilter()
    keys = {kernel(StatesOp(FORCED, filter, moment)).key for moment in MOMENTS}
    assert len(keys | {kernel(LogLikelihood(FORCED, filter)).key}) == 4
    assert None not in keys
    assert filter.smoothing_method(compile_system(FORCED)) == "point masses, forward and backward"
