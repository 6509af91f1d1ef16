"""Records of a panel side by side: terms, health and gradient of each as if it were alone.

The single filters are tested against exact results elsewhere; here one test is.
"""

import numpy as np
import pytensor.tensor as pt
import pytest
from pytensor.tensor.linalg import inv

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen.arguments import LANES
from pymc_statespace_filters.compiler.codegen.scalarize import NotUnrollableError
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.filters.gaussian import functions as gaussian_functions
from pymc_statespace_filters.filters.gaussian.machine import STRETCH
from pymc_statespace_filters.filters.outcomes import (
    NONE,
    PROCESS_NOISE,
    STATE_NOT_FINITE,
)
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import (
    LogLikelihood,
    LogLikelihoodGradient,
    TapedLogLikelihood,
    TapePullback,
)
from pymc_statespace_filters.ops.signatures import PANEL

T0, SEED = np.array(0.5), np.array(0)

# Parameters in every part, time and inputs in both equations, a branch, a covariance of parameters.
BENT = psf.StateSpaceModel(
    transition=lambda x, q, u, t, a, c: [
        x[0] + 0.1 * (x[1] + u[0] * pt.cos(c * t)),
        pt.exp(a) * x[1] - pt.switch(x[0] > 0.0, pt.sqrt(c), 1.0) * 0.1 * x[0] ** 3 + q[0],
    ],
    process_noise=lambda v: [[v]],
    observation=lambda x, u, c: [x[0] + c * u[1], pt.log1p(x[1] ** 2)],
    observation_noise=lambda c: [[0.5, 0.1], [0.1, c]],
    initial_mean=lambda a: [pt.exp(a), 0.3],
    initial_cov=[[1.0, 0.0], [0.0, 2.0]],
    inputs=["force", "offset"],
)
A, C, V = range(3)

# One state; it explodes where the slope is too steep.
WELL = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(lambda x, a: [a * x[0] * (1.0 - x[0] ** 2)], [[0.3]], dt=0.05),
    observation=lambda x: [x[0]],
    observation_noise=[[0.2]],
    initial_mean=[0.5],
    initial_cov=[[0.3]],
)

ODE = psf.StateSpaceModel(
    transition=psf.RungeKutta4(lambda x, r: [r * x[0] * (1.0 - x[0])], dt=0.1),
    observation=lambda x, r: [x[0] / (1.0 + r**2)],
    observation_noise=[[0.1]],
    initial_mean=lambda start: [start],
    initial_cov=[[0.0]],
)

# An implicit step, whose matrix is computed once per record.
TURNING = psf.StateSpaceModel(
    transition=lambda x, q, k: inv(pt.stacklists([[1.0, -0.1], [0.1 * k, 1.02]])) @ x + q,
    process_noise=[[0.1, 0.0], [0.0, 0.2]],
    observation=lambda x: [x[0]],
    observation_noise=[[0.2]],
    initial_mean=[1.0, 0.0],
    initial_cov=[[0.1, 0.0], [0.0, 0.1]],
)


def table(lengths, rng, *, p=1, n_inputs=0, own_inputs=False, longest_gap=3):
    """Rows, data and inputs of a panel; a third of the data are missing."""
    rows, first = [], 0
    for record, n_rows in enumerate(lengths):
        steps = np.cumsum(rng.integers(1, longest_gap + 1, size=n_rows)) - rng.integers(2)
        rows += [(100 - record, step, first) for step in steps]
        first += (steps[-1] + 1) * own_inputs
    rows = np.array(rows, dtype=np.int64)
    n_input_rows = first if own_inputs else rows[:, 1].max() + 1
    observed = rng.normal(size=(len(rows), p))
    observed[rng.uniform(size=observed.shape) < 0.3] = np.nan
    return rows, observed, rng.normal(size=(n_input_rows, n_inputs)), T0, SEED


def records_of(rows):
    ends = np.flatnonzero(np.diff(rows[:, 0], append=-1)) + 1
    return [slice(*pair) for pair in zip([0, *ends[:-1]], ends, strict=True)]


def together(system, filter, theta, panel, bars):
    terms, health, tape = evaluator(TapedLogLikelihood(system, filter, PANEL))(theta, *panel)
    pullback = evaluator(TapePullback(system, filter, PANEL))
    return terms, health, *pullback(theta, *panel, tape, bars)


def alone(system, filter, theta, panel, bars):
    rows, observed, inputs, *_ = panel
    terms, healths, theta_bar = np.empty(len(rows)), [], np.empty(theta.shape)
    for record, part in enumerate(records_of(rows)):
        own = rows[part, 1], observed[part], inputs[rows[part.start, 2] :], T0, SEED
        terms[part], health, tape = evaluator(TapedLogLikelihood(system, filter))(
            theta[record], *own
        )
        pullback = evaluator(TapePullback(system, filter))
        (theta_bar[record],) = pullback(theta[record], *own, tape, bars[part])
        healths.append([*health[:2], health[2] + part.start * (health[1] != NONE)])
    return terms, np.array(healths), theta_bar


def check(system, filter, theta, panel):
    """Compare terms and gradient; return both, and the healths of single records."""
    bars = np.random.default_rng(9).normal(size=len(panel[0]))
    terms, health, theta_bar = together(system, filter, theta, panel, bars)
    expected, healths, expected_bar = alone(system, filter, theta, panel, bars)
    np.testing.assert_allclose(terms, expected, rtol=1e-11, atol=1e-12)
    if health[1] == NONE:
        assert abs(expected_bar).max() > 0.1
        size = abs(expected_bar).max(axis=0)
        assert (abs(theta_bar - expected_bar) <= 1e-12 * size).all()
    return health, healths, theta_bar


def bent_theta(n, rng):
    columns = rng.uniform(-2.0, -0.5, n), rng.uniform(0.3, 2.0, n), rng.uniform(0.1, 1.0, n)
    return np.column_stack(columns)


@pytest.mark.parametrize("own_inputs", [False, True])
@pytest.mark.parametrize("n", [1, 3, 9, LANES + 5])
def test_records_of_unequal_lengths_are_those_alone(n, own_inputs):
    rng = np.random.default_rng(n)
    lengths = rng.permutation(np.arange(n) % 7 + 1)
    panel = table(lengths, rng, p=2, n_inputs=2, own_inputs=own_inputs)
    health, *_ = check(BENT, psf.EKF(), bent_theta(n, rng), panel)
    np.testing.assert_array_equal(health, [np.inf, NONE, -1.0])


@pytest.mark.parametrize("filter", [psf.UKF(), psf.IPLF()], ids=["UKF", "IPLF"])
def test_long_gaps_and_a_record_that_ends_before_it_would_explode(filter):
    """The tape has no state for most steps of a gap; an infinite state comes after the last row."""
    rng = np.random.default_rng(4)
    panel = table([4, 2, 1, 3], rng, longest_gap=2 * STRETCH + 9)
    theta = rng.uniform(0.5, 3.0, size=(4, 1))
    theta[2] = -40.0
    panel[0][records_of(panel[0])[2], 1] = 2
    panel[1][:, 0] = rng.normal(size=len(panel[1]))
    assert panel[0][:, 1].max() > 3 * STRETCH
    health, *_ = check(WELL, filter, theta, panel)
    assert health[1] == NONE


def test_a_deterministic_system():
    rng = np.random.default_rng(5)
    panel = table([3, 5, 2], rng, longest_gap=5)
    theta = np.column_stack([rng.uniform(0.5, 2.0, 3), rng.uniform(0.1, 0.9, 3)])
    check(ODE, psf.EKF(), theta, panel)


def test_linear_algebra_of_parameters_is_that_of_each_record():
    rng = np.random.default_rng(6)
    assert compile_system(TURNING).n_theta > TURNING.n_theta
    check(TURNING, psf.EKF(), rng.uniform(1.0, 9.0, size=(3, 1)), table([4, 6, 2], rng))


@pytest.mark.parametrize(
    ("column", "value", "code"),
    [
        (V, -5.0, PROCESS_NOISE),  # known before the first row
        (A, 60.0, STATE_NOT_FINITE),  # explodes on the way
        (A, np.nan, STATE_NOT_FINITE),
    ],
)
def test_a_failing_record_leaves_the_others_their_terms(column, value, code):
    rng = np.random.default_rng(7)
    panel = table([3, 9, 6, 9, 4], rng, p=2, n_inputs=2)
    theta = bent_theta(5, rng)
    theta[2, column] = value
    health, healths, theta_bar = check(BENT, psf.EKF(), theta, panel)
    np.testing.assert_array_equal(healths[:, 1] != NONE, np.arange(5) == 2)
    np.testing.assert_array_equal(health, healths[2])
    assert health[1] == code
    assert (theta_bar == 0.0).all()


def test_the_health_is_that_of_the_first_failing_record_in_the_order_of_rows():
    """Not that of the longest, which is evaluated first, nor of the one that fails first."""
    rng = np.random.default_rng(8)
    panel = table([2, 4, 9], rng, p=2, n_inputs=2)
    theta = bent_theta(3, rng)
    theta[1, A], theta[2, V] = 60.0, -5.0
    health, healths, _ = check(BENT, psf.EKF(), theta, panel)
    np.testing.assert_array_equal(health, healths[1])
    assert healths[2, 1] == PROCESS_NOISE


def test_value_and_gradient_are_those_of_the_tape():
    rng = np.random.default_rng(10)
    panel, theta = table([3, 9, 6], rng, p=2, n_inputs=2), bent_theta(3, rng)
    bars = rng.normal(size=len(panel[0]))
    terms, health, theta_bar = together(BENT, psf.EKF(), theta, panel, bars)
    value = evaluator(LogLikelihood(BENT, psf.EKF(), PANEL))(theta, *panel)
    gradient = evaluator(LogLikelihoodGradient(BENT, psf.EKF(), PANEL))(theta, *panel, bars)
    for found, expected in zip([*value, *gradient], [terms, health, theta_bar], strict=True):
        np.testing.assert_array_equal(found, expected)


def test_the_tape_grows_with_the_rows_and_not_with_the_steps_between_them():
    sizes = []
    for gap in (2, STRETCH):
        rows = np.array([(0, gap * step, 0) for step in range(50)])
        panel = rows, np.zeros((50, 1)), np.zeros((0, 0)), T0, SEED
        *_, tape = evaluator(TapedLogLikelihood(WELL, psf.UKF(), PANEL))(np.ones((1, 1)), *panel)
        sizes.append(tape.size)
    assert sizes == [50 * 2 * LANES] * 2


def test_systems_too_large_for_lanes_have_the_bits_of_single_records(monkeypatch):
    def too_large(*arguments):
        raise NotUnrollableError

    monkeypatch.setattr(gaussian_functions, "lane_functions", too_large)
    system = psf.StateSpaceModel(
        transition=lambda x, q, u, a: [a * x[0] * (1.0 - x[0] ** 2) + u[0] + q[0]],
        process_noise=[[0.1]],
        observation=lambda x: [x[0]],
        observation_noise=[[0.2]],
        initial_mean=[0.5],
        initial_cov=[[0.3]],
        inputs=["force"],
    )
    rng = np.random.default_rng(11)
    panel = table([3, 9, 6], rng, n_inputs=1, own_inputs=True)
    theta, bars = rng.uniform(0.5, 1.0, size=(3, 1)), rng.normal(size=len(panel[0]))
    for slope in (0.8, -1e6):
        theta[1] = slope
        terms, health, theta_bar = together(system, psf.EKF(), theta, panel, bars)
        expected, healths, expected_bar = alone(system, psf.EKF(), theta, panel, bars)
        np.testing.assert_array_equal(terms, expected)
        np.testing.assert_array_equal(health, healths[1])
        np.testing.assert_array_equal(theta_bar, expected_bar * (slope > 0.0))
    value = evaluator(LogLikelihood(system, psf.EKF(), PANEL))(theta, *panel)
    for found, taped in zip(value, (terms, health), strict=True):
        np.testing.assert_array_equal(found, taped)
