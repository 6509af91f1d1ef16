"""PFEnKF against the same equations in NumPy, and against the exact likelihood."""

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from pymc_statespace_filters.compiler.numerics.normals import uniform
from pymc_statespace_filters.compiler.numerics.philox import RESAMPLING
from pymc_statespace_filters.filters.pf_enkf import PFEnKF
from tests.filters.ensemble_contract import (
    LINE,
    OSCILLATOR,
    EnsembleFilterContract,
    forecasts,
    kalman,
    linear,
    log_gaussian,
    normals,
    run,
)
from tests.references.records import BROAD_DOUBLE_WELL, broad_double_well
from tests.systems import DOUBLE_WELL_SYSTEM, double_well_parameters, log_likelihoods


class TestPFEnKF(EnsembleFilterContract):
    @pytest.fixture
    def filter_(self):
        return PFEnKF(200)


def kernel_density(X, w, V):
    """Log of sum_l w_l |H|^-1 K(H^-1 (x_l - v)) at the columns of V (Eqs. 4.36, 4.38, 4.39)."""
    n = X.shape[0]
    n_effective = 1 / np.sum(w**2)
    cov = np.cov(X, aweights=w).reshape(n, n)  # over 1 - sum w^2
    kernel = multivariate_normal(np.zeros(n), cov * n_effective ** (-2 / (n + 4)))
    differences = (V.T[:, None, :] - X.T[None, :, :]).reshape(-1, n)
    log_k = kernel.logpdf(differences).reshape(V.shape[1], X.shape[1])
    return logsumexp(log_k + np.log(w), axis=1)


def numpy_pf_enkf(system, steps, observed, N, seed, likelihood, resample_below):
    """Eqs. 4.29-4.44 in NumPy, with systematic resampling."""
    H, R = system.C, system.R
    X, terms, w, equal = None, [], np.full(N, 1 / N), np.full(N, 1 / N)
    for step, (start, advance, noise), d in zip(
        steps, forecasts(system, N, steps, seed), observed, strict=True
    ):
        X = advance(start if X is None else X)
        seen = ~np.isnan(d)
        if not seen.any():
            terms.append(0.0)
            continue

        def log_p(states, d=d, seen=seen):
            return log_gaussian((d[:, None] - H @ states)[seen], np.diag(R)[seen])

        D = (H @ X + noise)[seen]
        covariance = np.cov(np.concatenate([X, D]), aweights=w)
        n = len(X)
        K = covariance[:n, n:] @ np.linalg.inv(covariance[n:, n:])
        X_a = X + K @ (d[seen][:, None] - D)
        log_w = np.log(equal) + log_p(X_a)
        log_w += kernel_density(X, w, X_a) - kernel_density(X_a, equal, X_a)
        new = np.exp(log_w - logsumexp(log_w))
        terms.append(
            {
                "predictive": logsumexp(np.log(w) + log_p(X)),
                "weights": logsumexp(log_w),
            }[likelihood]
        )
        X, w = X_a, new
        if 1 / np.sum(w**2) < resample_below * N:
            points = (np.arange(N) + uniform(*normals(seed, RESAMPLING, step, (1, 2))[0])) / N
            X = X[:, np.searchsorted(np.cumsum(w), points, side="right")]
            w = equal
    return np.array(terms)


@pytest.mark.parametrize(
    ("likelihood", "resample_below"),
    [("predictive", 0.9), ("weights", 0)],
)
def test_is_its_equations_written_in_numpy(likelihood, resample_below):
    filter_ = PFEnKF(150, likelihood=likelihood, resample_below=resample_below)
    for seed in range(2):
        expected = numpy_pf_enkf(*OSCILLATOR, 150, seed, likelihood, resample_below)
        terms, health = run(filter_, *OSCILLATOR, seed=seed)
        assert terms == pytest.approx(expected, rel=1e-8)
        assert health[1:].tolist() == [0, -1]


def test_approaches_kalman():
    exact = kalman(*LINE).sum()
    filter_ = PFEnKF(1000, likelihood="weights")
    errors = np.array([run(filter_, *LINE, seed=s)[0].sum() - exact for s in range(40)])
    # the kernel's smoothing leaves a bias of some hundredths; 4 standard errors of the mean
    assert abs(errors.mean()) < 0.05 + 4 * errors.std() / np.sqrt(40)
    assert errors.std() < 0.3


def test_approaches_the_truth_where_weights_repair_a_wrong_update():
    """Never resampled, so that ten observations must carry them; the update is 1.5 nats off."""
    steps, observed = (rows[:10] for rows in broad_double_well())
    exact = BROAD_DOUBLE_WELL.point_mass_filter().run(steps, observed).terms.sum()
    filter_ = PFEnKF(500, likelihood="weights", resample_below=0.0)
    arguments = filter_, double_well_parameters(BROAD_DOUBLE_WELL), np.arange(12)
    found = log_likelihoods(DOUBLE_WELL_SYSTEM, *arguments, observed=observed, steps=steps)
    errors = found - exact
    assert abs(errors.mean()) < 0.3 + 4 * errors.std() / np.sqrt(12)
    assert errors.std() < 0.3


def test_without_any_spread_it_is_the_bootstrap_filter():
    # No noise and no spread at the start: all particles are one, and the proposal moves nothing
    system = linear([[1.0]], [[0.0]], [[1.0]], [[0.5]], [2.0], [[0.0]])
    steps, observed = np.arange(3), np.array([[1.5], [2.5], [2.0]])
    exact = kalman(system, steps, observed)
    terms, health = run(PFEnKF(100, likelihood="weights"), system, steps, observed)
    assert terms == pytest.approx(exact, rel=1e-10)
    assert health == pytest.approx([100, 0, -1])


def test_a_state_known_exactly_does_not_spoil_the_densities():
    plain_system, steps, observed = LINE
    with_clock = linear(
        np.diag([0.9, 1.0]), [[0.5], [0.0]], [[1.0, 0.0]], [[0.3]], [1.0, 7.1], np.diag([0.7, 0.0])
    )
    filter_ = PFEnKF(1000, likelihood="weights")
    plain, _ = run(filter_, plain_system, steps, observed)
    clocked, _ = run(filter_, with_clock, steps, observed)
    assert clocked == pytest.approx(plain, rel=1e-9)


def test_total_degeneracy_goes_on_with_bootstrap_weights():
    # A sensor of sd 1e-4 and 20 particles, never resampled: one particle has all the weight at once
    system = linear([[1.0]], [[1.0]], [[1.0]], [[1e-8]], [0.0], [[1.0]])
    steps, observed = np.arange(6), np.linspace(0, 3, 6)[:, None]
    terms, health = run(PFEnKF(20, resample_below=0), system, steps, observed)
    assert np.all(np.isfinite(terms))
    assert 1 <= health[0] < 20
    assert health[1] == 0
