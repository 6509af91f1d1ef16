"""The extended Kalman filter is exact on linear systems."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references.records import (
    OSCILLATOR,
    LinearSystem,
    oscillator_with_gaps,
)
from tests.systems import (
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
