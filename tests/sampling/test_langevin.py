"""Langevin moves of a population: metric and points are exact for a normal density."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from pytensor import wrap_py
from scipy.stats import chi2, kstest

import pymc_statespace_filters as psf
from pymc_statespace_filters.sampling.starts.langevin import (
    curvature_factor,
    metric_factor,
    settle,
)
from pymc_statespace_filters.sampling.starts.local_scale import local_cov
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from pymc_statespace_filters.sampling.target.target import Target
from tests.systems import FREE

DIM = 20


def normal(seed=1, dim=DIM):
    """Mean, covariance, and log-density with gradient of a correlated normal distribution."""
    rng = np.random.default_rng(seed)
    chol = np.tril(rng.standard_normal((dim, dim))) + 3.0 * np.eye(dim)
    chol *= np.exp(rng.uniform(-5, 5, dim))[:, None]
    mean, cov = rng.standard_normal(dim), chol @ chol.T
    precision = np.linalg.inv(cov)

    def evaluate(x):
        gradient = -(x - mean) @ precision
        return 0.5 * (gradient * (x - mean)).sum(axis=1), gradient

    return mean, cov, evaluate


def far_and_narrow(mean, cov, n=128):
    """Points a hundred standard deviations from the mean, of another shape."""
    sd = np.sqrt(np.diag(cov))
    return mean + sd * (100.0 + 0.1 * np.random.default_rng(2).standard_normal((n, len(mean))))


def test_metric_of_a_normal_density_is_its_covariance_wherever_the_points_are():
    mean, cov, evaluate = normal()
    x = far_and_narrow(mean, cov)
    chol = metric_factor(x, evaluate(x)[1])
    np.testing.assert_allclose(chol @ chol.T, cov, rtol=1e-4, atol=1e-6 * np.abs(cov).max())


def test_metric_without_a_gradient_along_a_direction_is_bounded():
    x = np.random.default_rng(3).standard_normal((50, 2))
    chol = metric_factor(x, np.column_stack([-x[:, 0], np.zeros(50)]))
    assert np.isfinite(chol).all()
    assert metric_factor(np.zeros((50, 2)), x) is None


def test_settled_points_have_the_distribution():
    """Squared distances of the last round are chi-squared: Kolmogorov-Smirnov at 0.1 %."""
    mean, cov, evaluate = normal()
    x, log_density = settle(far_and_narrow(mean, cov), evaluate, np.random.default_rng(4))
    assert x.shape == (3 * 128, DIM)
    np.testing.assert_allclose(log_density, evaluate(x)[0])
    assert kstest(-2.0 * log_density[-128:], chi2(DIM).cdf).pvalue > 0.001


def test_curvature_gives_the_metric_of_few_points():
    """Fewer points than dimensions, a hundred standard deviations away."""
    mean, cov, evaluate = normal()
    x = far_and_narrow(mean, cov, n=12)
    chol = curvature_factor(x, lambda x: evaluate(x)[1])
    np.testing.assert_allclose(chol @ chol.T, cov, rtol=1e-4, atol=1e-6 * np.abs(cov).max())
    saddle = np.diag([4.0, -1.0])
    x = np.random.default_rng(7).standard_normal((8, 2))
    chol = curvature_factor(x, lambda x: -x @ saddle)
    np.testing.assert_allclose(chol @ chol.T, [[0.25, 0.0], [0.0, 1.0]], atol=1e-6)
    assert curvature_factor(x, lambda x: np.full_like(x, np.nan)) is None
    assert curvature_factor(x * [1.0, 0.0], lambda x: -x) is None


def test_curvature_at_several_points_is_averaged():
    """3 x^2 of x^4 / 4 at 1 and 2, and 12 of the other; a point without a gradient is left out."""

    def gradients(x):
        return -np.stack([np.where(x[:, 0] < 3.0, x[:, 0] ** 3, np.nan), 12.0 * x[:, 1]], axis=1)

    x = np.random.default_rng(7).standard_normal((8, 2))
    chol = curvature_factor(x, gradients, np.array([[1.0, 5.0], [2.0, 0.0], [3.0, 0.0]]))
    np.testing.assert_allclose(chol @ chol.T, [[1 / 7.5, 0.0], [0.0, 1 / 12]], rtol=1e-6)
    assert curvature_factor(x, gradients, np.array([[3.0, 0.0]])) is None


def test_few_points_settle_too():
    """128 in 60 dimensions: Kolmogorov-Smirnov at 0.1 %, as above."""
    mean, cov, evaluate = normal(dim=60)
    x, log_density = settle(far_and_narrow(mean, cov), evaluate, np.random.default_rng(8))
    assert x.shape == (3 * 128, 60)
    assert kstest(-2.0 * log_density[-128:], chi2(60).cdf).pvalue > 0.001


def test_points_of_no_density_stay_out():
    """Half a normal distribution, with nothing on the other side."""

    def evaluate(x):
        inside = x[:, 0] > 0.0
        return np.where(inside, -0.5 * (x**2).sum(axis=1), -np.inf), -x

    x, _ = settle(
        1.0 + np.random.default_rng(5).random((64, 2)), evaluate, np.random.default_rng(6)
    )
    assert (x[:, 0] > 0.0).all()


def test_the_gradient_is_that_of_the_log_density():
    """Of the EKF that leads a noisy filter, which has no gradient itself."""
    with pm.Model() as model:
        params, filter = {"a": pm.Normal("a")}, psf.BootstrapPF(10)
        psf.StateSpace("d", FREE, filter, params=params, steps=[0, 1, 2], observed=[0.1, -0.4, 0.9])
    target = Target(model, None, RandomWalkSettings())
    assert target.gradient_rows(of_pilot=False) is None
    x, seeds = np.array([[0.3], [0.3 + 1e-6], [0.3 - 1e-6]]), np.zeros((1, 3), dtype=np.int64)
    values = target.pilot_density().at_rows()(x, *seeds)[0]
    results = target.gradient_rows(of_pilot=True)(x, *seeds)
    np.testing.assert_allclose(results[0], values, rtol=1e-10)
    assert results[-1][0, 0] == pytest.approx((values[1] - values[2]) / 2e-6, rel=1e-5)


@pytest.mark.filterwarnings("ignore:Numba will use object mode:UserWarning")
def test_a_model_without_a_gradient_has_none():
    @wrap_py(itypes=[pt.dscalar], otypes=[pt.dscalar])
    def opaque(x):
        return np.asarray(-(x**2))

    with pm.Model() as model:
        pm.Potential("p", opaque(pm.Normal("x")))
    assert Target(model, None, RandomWalkSettings()).gradient_rows(of_pilot=False) is None


# Chains that start where the user says have proposals of the scale of the density there.


SD = np.array([1e-8, 1e-3, 1e9])


def narrow():
    """Three normal variables: two are seen precisely, of the third nothing is."""
    with pm.Model() as model:
        x = pm.Normal("x", 0.0, 1.0, shape=3)
        pm.Normal("y", x, SD, observed=[0.5, -0.3, 0.0])
    return model


def test_lengths_are_within_a_step_of_the_grid_and_at_most_the_priors():
    """Two nats are two standard deviations from the maximum; the grid has a factor of four."""
    target = Target(narrow(), None, RandomWalkSettings())
    cov = local_cov(target, np.array([0.5, -0.3, 0.0]))
    lengths = np.sqrt(np.diag(cov) * 3) / 2.38
    assert ((0.5 * SD < lengths) & (lengths <= 2.0 * SD))[:2].all()
    assert lengths[2] == pytest.approx(1.0, abs=0.2)
    far = np.sqrt(np.diag(local_cov(target, np.array([0.5, 0.7, 0.0]))) * 3) / 2.38
    assert far[1] < 1e-2 * SD[1]  # a slope of a million nats


def test_no_length_without_a_density():
    with pm.Model() as model:
        pm.Potential("above", pm.math.switch(pm.Normal("x") > 1.0, 0.0, -np.inf))
    assert local_cov(Target(model, None, RandomWalkSettings()), np.zeros(1)) is None


def test_a_chain_at_the_maximum_moves():
    """The posterior is 1e8 times narrower than the prior: with its scale nothing is accepted."""
    found = psf.sample_dram(
        1000, 300, model=narrow(), initvals={"x": [0.5, -0.3, 0.0]}, random_seed=1,
        progressbar=False, compute_convergence_checks=False,
    )  # fmt: skip
    sd = found["posterior"]["x"].std(("chain", "draw")).values
    np.testing.assert_allclose(sd, [1e-8, 1e-3, 1.0], rtol=0.3)
