"""Parameters without a standard error: at a bound, on a staircase, hidden by noise."""

from itertools import product

import numpy as np
import pymc as pm
import pytest
from scipy.linalg import expm
from scipy.optimize import minimize
from scipy.stats import norm, poisson

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.point_estimation.estimate import Peak
from pymc_statespace_filters.point_estimation.maximum_likelihood import errors_of
from pymc_statespace_filters.point_estimation.noisy import maximize_estimated
from pymc_statespace_filters.point_estimation.smooth import _Local, _trusted_gains
from pymc_statespace_filters.sampling.starts.annealing import Population

YEARS = np.arange(40)


def test_the_year_of_a_switch_has_an_interval_and_the_others_their_errors():
    """A mean before and one after: the year is known, and the errors are those of two means."""
    data = np.where(YEARS < 17, 0.0, 2.0) + 0.5 * np.random.default_rng(1).standard_normal(40)
    with pm.Model():
        year = pm.Uniform("year", 0, 40)
        low, high = pm.Normal("low", 0, 5), pm.Normal("high", 0, 5)
        pm.Normal("d", pm.math.switch(YEARS < year, low, high), 0.5, observed=data)
        found = psf.maximum_likelihood(random_seed=1)
    split = int(np.ceil(found.estimate["year"]))
    exact = [
        -0.5 * (np.var(data[:s]) * s + np.var(data[s:]) * (40 - s)) / 0.25 for s in range(1, 40)
    ]
    assert split == 1 + int(np.argmax(exact))
    assert found.estimate["year"] == pytest.approx(split - 0.5, abs=0.05)
    assert found.estimate["low"] == pytest.approx(data[:split].mean(), abs=1e-5)
    assert found.standard_errors["low"] == pytest.approx(0.5 / np.sqrt(split), rel=1e-3)
    assert np.isnan(found.standard_errors["year"])
    assert "staircase" in found.reasons["year"]
    low_end, high_end = (
        float(found.reasons["year"].split(word)[1].split()[0].rstrip(","))
        for word in ("from", " to ")
    )
    assert low_end <= found.estimate["year"] <= high_end
    assert high_end - low_end < 4.0


def test_a_ray_that_leaves_the_support_has_gains_without_a_warning():
    """As of counts whose overdispersion vanishes, which the filter treats no more."""
    local = _Local(np.zeros(1), 0.0, np.eye(1), np.zeros(1), -np.eye(1), 0.0)
    probes = np.array([[[1.0], [2.0], [4.0]], [[-1.0], [-2.0], [-4.0]]])

    def density(x):
        return np.where(abs(x[:, 0]) < 3.0, -0.5 * x[:, 0] ** 2, -np.inf)

    gains = _trusted_gains(density, local, probes)
    np.testing.assert_array_equal(gains, [[-0.5, -2.0, -np.inf]] * 2)


def test_a_curvature_at_a_bound_is_no_standard_error():
    """On a log scale the likelihood may curve at 4e-9 of a spread of 0.1: the bound is zero."""
    peak = Peak(
        np.array([np.log(4e-9), 0.5]), -10.0, 0.0, np.diag([10.0, 0.1]), (), -np.eye(2),
        np.zeros((2, 2)), (),
    )  # fmt: skip
    population = np.random.default_rng(1).normal([-2.5, 0.5], [0.5, 0.1], (200, 2))
    errors = errors_of(
        lambda x: {"scale": np.exp(x[0]), "mean": x[1]}, peak, population, ["scale", "mean"]
    )
    assert list(errors.reasons) == ["scale"]
    assert "at a bound of its support" in errors.reasons["scale"]
    assert np.isnan(errors.covariance[0]).all()
    assert errors.covariance[1, 1] == pytest.approx(0.01)


def test_a_maximum_that_the_noise_hides_has_no_simulation_error():
    """The second parameter has a curvature of 0.05 or 10 under noise of 1.5 nats.

    Where the maximum is found, it lies within its errors of the truth at 0.3; one score of the 16
    may exceed 3, as the errors are those of a quadratic.
    """
    n_found, reported = {0.05: 0, 10.0: 0}, []
    for second, seed in product(n_found, range(8)):
        curvature, rng = np.array([100.0, second]), np.random.default_rng(seed)

        def estimated(x, curvature=curvature, rng=rng):
            exact = -0.5 * (curvature * (x - 0.3) ** 2).sum(axis=1)
            return exact + 1.5 * rng.standard_normal(len(x)) - 1.125

        x = 0.3 + rng.standard_normal((256, 2)) / np.sqrt(curvature + 1)
        peak = maximize_estimated(estimated, Population(x, np.zeros(256), estimated(x)), rng)
        simulation = errors_of(lambda x: {"x": x}, peak, x, ["a", "b"]).simulation
        found = any("displaces it" in note for note in peak.notes)
        assert found == np.isfinite(simulation).all() == np.isfinite(simulation).any()
        assert bool(peak.lost) == any("the maximum was not found" in note for note in peak.notes)
        n_found[second] += found
        if found:
            reported += [*((peak.point - 0.3) / simulation)]
    assert n_found[0.05] <= 1
    assert n_found[10.0] >= 4
    assert (np.abs(reported) > 3.0).sum() <= 1


COUNTS = np.array([9, 11, 8, 12, 10, 9, 10, 11, 9, 12])


def _counts():
    """The negative binomial of infinite alpha is Poisson's."""
    mean = pm.LogNormal("mean", 2, 1)
    pm.NegativeBinomial("y", mean, pm.HalfNormal("alpha", 10), observed=COUNTS)
    log_likelihood = poisson.logpmf(COUNTS, COUNTS.mean()).sum()
    return "alpha", COUNTS.mean(), np.sqrt(COUNTS.mean() / 10), log_likelihood


def _one_observation():
    """Student's distribution of infinite nu is normal."""
    mean = pm.Normal("mean", 0, 5)
    pm.StudentT("y", pm.HalfNormal("nu", 20), mu=mean, sigma=1.0, observed=[0.3])
    return "nu", 0.3, 1.0, norm.logpdf(0.0)


@pytest.mark.parametrize("case", [_counts, _one_observation])
def test_a_likelihood_that_levels_off_is_that_of_its_limit(case):
    """Far out the log-density has no digits of the likelihood, and this at last none either."""
    with pm.Model():
        name, mean, error, log_likelihood = case()
        found = psf.maximum_likelihood(random_seed=1)
    assert found.log_likelihood == pytest.approx(log_likelihood, abs=1e-5)
    assert found.estimate["mean"] == pytest.approx(mean, abs=1e-4)
    assert found.standard_errors["mean"] == pytest.approx(error, rel=1e-3)
    assert list(found.reasons) == [name]
    assert f"the likelihood levels off as {name} grows" in found.reasons[name]
    assert found.notes == ()


def test_a_record_that_the_model_fits_exactly_is_named():
    with pm.Model():
        pm.Normal("y", pm.Normal("mu", 0, 5), pm.HalfNormal("s", 1), observed=np.full(20, 2.0))
        with pytest.raises(ModelError, match="no bound towards the lower end of s"):
            psf.maximum_likelihood(random_seed=1)


def test_a_matrix_exponential_is_no_staircase():
    """An oscillator at uneven times; the exact likelihood is Kalman's."""
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.1, 0.6, 60))
    state, data = np.zeros(2), np.empty(60)
    steps = _exact_steps(4.0, 0.3, times)
    for j, (phi, cov) in enumerate(zip(*steps, strict=True)):
        state = phi @ state + np.linalg.cholesky(cov) @ rng.standard_normal(2)
        data[j] = state[0] + 0.1 * rng.standard_normal()
    system = psf.StateSpaceModel(
        transition=psf.ExactLinear(lambda w2, c: [[0.0, 1.0], [-w2, -c]], [[0.0], [0.5]], dt=1.0),
        observation=lambda x: x[0], observation_noise=0.01,
        initial_mean=[0.0, 0.0], initial_cov=0.1 * np.eye(2),
    )  # fmt: skip
    with pm.Model():
        pm.LogNormal("w2", 1, 1)
        pm.HalfNormal("c", 1)
        psf.StateSpace("d", system, psf.EKF(), times=times, observed=data)
        found = psf.maximum_likelihood(random_seed=1)

    def exact(point):
        return -_kalman(*_exact_steps(*point, times), data)

    point = minimize(exact, [4.0, 0.3], method="Nelder-Mead", options={"xatol": 1e-6}).x
    moves, h = 1e-3 * np.eye(2), 1e-3
    information = [
        [
            sum(s * t * exact(point + s * a + t * b) for s in (1, -1) for t in (1, -1)) / (4 * h**2)
            for a in moves
        ]
        for b in moves
    ]
    errors = np.sqrt(np.diag(np.linalg.inv(information)))
    assert dict(found.reasons) == {}
    for name, value, error in zip(("w2", "c"), point, errors, strict=True):
        assert found.estimate[name] == pytest.approx(value, abs=1e-3 * error)
        assert found.standard_errors[name] == pytest.approx(error, rel=1e-3)


def _exact_steps(w2, c, times):
    """Transition matrices and covariances (60, 2, 2), by the blocks of Van Loan (1978)."""
    a, zero = np.array([[0.0, 1.0], [-w2, -c]]), np.zeros((2, 2))
    block = np.block([[-a, np.diag([0.0, 0.25])], [zero, a.T]])
    e = expm(np.diff(times, prepend=0.0)[:, None, None] * block)
    phi = e[:, 2:, 2:].mT
    return phi, phi @ e[:, :2, 2:]


def _kalman(phi, cov, data):
    mean, p, total = np.zeros(2), 0.1 * np.eye(2), 0.0
    for f, q, y in zip(phi, cov, data, strict=True):
        mean, p = f @ mean, f @ p @ f.T + q
        variance = p[0, 0] + 0.01
        total -= 0.5 * (np.log(2 * np.pi * variance) + (y - mean[0]) ** 2 / variance)
        gain = p[:, 0] / variance
        mean, p = mean + gain * (y - mean[0]), p - np.outer(gain, p[0])
    return total
