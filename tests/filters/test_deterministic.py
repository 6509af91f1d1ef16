"""Systems without noise whose start is known: an exact likelihood by one run of the equations."""

from functools import cache, partial

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr
from scipy import stats
from scipy.linalg import expm

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice.refusals import alternatives
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.errors import FilterWarning
from pymc_statespace_filters.filters.checks import check_choice
from pymc_statespace_filters.filters.outcomes import STATE_NOT_FINITE
from pymc_statespace_filters.ops.base import evaluator, kernel
from pymc_statespace_filters.ops.likelihood import (
    LogLikelihood,
    LogLikelihoodGradient,
    TapedLogLikelihood,
    TapePullback,
)
from pymc_statespace_filters.ops.signatures import POINTS
from pymc_statespace_filters.ops.states import FilterRun, States

STEPS = np.array([0, 3, 4, 9])
OBSERVED = np.array([[0.5, -0.2], [np.nan, 0.4], [np.nan, np.nan], [0.1, 0.3]])
FORCE = np.random.default_rng(1).normal(size=(10, 1))
NOISE = np.array([[0.3, 0.1], [0.1, 0.2]])
GAUSSIAN = (psf.EKF(), psf.UKF(), psf.IPLF())


def drift(x, u, t, stiffness, bend):
    """A pendulum with a spring, pushed by an input and by time."""
    return [x[1], u[0] + pt.cos(t) - stiffness * x[0] - bend * pt.sin(x[0]) - 0.3 * x[1]]


def oscillator(**changes):
    settings = {
        "transition": psf.RungeKutta4(drift, dt=0.2),
        "observation": lambda x, c: [x[0] + c * x[1] ** 2, pt.exp(0.3 * x[1])],
        "observation_noise": NOISE,
        "initial_mean": lambda start: [start, -0.1],
        "initial_cov": np.zeros((2, 2)),
        "inputs": ["force"],
    }
    return psf.StateSpaceModel(**settings | changes)


KNOWN = oscillator()
UNKNOWN = oscillator(initial_cov=lambda spread: spread * pt.eye(2))
THETA = {"stiffness": 1.3, "bend": 0.6, "c": 0.4, "start": 0.7}
T0 = 0.5
RECORD = (STEPS, OBSERVED, FORCE, T0, np.uint64(0))
ROWS = np.arange(10)


def theta_of(**changes):
    return np.array([(THETA | changes)[name] for name in KNOWN.parameters])


@cache
def compiled(kind, system, *arguments):
    return evaluator(kind(system, psf.EKF(), *arguments))


def path(theta):
    """The states at all steps, by the textbook's four stages; of complex parameters too."""
    stiffness, bend, _, start = (theta[KNOWN.parameters.index(name)] for name in THETA)

    def f(x, t, u):
        return np.array([x[1], u + np.cos(t) - stiffness * x[0] - bend * np.sin(x[0]) - 0.3 * x[1]])

    states = [np.array([start, -0.1])]
    for k, u in enumerate(FORCE[:-1, 0]):
        x, t, h = states[-1], T0 + 0.2 * k, 0.2
        a = f(x, t, u)
        b = f(x + h / 2 * a, t + h / 2, u)
        c = f(x + h / 2 * b, t + h / 2, u)
        d = f(x + h * c, t + h, u)
        states.append(x + h / 6 * (a + 2 * b + 2 * c + d))
    return np.array(states)


def terms_of(theta):
    """log p(d | x) of every observation, component by component that is not missing."""
    c = theta[KNOWN.parameters.index("c")]
    terms = []
    for x, d in zip(path(theta)[STEPS], OBSERVED, strict=True):
        seen = ~np.isnan(d)
        residual = (d - np.array([x[0] + c * x[1] ** 2, np.exp(0.3 * x[1])]))[seen]
        cov = NOISE[np.ix_(seen, seen)]
        log_det = np.linalg.slogdet(2 * np.pi * cov)[1]
        terms.append(-0.5 * (residual @ np.linalg.solve(cov, residual) + log_det))
    return np.array(terms)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, True),
        ({"initial_cov": lambda bend: 0.0 * bend * pt.eye(2)}, True),
        ({"initial_cov": lambda: pt.zeros((2, 2))}, True),
        ({"initial_cov": lambda spread: spread * pt.eye(2)}, False),
        ({"initial_cov": [[0.0, 0.0], [0.0, 0.1]]}, False),
        ({"transition": psf.RungeKutta4(drift, np.zeros((2, 1)), dt=0.2)}, True),
        ({"transition": psf.RungeKutta4(drift, [[0.0], [0.1]], dt=0.2)}, False),
        ({"transition": psf.RungeKutta4(drift, lambda bend: [[0.0], [bend]], dt=0.2)}, False),
        ({"transition": lambda x, q: x + q, "process_noise": np.zeros((2, 2))}, True),
        ({"transition": lambda x, q: x + q, "process_noise": lambda s: s * pt.eye(2)}, False),
    ],
)
def test_a_deterministic_system_is_recognised(changes, expected):
    assert compile_system(oscillator(**changes)).is_deterministic is expected


def test_many_states_are_recognised_too():
    """Their covariance has more elements than are written out one by one."""
    system = oscillator(
        transition=lambda x: 0.9 * x, inputs=(),
        initial_mean=np.ones(50), initial_cov=np.zeros((50, 50)),
    )  # fmt: skip
    assert compile_system(system).is_deterministic


def test_a_guide_can_be_written_out_without_process_noise():
    """`GuidedPF` treats equations without noise whose start is not known."""
    system = compile_system(decay(transition=lambda x: 0.9 * x, initial_cov=1.0))
    assert system.m == 0
    assert system.entry_point("look_back").key


def test_the_gaussian_filters_are_one():
    for kind in (LogLikelihood, TapePullback, FilterRun, partial(LogLikelihood, form=POINTS)):
        first, *others = (kernel(kind(KNOWN, filter)).key for filter in GAUSSIAN)
        assert others == [first, first]


def test_the_value_is_that_of_the_equations_and_only_the_state_is_carried():
    terms, health, tape = compiled(TapedLogLikelihood, KNOWN)(theta_of(), *RECORD)
    np.testing.assert_allclose(terms, terms_of(theta_of()), rtol=1e-12)
    np.testing.assert_array_equal(health, [np.inf, 0.0, -1.0])
    assert tape.shape == (STEPS[-1] + len(STEPS), 2)


def test_the_gradient_is_that_of_the_equations():
    bars = np.array([1.0, -2.0, 0.5, 3.0])
    _, _, tape = compiled(TapedLogLikelihood, KNOWN)(theta_of(), *RECORD)
    (found,) = compiled(TapePullback, KNOWN)(theta_of(), *RECORD, tape, bars)
    points = theta_of() + 1e-30j * np.eye(4)
    truth = [(terms_of(point) @ bars).imag / 1e-30 for point in points]
    np.testing.assert_allclose(found, truth, rtol=1e-11)


def test_many_points_side_by_side():
    points = theta_of() * np.linspace(0.8, 1.2, 5)[:, None]
    terms, health = evaluator(LogLikelihood(KNOWN, psf.EKF(), POINTS))(points, *RECORD)
    np.testing.assert_allclose(terms, [terms_of(point) for point in points], rtol=1e-12)
    np.testing.assert_array_equal(health[:, 1], 0.0)


def test_states_are_the_path_without_spread():
    found = States(KNOWN, psf.EKF(), "smoothed")
    mean, sd, drawn, n_effective, health = evaluator(found)(theta_of(), *RECORD, ROWS, 3)
    np.testing.assert_allclose(mean, path(theta_of()), rtol=1e-12)
    np.testing.assert_array_equal(drawn, mean)
    np.testing.assert_array_equal(sd, 0.0)
    assert (n_effective == np.inf).all()
    np.testing.assert_array_equal(health, [np.inf, 0.0, -1.0])
    for moment in ("predicted", "filtered"):
        assert kernel(States(KNOWN, psf.EKF(), moment)).key == kernel(found).key


def test_a_run_is_the_path_without_covariance():
    rows = ROWS[::2]
    run = compiled(FilterRun, KNOWN)(theta_of(), *RECORD, rows, np.empty(0))
    terms, _, mean, cov, members, *_ = run
    np.testing.assert_allclose(terms, terms_of(theta_of()), rtol=1e-12)
    np.testing.assert_allclose(mean, path(theta_of())[rows], rtol=1e-12)
    np.testing.assert_array_equal(cov, np.zeros((5, 2, 2)))
    assert members.shape == (5, 0, 2)


def test_a_path_that_explodes_fails_from_there_on():
    theta = theta_of(stiffness=-1e200)
    run = compiled(FilterRun, KNOWN)(theta, *RECORD, ROWS, np.empty(0))
    terms, health, mean, cov, *_ = run
    assert np.isfinite(terms[0])
    assert (terms[1:] == -np.inf).all()
    np.testing.assert_array_equal(health[1:], [STATE_NOT_FINITE, 1.0])
    assert np.isnan(mean[-1]).all()
    assert np.isnan(cov[-1]).all()


# Truth in closed form

A = np.array([[-0.7, 0.3], [0.2, -0.5]])
OFFSET = np.array([0.4, 0.0])


def test_a_linear_equation_has_its_closed_form_likelihood():
    """dx = A x + b dt, by 400 steps of fourth order: the value to 1e-8."""
    system = psf.StateSpaceModel(
        transition=psf.RungeKutta4(lambda x: A @ x + OFFSET, dt=0.01),
        observation=lambda x: x, observation_noise=NOISE,
        initial_mean=[2.0, -1.0], initial_cov=np.zeros((2, 2)),
    )  # fmt: skip
    times = np.array([0.0, 0.5, 2.0, 4.0])
    observed = np.array([[1.9, -0.8], [1.6, -0.3], [1.0, 0.4], [0.9, 0.2]])
    rest = -np.linalg.solve(A, OFFSET)
    paths = [rest + expm(A * t) @ ([2.0, -1.0] - rest) for t in times]
    truth = [
        stats.multivariate_normal(path, NOISE).logpdf(d)
        for path, d in zip(paths, observed, strict=True)
    ]
    found = psf.log_likelihood(system, psf.EKF(), {}, observed, times=times)
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=1e-8)


TIMES = np.array([0.0, 0.3, 1.0, 2.5])
DECAY = np.array([3.1, 2.2, 1.0, 0.2])


def decay(**changes):
    settings = {
        "transition": psf.RungeKutta4(lambda x, k: -k * x, dt=0.01),
        "observation": lambda x: x[0],
        "observation_noise": lambda s: s**2,
        "initial_mean": lambda x0: x0,
        "initial_cov": 0.0,
    }
    return psf.StateSpaceModel(**settings | changes)


def test_the_gradient_is_that_of_the_closed_form():
    """x = x0 exp(-k t): slopes by k, x0 and s to 1e-8."""
    k, x0, s = 1.1, 3.0, 0.2
    system, x = decay(), x0 * np.exp(-k * TIMES)
    z = (DECAY - x) / s
    truth = {"k": np.sum(z / s * -TIMES * x), "x0": np.sum(z / s * x / x0)}
    truth["s"] = np.sum(z**2 - 1.0) / s
    theta = np.array([{"k": k, "x0": x0, "s": s}[name] for name in system.parameters])
    steps = np.round(TIMES / 0.01).astype(np.int64)
    (found,) = compiled(LogLikelihoodGradient, system)(
        theta, steps, DECAY[:, None], np.zeros((251, 0)), 0.0, 0, np.ones(4)
    )
    np.testing.assert_allclose(found, [truth[name] for name in system.parameters], atol=1e-8)


def test_boluses_enter_by_input_rows():
    """One compartment with absorption, doses at 0 and 1.5 hours: the closed form to 1e-8."""
    between = psf.RungeKutta4(lambda x, ka, k: [-ka * x[0], ka * x[0] - k * x[1]], dt=0.005)

    def step(x, u, t, ka, k):
        dosed = {"x": x + pt.stack([u[0], 0.0]), "t": t, "q": pt.zeros(0)}
        return between.step(dosed | {"ka": ka, "k": k})

    system = psf.StateSpaceModel(
        transition=step, dt=0.005, observation=lambda x: x[1], observation_noise=0.01,
        initial_mean=[0.0, 0.0], initial_cov=np.zeros((2, 2)), inputs=["dose"],
    )  # fmt: skip
    ka, k, times, doses = 1.4, 0.3, np.array([0.5, 1.5, 2.0, 4.0]), np.zeros((800, 1))
    doses[[0, 300], 0] = 3.0, 2.0

    def after(t, dose):
        t = np.maximum(t, 0.0)
        return dose * ka / (ka - k) * (np.exp(-k * t) - np.exp(-ka * t))

    observed = np.array([1.1, 1.8, 2.5, 1.6])
    truth = stats.norm.logpdf(observed, after(times, 3.0) + after(times - 1.5, 2.0), 0.1)
    params = {"ka": ka, "k": k}
    found = psf.log_likelihood(system, psf.EKF(), params, observed, times=times, inputs=doses)
    np.testing.assert_allclose(found, truth, rtol=0.0, atol=1e-8)


def test_predictions_have_the_noise_of_the_sensor_alone():
    draws = xr.DataTree.from_dict(
        {"posterior": xr.Dataset({n: (("chain", "draw"), [[v, v]]) for n, v in THETA.items()})}
    )
    with pm.Model():
        for name in THETA:
            pm.Normal(name)
        psf.StateSpace("d", KNOWN, psf.EKF(), steps=STEPS, observed=OBSERVED, inputs=FORCE, t0=T0)
        found = psf.filter_diagnostics(draws, random_seed=1)["filter_diagnostics"]
    x = path(theta_of())[STEPS]
    seen = np.column_stack([x[:, 0] + THETA["c"] * x[:, 1] ** 2, np.exp(0.3 * x[:, 1])])
    np.testing.assert_allclose(found["d_innovation"], OBSERVED - seen, rtol=1e-10, atol=1e-12)
    cov = np.broadcast_to(NOISE, (4, 2, 2))
    np.testing.assert_allclose(found["d_innovation_cov"], cov, rtol=1e-12)


# Observations of any kind

COUNTED = decay(
    observation=None,
    observation_noise=None,
    observation_dist=lambda x: [pm.Poisson.dist(x[0]), pm.NegativeBinomial.dist(x[0], 2.0)],
)
COUNTS = np.array([[4.0, 2.0], [1.0, 3.0], [np.nan, np.nan], [0.0, 1.0]])


def test_counts_have_their_own_density_and_its_gradient():
    value = compiled(LogLikelihood, COUNTED)
    record = (10 * np.arange(4), COUNTS, np.zeros((31, 0)), 0.0, 0)
    theta = np.array([2.0, 3.0])  # k, x0

    def total(k, x0):
        return value(np.array([k, x0]), *record)[0]

    mean = 3.0 * np.exp(-0.2 * np.arange(4))
    truth = stats.poisson.logpmf(COUNTS[:, 0], mean)
    truth += stats.nbinom.logpmf(COUNTS[:, 1], 2.0, 2.0 / (2.0 + mean))
    np.testing.assert_allclose(total(*theta), np.nan_to_num(truth), atol=1e-8)
    _, _, tape = compiled(TapedLogLikelihood, COUNTED)(theta, *record)
    (slope,) = compiled(TapePullback, COUNTED)(theta, *record, tape, np.ones(4))
    h = 1e-5
    by_difference = [
        (total(2.0 + h, 3.0) - total(2.0 - h, 3.0)).sum() / (2 * h),
        (total(2.0, 3.0 + h) - total(2.0, 3.0 - h)).sum() / (2 * h),
    ]
    np.testing.assert_allclose(slope, by_difference, rtol=1e-7)


def test_a_log_density_and_a_carried_state_are_taken():
    system = decay(
        observation=None, observation_noise=None, states=["amount"], carried=["amount"],
        observation_logp=lambda d, x: -pt.abs(d[0] - x[0]),
    )  # fmt: skip
    terms = psf.log_likelihood(system, psf.EKF(), {"k": 0.0, "x0": 3.0}, [1.0, 5.0], steps=[0, 2])
    np.testing.assert_allclose(terms, [-2.0, -2.0])


# Recommendations


@pytest.mark.parametrize("filter", [psf.BootstrapPF(10), psf.EnKF(10)], ids=repr)
def test_members_that_are_all_the_same_are_warned_of(filter):
    with pytest.warns(FilterWarning, match=r"all members are the same. Use EKF\(\)"):
        check_choice(KNOWN, filter)
    check_choice(UNKNOWN, filter)
    check_choice(KNOWN, psf.EKF())


def test_the_filter_for_equations_without_noise_is_the_ekf():
    for system in (KNOWN, COUNTED):
        compiled_system = compile_system(system)
        assert psf.EKF().is_exact_for(compiled_system)
        said = alternatives(compiled_system, psf.BootstrapPF(10))
        assert said == "this system can be treated by EKF() (exact)"
    assert not psf.EKF().is_exact_for(compile_system(UNKNOWN))


def test_noise_inside_the_observation_is_not_exact():
    bent = oscillator(observation=lambda x, e: [x[0] * pt.exp(e[0]), x[1] + e[1]])
    assert compile_system(bent).is_deterministic
    assert not psf.EKF().is_exact_for(compile_system(bent))
