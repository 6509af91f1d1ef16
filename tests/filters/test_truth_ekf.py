"""The extended Kalman filter is exact on linear systems, and its gradient is the derivative."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood, LogLikelihoodGradient
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references import scan_oracle
from tests.references.records import (
    OSCILLATOR,
    DoubleWell,
    LinearSystem,
    double_well,
    oscillator_with_gaps,
)
from tests.systems import (
    DOUBLE_WELL_SYSTEM,
    DUFFING,
    double_well_parameters,
    linear_system,
)

pytestmark = pytest.mark.usefixtures("interpreted")

SCALAR = LinearSystem(
    A=np.array([[0.93]]),
    B=np.array([[0.4]]),
    C=np.array([[1.7]]),
    R=np.array([[0.3]]),
    mean=np.array([0.8]),
    cov=np.array([[0.5]]),
)
# Rank-one process noise in four states, known start in two of them, three correlated sensors.
MULTIVARIATE = LinearSystem(
    A=0.95 * np.linalg.qr(np.random.default_rng(2).normal(size=(4, 4)))[0],
    B=np.random.default_rng(3).normal(size=(4, 1)),
    C=np.random.default_rng(4).normal(size=(3, 4)),
    R=np.array([[0.5, 0.2, 0.0], [0.2, 0.6, -0.1], [0.0, -0.1, 0.4]]),
    mean=np.array([1.0, 0.0, -1.0, 0.5]),
    cov=np.diag([0.0, 0.7, 0.0, 0.3]),
)


def gappy_record(n_observables: int, first_step: int) -> tuple[np.ndarray, np.ndarray]:
    """Thirty irregular observations with every second component missing at random."""
    rng = np.random.default_rng(n_observables)
    steps = first_step + np.concatenate([[0], np.cumsum(rng.integers(1, 6, size=29))])
    observed = rng.normal(scale=2.0, size=(30, n_observables))
    observed[rng.random(observed.shape) < 0.4] = np.nan
    return steps, observed


@pytest.mark.parametrize(
    ("reference", "record"),
    [
        (SCALAR, gappy_record(1, first_step=0)),
        (SCALAR, gappy_record(1, first_step=4)),
        (OSCILLATOR, oscillator_with_gaps()),
        (OSCILLATOR, gappy_record(2, first_step=4)),
        (MULTIVARIATE, gappy_record(3, first_step=0)),
    ],
    ids=["scalar", "scalar_late", "oscillator", "oscillator_late", "multivariate"],
)
def test_ekf_is_the_kalman_filter_on_linear_systems(reference, record):
    steps, observed = record
    terms = psf.log_likelihood(linear_system(reference), psf.EKF(), {}, observed, steps=steps)
    exact = kalman_log_likelihood(*reference.kalman_arguments(), steps=steps, observed=observed)
    np.testing.assert_allclose(terms, exact, rtol=1e-9, atol=0.0)
    assert terms.sum() == pytest.approx(exact.sum(), rel=1e-9)


def test_ekf_is_the_kalman_filter_with_inputs_and_euler_substeps():
    stiffness, dt, substeps = 3.0, 0.1, 4
    system = psf.StateSpaceModel(
        transition=psf.EulerMaruyama(
            lambda x, u, k: [x[1], -k * x[0] - 0.4 * x[1] + u[0]],
            lambda s: [[0.0], [s]],
            dt=dt,
            substeps=substeps,
        ),
        observation=lambda x, u, c: [x[0] + c * u[0]],
        observation_noise=lambda r: [[r]],
        initial_mean=lambda start: [start, 0.0],
        initial_cov=[[0.2, 0.0], [0.0, 0.0]],
        inputs=["force"],
    )
    steps, observed = gappy_record(1, first_step=0)
    force = np.random.default_rng(8).normal(size=steps[-1] + 1)
    parameters = {"k": stiffness, "s": 0.7, "c": 0.25, "r": 0.15, "start": 0.6}
    terms = psf.log_likelihood(
        system, psf.EKF(), parameters, observed, steps=steps, inputs=force[:, None]
    )

    h = dt / substeps
    one = np.eye(2) + h * np.array([[0.0, 1.0], [-stiffness, -0.4]])
    powers = [np.linalg.matrix_power(one, i) for i in range(substeps)]
    noise = np.diag([0.0, 0.7**2 * h])
    response = sum(powers) @ np.array([0.0, h])
    exact = kalman_log_likelihood(
        np.linalg.matrix_power(one, substeps),
        sum(F @ noise @ F.T for F in powers),
        [[1.0, 0.0]],
        [[0.15]],
        [0.6, 0.0],
        [[0.2, 0.0], [0.0, 0.0]],
        steps=steps,
        observed=observed - 0.25 * force[steps, None],
        forcing=force[:, None] * response,
    )
    np.testing.assert_allclose(terms, exact, rtol=1e-9, atol=0.0)


def duffing_case():
    """An oracle of DUFFING and a point: parameters and gaps wherever there can be."""
    steps, observed = oscillator_with_gaps()
    point = {"k": 1.3, "c": 0.4, "s": 0.7, "b": 0.2, "r": 0.3, "m": 0.5, "v": 0.5}
    k, c, s, b, r, m, v = symbols = [pt.dscalar(name) for name in point]

    def transition(x):
        return pt.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * (-k * x[0] - x[0] ** 3 - c * x[1])])

    oracle = scan_oracle.ekf_log_likelihood(
        transition,
        lambda x: pt.stack([x[0] + b * x[0] ** 2, x[1]]),
        process_cov=pt.diag(pt.stack([0.0, 0.1 * s**2])),
        observation_cov=pt.stack([pt.stack([r, 0.06]), pt.as_tensor([0.06, 0.4])]),
        initial_mean=pt.stack([m, 0.0]),
        initial_cov=pt.stack([pt.stack([v, 0.2 * v]), pt.stack([0.2 * v, 2.0 * v])]),
        steps=steps,
        observed=observed,
    )
    return steps, observed, point, oracle, symbols


def test_gradient_of_one_state_is_that_of_an_independent_scan():
    steps, observed = (rows[:12] for rows in double_well())
    point = double_well_parameters(DoubleWell()) | {"alpha": 3.7, "beta": -4.4, "sigma": 0.8}
    symbols = {name: pt.dscalar(name) for name in point}

    def column(name):
        return pt.reshape(symbols[name], (1,))

    oracle = scan_oracle.ekf_log_likelihood(
        lambda x: x + 0.01 * (symbols["alpha"] * x + symbols["beta"] * x**3),
        lambda x: x,
        process_cov=0.01 * column("sigma")[:, None] ** 2,
        observation_cov=column("noise_var")[:, None],
        initial_mean=column("initial_mean"),
        initial_cov=column("initial_var")[:, None],
        steps=steps,
        observed=observed[:, None],
    )
    true_value, true_gradient = scan_oracle.value_and_gradient(
        oracle, {symbol: point[name] for name, symbol in symbols.items()}
    )
    theta = np.array(list(point.values()))
    record = theta, steps, observed[:, None], np.zeros((0, 0)), np.array(0.0), np.array(0)
    terms, _ = evaluator(LogLikelihood(DOUBLE_WELL_SYSTEM, psf.EKF()))(*record)
    kind = LogLikelihoodGradient(DOUBLE_WELL_SYSTEM, psf.EKF())
    (gradient,) = evaluator(kind)(*record, np.ones(len(steps)))
    assert terms.sum() == pytest.approx(true_value, rel=1e-10)
    np.testing.assert_allclose(gradient, true_gradient, rtol=1e-10)


def test_gradient_in_a_pymc_model_is_that_of_an_independent_scan():
    steps, observed, point, oracle, symbols = duffing_case()
    with pm.Model() as model:
        for name in point:
            pm.Flat(name)  # no density of its own: the model's gradient is the likelihood's
        psf.StateSpace("d", DUFFING, psf.EKF(), steps=steps, observed=observed)
    # Together, as in a sampler: alone each would be compiled with a forward pass of its own.
    both = model.compile_fn([model.logp(), model.dlogp()])

    def value(point):
        return both(point)[0]

    found = both(point)
    true_value, true_gradient = scan_oracle.value_and_gradient(
        oracle, dict(zip(symbols, point.values(), strict=True))
    )
    assert found[0] == pytest.approx(true_value, rel=1e-10)
    np.testing.assert_allclose(found[1], true_gradient, rtol=1e-10)

    def slope(name):
        h = 1e-5 * abs(point[name])
        return (value(point | {name: point[name] + h}) - value(point | {name: point[name] - h})) / (
            2.0 * h
        )

    np.testing.assert_allclose(found[1], [slope(name) for name in point], rtol=1e-6)
