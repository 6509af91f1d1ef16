"""States by the filters of many members: right on linear systems, in the mean over seeds.

Members are finite in number, so what is asserted is that the mean error over independent seeds is
within five of its standard errors, and a stated share of the state's deviation for the bias that
any finite number has. A right filter fails that once in a million times the numbers compared.
"""

from functools import cache

import numpy as np
import pytensor.tensor as pt
import pytest
from scipy.stats import chi2, multivariate_normal

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.filters.ensemble.ancestral_smoother import LAG, _settlement
from pymc_statespace_filters.filters.ensemble.backward_simulation import (
    _choose_particles,
    _fill_intervals,
)
from pymc_statespace_filters.ops.base import evaluator, kernel
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.ops.states import States as StatesOp
from pymc_statespace_filters.system.parameters import flat_parameters
from tests.compiled import from_python
from tests.filters.test_ekf_states import States, assert_drawn_from
from tests.references.grid_states import GridStates
from tests.references.linear_states import linear_states
from tests.references.records import BROAD_DOUBLE_WELL, broad_double_well
from tests.systems import DOUBLE_WELL_SYSTEM, PAIR, PAIR_DATA, STEPS, double_well_parameters

_choose_particles, _fill_intervals, _settlement = map(
    from_python, (_choose_particles, _fill_intervals, _settlement)
)

ROWS = np.arange(7)
NO_INPUTS = np.zeros((0, 0))
N_SEEDS = 40
# Each number of members compiles again, so most tests take these.
FILTERS = {
    "enkf": (psf.EnKF(500), 0.02),
    "bootstrap": (psf.BootstrapPF(500), 0.02),
    # Kernel densities smear the weights: up to 0.07 at 500 particles, less as the number grows.
    "pf_enkf": (psf.PFEnKF(500), 0.1),
}

# Noise acts on the velocity alone, and the start is known.
SWING = psf.StateSpaceModel(
    transition=lambda x, q, k: [x[0] + 0.3 * x[1], x[1] - 0.3 * (k * x[0] + 0.2 * x[1]) + q[0]],
    process_noise=[[0.2]],
    observation=lambda x: [x[0]],
    observation_noise=[[0.3]],
    initial_mean=[1.0, 0.0],
    initial_cov=[[0.0, 0.0], [0.0, 0.0]],
)
LONG_STEPS = np.arange(1, 31)
LONG_DATA = np.cos(0.3 * LONG_STEPS)[:, None] + 0.4 * np.sin(1.7 * LONG_STEPS)[:, None]


@cache
def compiled_states(filter, system, moment):
    """What the filter compiles, without PyTensor's layers around it."""
    return kernel(StatesOp(system, filter, moment))


def states(
    moment, filter, system=PAIR, theta=(0.7, 0.2), steps=STEPS, observed=PAIR_DATA, rows=ROWS,
    seed=0, draw_seed=0, inputs=NO_INPUTS,
):  # fmt: skip
    run = compiled_states(filter, system, moment)
    theta, observed, inputs = (np.array(a, dtype=float) for a in (theta, observed, inputs))
    return States(*run(theta, steps, observed, inputs, 0.0, seed, rows, draw_seed))


def exact(moment, rows=ROWS, **changes):
    record = {"steps": STEPS, "observed": PAIR_DATA} | changes
    return linear_states(
        [[0.7, 0.2], [0.0, 0.8]],
        np.diag([1.0, 0.5]),
        np.eye(2),
        [[0.5, 0.1], [0.1, 0.4]],
        [0.0, 0.3],
        np.diag([1.0, 2.0]),
        **record,
        rows=rows,
        moment=moment,
    )


def exact_swing(moment, rows, steps, observed):
    return linear_states(
        [[1.0, 0.3], [-0.36, 0.94]], np.diag([0.0, 0.2]), [[1.0, 0.0]], [[0.3]], [1.0, 0.0],
        np.zeros((2, 2)), steps=steps, observed=observed, rows=rows, moment=moment,
    )  # fmt: skip


def assert_unbiased(found, truth, scale, slack):
    """Means over seeds (axis 0) are the truth, up to their errors and a share of the scale."""
    error = np.mean(found, axis=0) - truth
    se = np.std(found, axis=0, ddof=1) / np.sqrt(len(found))
    assert (np.abs(error) <= 5.0 * se + slack * scale + 1e-7).all(), (error, se, scale)


def assert_right(several, truth, slack):
    assert_unbiased([s.mean for s in several], truth.mean, truth.sd, slack)
    assert_unbiased([s.sd for s in several], truth.sd, truth.sd, slack)


@pytest.mark.parametrize("moment", ["predicted", "filtered", "smoothed"])
@pytest.mark.parametrize("name", FILTERS)
def test_moments_of_a_linear_system(name, moment):
    filter, slack = FILTERS[name]
    several = [states(moment, filter, seed=i, draw_seed=-i) for i in range(N_SEEDS)]
    assert_right(several, exact(moment), slack)


@pytest.mark.parametrize("moment", ["filtered", "smoothed"])
def test_guided_moments_of_a_linear_system(moment):
    """Predicted states have none: the particles move towards observations to come."""
    filter = psf.GuidedPF(500)
    several = [states(moment, filter, seed=i, draw_seed=-i) for i in range(N_SEEDS)]
    assert_right(several, exact(moment), 0.02)


@pytest.mark.parametrize("moment", ["predicted", "filtered", "smoothed"])
@pytest.mark.parametrize("name", ["enkf", "bootstrap"])
def test_draws_have_the_law_of_the_states(name, moment):
    """Smoothed ones are paths of the joint law. A right filter fails once in a thousand."""
    filter, _ = FILTERS[name]
    rows = np.array([0, 3, 6])
    draws = np.array(
        [states(moment, filter, rows=rows, seed=i, draw_seed=7 * i).drawn for i in range(800)]
    )
    truth = exact(moment, rows)
    if moment == "smoothed":
        cov = truth.cov.reshape(6, 6)
        assert_drawn_from(draws.reshape(800, 6), truth.mean.ravel(), cov, 1e-3 / 2)
    else:
        for i in range(3):
            assert_drawn_from(draws[:, i], truth.mean[i], truth.cov[i, :, i], 1e-3 / 6)


def test_the_draw_is_apart_from_the_filter():
    """Another seed of the draws leaves the moments of a filter as they are."""
    filter, _ = FILTERS["enkf"]
    for moment in ("predicted", "filtered", "smoothed"):
        first, second = (states(moment, filter, draw_seed=i) for i in (1, 2))
        np.testing.assert_array_equal(first.mean, second.mean)
        assert (first.drawn != second.drawn).any()


@pytest.mark.parametrize("moment", ["predicted", "filtered"])
def test_members_are_those_of_the_likelihood(moment):
    filter, _ = FILTERS["bootstrap"]
    n_effective = states("filtered", filter, rows=STEPS, seed=5).n_effective
    _, expected = evaluator(LogLikelihood(PAIR, filter))(
        np.array([0.7, 0.2]), STEPS, PAIR_DATA, NO_INPUTS, 0.0, 5
    )
    health = states(moment, filter, seed=5).health
    assert health[0] == pytest.approx(n_effective[[0, 1, 3]].min(), rel=1e-12)
    np.testing.assert_array_equal(health, expected)


def test_rows_are_unknown_from_a_failing_observation_on():
    (filter, _), data = FILTERS["bootstrap"], PAIR_DATA.copy()
    data[1, 1] = 1e200  # at step 2
    for moment, n_known in (("predicted", 2), ("filtered", 2), ("smoothed", 0)):
        found = states(moment, filter, observed=data)
        for values in found[:4]:
            assert np.isfinite(values[:n_known]).all()
            assert np.isnan(values[n_known:]).all()
        assert found.health[1] != 0
        assert found.health[2] == 1


@pytest.mark.parametrize("name", FILTERS)
def test_noise_that_does_not_reach_every_state(name):
    """The ensemble's past, or ancestries, which in so short a record nothing cuts."""
    filter, slack = FILTERS[name]
    record = {"steps": LONG_STEPS[:6], "observed": LONG_DATA[:6]}
    record["observed"] = np.where(LONG_STEPS[:6, None] == 3, np.nan, record["observed"])
    rows = np.arange(7)
    several = [
        states("smoothed", filter, SWING, [1.2], **record, rows=rows, seed=i, draw_seed=i)
        for i in range(N_SEEDS)
    ]
    truth = exact_swing("smoothed", rows, **record)
    # At the known start nothing is left to estimate.
    np.testing.assert_allclose([s.mean[0] for s in several], np.tile([1.0, 0.0], (N_SEEDS, 1)))
    assert_right([s._replace(mean=s.mean[1:], sd=s.sd[1:]) for s in several],
                 truth._replace(mean=truth.mean[1:], cov=truth.cov[1:, :, 1:]), slack)  # fmt: skip


@pytest.mark.parametrize("name", ["bootstrap", "pf_enkf"])
def test_ancestries_are_settled_after_a_lag(name):
    """What comes later than that does not count, and all before it does."""
    filter, slack = FILTERS[name]
    row, until = 8, 8 + LAG  # step 8 is observation 7
    rows = np.array([2, row])
    several, cut, shorter = (
        [states("smoothed", filter, SWING, [1.2], LONG_STEPS[:J], LONG_DATA[:J], rows, seed=i)
         for i in range(n_seeds)]
        for J, n_seeds in ((30, N_SEEDS), (until, 1), (until - 1, 1))
    )  # fmt: skip
    np.testing.assert_array_equal(several[0].mean[1], cut[0].mean[1])
    assert (several[0].mean[1] != shorter[0].mean[1]).all()
    truth = exact_swing("smoothed", rows[1:], LONG_STEPS[:until], LONG_DATA[:until])
    assert_right([s._replace(mean=s.mean[1:], sd=s.sd[1:]) for s in several], truth, 2 * slack)
    assert f"{LAG} observations" in filter.smoothing_method(compile_system(SWING))


def test_distinct_ancestors_are_counted():
    rows = np.array([2, 29])
    arguments = (FILTERS["bootstrap"][0], SWING, [1.2], LONG_STEPS, LONG_DATA, rows)
    found, filtered = (states(moment, *arguments) for moment in ("smoothed", "filtered"))
    assert 1 < found.n_effective[0] < 0.8 * found.n_effective[1] <= 400
    assert found.n_effective[1] == int(found.n_effective[1]) != filtered.n_effective[1]


def test_when_rows_are_settled():
    """A lag counts observations that were seen; a slot is free once its row is settled."""
    steps = np.array([0, 2, 4, 6, 8, 10])
    observed = np.array([[0.1], [np.nan], [0.3], [0.4], [0.5], [0.6]])
    settled, slots = _settlement(np.arange(11), steps, observed, 2)
    # Rows 1 to 4 wait for the datum at step 4, and two more.
    np.testing.assert_array_equal(settled, [3, 4, 4, 4, 4, 5, 5, 5, 5, 5, 5])
    assert slots == 8  # rows 1 to 8 are there at step 8, when row 1 is settled
    settled, slots = _settlement(np.array([3, 9]), steps, observed, 10**9)
    np.testing.assert_array_equal(settled, [5, 5])
    assert slots == 2


def test_carried_states_have_no_past_to_nudge():
    def transition(x, q, a):
        return [a * x[0] + q[0], x[1] + x[0]]

    system = psf.StateSpaceModel(
        transition=transition,
        process_noise=[[1.0]],
        observation=lambda x: [x[0]],
        observation_noise=[[0.5]],
        initial_mean=[0.0, 0.0],
        initial_cov=[[1.0, 0.0], [0.0, 0.0]],
        states=["x", "total"],
        carried=["total"],
    )
    arguments = (psf.EnKF(50), system, [0.7], np.array([1, 2]), np.array([[0.5], [3.0]]))
    rows = np.array([1, 2])
    predicted, smoothed = (states(m, *arguments, rows=rows) for m in ("predicted", "smoothed"))
    np.testing.assert_array_equal(smoothed.mean[0, 1], predicted.mean[0, 1])
    assert smoothed.mean[0, 0] != predicted.mean[0, 0]


def test_smoothing_methods():
    assert psf.EnKF(50).smoothing_method(compile_system(PAIR)) == "ensemble Kalman smoother"
    for filter in (psf.BootstrapPF(50), psf.PFEnKF(50)):
        assert filter.smoothing_method(compile_system(PAIR)) == "backward simulation"


def double_well_errors(filter, moment, n_seeds):
    """Errors of means and deviations (seed, R) in deviations of the exact law on a grid."""
    record, reference = broad_double_well(), BROAD_DOUBLE_WELL
    rows = record.steps
    truth = getattr(GridStates(reference.point_mass_filter(), *record, rows), moment)()
    theta = flat_parameters(DOUBLE_WELL_SYSTEM, double_well_parameters(reference))
    arguments = (DOUBLE_WELL_SYSTEM, theta, record.steps, record.observed[:, None], rows)
    found = [states(moment, filter, *arguments, seed=i, draw_seed=i) for i in range(n_seeds)]
    errors = [[s.mean[:, 0] - truth.mean for s in found], [s.sd[:, 0] - truth.sd for s in found]]
    return np.array(errors) / truth.sd


@pytest.mark.parametrize("moment", ["filtered", "smoothed"])
def test_two_wells(moment):
    """A law of two modes, which a particle filter finds and an ensemble Kalman filter does not."""
    errors = double_well_errors(psf.BootstrapPF(1000), moment, 8)
    assert_unbiased(errors[0], 0.0, 1.0, 0.02)
    assert_unbiased(errors[1], 0.0, 1.0, 0.02)
    assert np.sqrt((errors[0] ** 2).mean()) < 0.25
    ensemble = double_well_errors(psf.EnKF(1000), moment, 2)
    assert np.sqrt((ensemble[0] ** 2).mean()) > 0.4


def test_particles_are_chosen_by_weight_and_density():
    """Proposals that are accepted, and full sweeps where none is, give one law.

    A chi-square test that a right choice fails once in ten thousand.
    """
    rng = np.random.default_rng(1)
    N, n, n_paths = 12, 2, 20_000
    means, roots = 3.0 * rng.normal(size=(n, N)), np.zeros((N, n, n))
    roots[:, 0, 0], roots[:, 1, 1] = rng.uniform(0.1, 1.0, (2, N))
    roots[:, 1, 0] = rng.normal(size=N)
    log_constants = -np.log(roots[:, 0, 0] * roots[:, 1, 1])
    w = rng.dirichlet(np.ones(N))
    w[3] = 0.0
    log_constants[3] = -np.inf
    x = means[:, 5] + roots[5] @ [0.3, -0.2]  # far off for most: often all proposals are refused
    covs = roots @ roots.transpose(0, 2, 1)
    densities = [multivariate_normal.pdf(x, m, c) for m, c in zip(means.T, covs, strict=True)]
    shares = w * densities / (w @ densities)
    refused = 1.0 - 2.0 * np.pi * (w @ densities) / np.exp(log_constants.max())
    assert 0.1 < refused**16 < 0.9

    cumulative, begins = np.empty(N), np.empty(N, np.int64)
    _fill_intervals(w, (cumulative, begins))
    chosen = np.empty(n_paths, np.int64)
    kernel = (means, roots, log_constants)
    _choose_particles(7, 0, w, (cumulative, begins), kernel, np.tile(x, (n_paths, 1)), chosen)
    counts = np.bincount(chosen, minlength=N)
    likely = shares * n_paths > 5
    expected = np.append(shares[likely], shares[~likely].sum()) * n_paths
    found = np.append(counts[likely], counts[~likely].sum())
    assert counts[3] == 0
    keep = expected > 0
    statistic = ((found - expected)[keep] ** 2 / expected[keep]).sum()
    assert chi2.sf(statistic, keep.sum() - 1) > 1e-4


def test_noise_that_depends_on_the_state():
    """Each particle has a covariance of its own; the point-mass filter knows the answer."""

    def transition(x, q, u, t):
        noise = 0.2 + 0.6 * pt.sigmoid(2.0 * x[0])
        return [0.9 * x[0] + u[0] + 0.5 * pt.cos(2.0 * t) + noise * q[0]]

    system = psf.StateSpaceModel(
        transition=transition,
        inputs=["push"],
        process_noise=[[1.0]],
        observation=lambda x: [x[0]],
        observation_noise=[[0.3]],
        initial_mean=[0.0],
        initial_cov=[[1.0]],
    )
    steps, rows = np.array([2, 5, 8]), np.arange(9)
    arguments = (system, [], steps, np.array([[1.5], [-0.8], [0.9]]), rows)
    push = np.array([[0.5], [-1.0], [2.0], [0.0], [-2.0], [1.0], [0.3], [-0.7]])
    truth = states("smoothed", psf.GridFilter(), *arguments, inputs=push)
    several = [
        states("smoothed", psf.BootstrapPF(500), *arguments, inputs=push, seed=i, draw_seed=i)
        for i in range(N_SEEDS)
    ]
    assert_right(several, truth, 0.03)


@pytest.mark.parametrize(
    "filter",
    [
        FILTERS["enkf"][0],
        *(k(60, resample_below=b) for k in (psf.BootstrapPF, psf.PFEnKF) for b in (0.0, 1.0)),
    ],
    ids=repr,
)
def test_at_its_end_a_record_is_filtered(filter):
    """The past is nudged and weighted as the present is, to rounding."""
    arguments = (filter, SWING, [1.2], LONG_STEPS[:9], LONG_DATA[:9])
    rows = np.array([4, 9])
    smoothed, filtered = (states(m, *arguments, rows=rows) for m in ("smoothed", "filtered"))
    np.testing.assert_allclose(smoothed.mean[1], filtered.mean[1], rtol=1e-9)
    np.testing.assert_allclose(smoothed.sd[1], filtered.sd[1], rtol=1e-9)
    assert (smoothed.mean[0] != filtered.mean[0]).all()
