"""`maximum_likelihood`: exact maxima and standard errors, and reasons where there are none."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy.optimize import minimize
from scipy.stats import chi2, multinomial, norm

import pymc_statespace_filters as psf
from benchmarks.posteriors import HARDENING, narrow
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.estimators.newton import WithGradient
from pymc_statespace_filters.point_estimation.smooth import maximize_smooth
from pymc_statespace_filters.pymc_model.prior import ModelFactors
from pymc_statespace_filters.sampling.starts.annealing import Population
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.systems import autoregression, simulated

STEPS = np.arange(1, 81)


def test_regression_by_least_squares_whatever_the_prior():
    """The prior of the coefficients is ten standard errors away from them."""
    rng = np.random.default_rng(1)
    x = rng.standard_normal((60, 3)) @ [[1.0, 0.9, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 5.0]]
    y = x @ [1.0, -2.0, 0.5] + 0.7 * rng.standard_normal(60)
    with pm.Model(coords={"column": ["one", "two", "three"]}):
        beta = pm.Normal("beta", 3.0, 0.5, dims="column")
        sigma = pm.HalfNormal("sigma", 5.0)
        pm.Normal("y", x @ beta, sigma, observed=y)
        found = psf.maximum_likelihood(random_seed=1)

    exact = np.linalg.lstsq(x, y)[0]
    spread = np.sqrt(((y - x @ exact) ** 2).mean())
    covariance = spread**2 * np.linalg.inv(x.T @ x)
    np.testing.assert_allclose(found.estimate["beta"], exact, atol=1e-7)
    assert found.estimate["sigma"] == pytest.approx(spread, abs=1e-7)
    np.testing.assert_allclose(
        found.standard_errors["beta"], np.sqrt(np.diag(covariance)), rtol=1e-5
    )
    assert found.standard_errors["sigma"] == pytest.approx(spread / np.sqrt(120), rel=1e-5)
    assert found.log_likelihood == pytest.approx(norm.logpdf(y, x @ exact, spread).sum(), abs=1e-9)
    assert list(found.covariance) == ["beta[one]", "beta[two]", "beta[three]", "sigma"]
    np.testing.assert_allclose(found.covariance.values[:3, :3], covariance, rtol=1e-5)
    # value variables: beta, log sigma; the information of log sigma is 2 n
    np.testing.assert_allclose(found.hessian[:3, :3], -np.linalg.inv(covariance), rtol=1e-5)
    assert found.hessian[3, 3] == pytest.approx(-120, rel=1e-5)
    assert found.unconstrained[3] == pytest.approx(np.log(spread), abs=1e-7)
    assert (found.log_likelihood_se, found.notes, dict(found.reasons)) == (0.0, (), {})
    assert not found.simulation_errors["beta"].any()


def test_shares_and_a_potential():
    """Three shares on two unconstrained dimensions; a Potential is a part of the likelihood."""
    counts = np.array([30, 50, 120])
    with pm.Model() as model:
        shares = pm.Dirichlet("p", [8.0, 1.0, 1.0])
        pm.Multinomial("n", 150, shares, observed=[20, 40, 90])
        pm.Potential("more", (pt.log(shares) * [10, 10, 30]).sum())
    found = psf.maximum_likelihood(model, random_seed=1)
    p = counts / 200
    np.testing.assert_allclose(found.estimate["p"], p, atol=1e-8)
    np.testing.assert_allclose(
        found.covariance, (np.diag(p) - np.outer(p, p)) / 200, rtol=1e-5, atol=1e-9
    )
    exact = multinomial.logpmf([20, 40, 90], 150, p) + np.log(p) @ [10, 10, 30]
    # PyMC has the factorials in single precision
    assert found.log_likelihood == pytest.approx(exact, abs=1e-4)
    assert found.hessian.shape == (2, 2)


class TestAutoregression:
    """The exact likelihood is Kalman's."""

    observed = simulated(STEPS, 1, 0.8, 0.5, observation_noise=0.2)

    def exact_log_likelihood(self, parameters):
        phi, spread = parameters
        arguments = [[[phi]], [[spread**2]], [[1.0]], [[0.2]], [0.0], [[1.0]]]
        return kalman_log_likelihood(
            *map(np.array, arguments), observed=self.observed[:, None], steps=STEPS
        ).sum()

    def exact(self):
        """Maximum and covariance by SciPy, in the model's units."""
        settings = {"method": "Nelder-Mead", "options": {"xatol": 1e-9, "fatol": 1e-13}}
        point = minimize(lambda p: -self.exact_log_likelihood(p), [0.8, 0.5], **settings).x
        h, information = 1e-3, np.empty((2, 2))
        for i, j in np.ndindex(2, 2):
            moves = h * np.eye(2)[i], h * np.eye(2)[j]
            corners = [
                s * t * self.exact_log_likelihood(point + s * moves[0] + t * moves[1])
                for s, t in ((1, 1), (1, -1), (-1, 1), (-1, -1))
            ]
            information[i, j] = -sum(corners) / (4 * h**2)
        return point, np.linalg.inv(information)

    def model(self, filter):
        with pm.Model() as model:
            pm.Uniform("phi", 0.0, 1.0)
            pm.HalfNormal("spread", 1.0)
            system = autoregression(observation_noise=0.2)
            psf.StateSpace("d", system, filter, steps=STEPS, observed=self.observed)
        return model

    def test_exact_likelihood(self):
        found = psf.maximum_likelihood(self.model(psf.EKF()), random_seed=1)
        point, covariance = self.exact()
        assert found.estimate["phi"] == pytest.approx(point[0], abs=1e-6)
        assert found.estimate["spread"] == pytest.approx(point[1], abs=1e-6)
        np.testing.assert_allclose(found.covariance, covariance, rtol=1e-3)
        assert found.log_likelihood == pytest.approx(self.exact_log_likelihood(point), abs=1e-9)

    def test_estimated_likelihood(self):
        """The noise has a standard deviation of one. One of 10 000 seeds fails."""
        model, (point, covariance) = self.model(psf.BootstrapPF(60)), self.exact()
        errors = np.sqrt(np.diag(covariance))
        found = psf.maximum_likelihood(model, random_seed=1)
        at = np.array([found.estimate["phi"], found.estimate["spread"]])
        simulation = np.array([*found.simulation_errors.values()])
        assert (simulation < 0.2 * errors).all()
        assert (((at - point) / simulation) ** 2).sum() < chi2(2).ppf(0.9999)
        np.testing.assert_allclose([*found.standard_errors.values()], errors, rtol=0.3)
        assert 0.01 < found.log_likelihood_se < 0.3
        difference = found.log_likelihood - self.exact_log_likelihood(at)
        assert abs(difference) < 4 * found.log_likelihood_se
        assert "quadratic" in found.notes[0]
        assert "simulation_error" in found.summary()


def test_a_known_gradient_takes_few_evaluations():
    """A skewed peak of 14 correlated parameters; its curvature at the maximum is known."""
    rng = np.random.default_rng(1)
    mixed = rng.standard_normal((14, 14)) + 3 * np.eye(14)
    n_values, n_slopes = 0, 0

    def values(x):
        nonlocal n_values
        n_values += len(x)
        z = (x - 1.0) @ mixed.T
        return -50.0 * (np.exp(z) - z - 1.0).sum(axis=1)

    def with_slopes(x):
        nonlocal n_slopes
        n_slopes += len(x)
        z = (x - 1.0) @ mixed.T
        return -50.0 * (np.exp(z) - z - 1.0).sum(axis=1), -50.0 * (np.exp(z) - 1.0) @ mixed

    x = 1.0 + 0.2 * rng.standard_normal((256, 14)) @ np.linalg.inv(mixed).T
    population = Population(x, np.zeros(256), values(x))
    peak = maximize_smooth(WithGradient(values, with_slopes), population)
    np.testing.assert_allclose(peak.point, 1.0, atol=1e-7)
    covariance = np.linalg.inv(50.0 * mixed.T @ mixed)
    np.testing.assert_allclose(peak.basis @ peak.basis.T, covariance, rtol=1e-4, atol=1e-9)
    assert n_values < 3000
    assert n_slopes < 600
    by_slopes, n_values = n_values, 0
    assert maximize_smooth(values, population).value == pytest.approx(peak.value, abs=1e-9)
    assert n_values > 3 * (by_slopes + n_slopes)


def test_a_narrow_oscillator():
    """Its likelihood has many ridges; the search from the truth knows the right one."""
    model = narrow(HARDENING)
    found = psf.maximum_likelihood(model, random_seed=1)
    factors, rng = ModelFactors(model), np.random.default_rng(1)
    logarithmic = [np.log(HARDENING[n]) for n in ("c", "k", "sigma", "sensor")]
    truth = [*logarithmic, HARDENING["k3"], np.log(HARDENING["gain"]), HARDENING["x0"]]
    near = minimize(
        lambda x: -float(factors.evaluate(x[None], rng)[1][0]),
        truth,
        method="Nelder-Mead",
        options={"xatol": 1e-6, "fatol": 1e-9, "maxfev": 20_000, "adaptive": True},
    )
    assert found.log_likelihood == pytest.approx(-near.fun, abs=1e-5)
    for name, value in HARDENING.items():
        assert abs(found.estimate[name] - value) < 4 * found.standard_errors[name]


def test_of_two_modes_the_higher():
    """The higher mode has a third of the mass, and both are 500 times narrower than the prior."""
    with pm.Model() as model:
        x = pm.Normal("x", 0.0, 10.0, shape=2)
        modes = [
            pt.log(w) + pm.logp(pm.Normal.dist(m, sd), x).sum()
            for w, m, sd in ((2.0, -4.0, 0.04), (1.0, 4.0, 0.02))
        ]
        pm.Potential("likelihood", pt.logaddexp(*modes))
    for seed in (1, 2):
        found = psf.maximum_likelihood(model, random_seed=seed)
        np.testing.assert_allclose(found.estimate["x"], 4.0, atol=1e-7)
        np.testing.assert_allclose(found.standard_errors["x"], 0.02, rtol=1e-5)


def test_another_maximum_as_high_is_reported():
    with pm.Model() as model:
        x = pm.Normal("x", 0.0, 3.0)
        pm.Normal("y", x**2, 0.1, observed=4.0)
    found = psf.maximum_likelihood(model, random_seed=1)
    assert abs(found.estimate["x"]) == pytest.approx(2.0, abs=1e-7)
    (note,) = found.notes
    assert "another maximum, 0.00 nats lower" in note
    assert f"x = {-2.0 if found.estimate['x'] > 0 else 2.0:.0f}." in note


def test_maxima_with_exchanged_labels_are_one():
    """The prior may tell the labels apart: the likelihood does not."""
    y = np.random.default_rng(1).normal(size=40) + np.repeat([-2.0, 2.0], 20)
    with pm.Model() as model:
        first, second = pm.Normal("first", 0.0, 5.0), pm.Normal("second", 1.0, 4.0)
        likelihood = pt.logaddexp(-((y - first) ** 2) / 2.0, -((y - second) ** 2) / 2.0)
        pm.Potential("likelihood", likelihood.sum())
    found = psf.maximum_likelihood(model, random_seed=1)
    assert abs(found.estimate["first"] - found.estimate["second"]) > 3.0
    assert found.notes == ()


def test_a_poorly_known_parameter_hides_no_maximum():
    """Its standard error of 10 is larger than the differences between all numbers."""
    with pm.Model() as model:
        x, wide = pm.Uniform("x", -1.0, 1.0), pm.Normal("wide", 0.0, 20.0)
        peaks = pt.logaddexp(-(((x - 0.1) / 0.02) ** 2) / 2, -(((x + 0.1) / 0.02) ** 2) / 2)
        pm.Potential("likelihood", peaks - ((wide - 0.2) / 10) ** 2 / 2)
    found = psf.maximum_likelihood(model, random_seed=1)
    (note,) = found.notes
    assert "0.00 nats lower" in note


def test_a_scale_of_zero_has_no_standard_error():
    """The data scatter less than their errors explain."""
    y = np.array([0.3, -0.5, 0.8, 0.1, -0.2, 0.4])
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 10.0)
        tau = pm.HalfNormal("tau", 1.0)
        pm.Normal("y", mu, pt.sqrt(1 + tau**2), observed=y)
    found = psf.maximum_likelihood(model, random_seed=1)
    assert found.estimate["tau"] == pytest.approx(0.0, abs=1e-4)
    assert np.isnan(found.standard_errors["tau"])
    assert np.isnan(found.covariance.loc["tau", "mu"])
    assert found.estimate["mu"] == pytest.approx(y.mean(), abs=1e-7)
    assert found.standard_errors["mu"] == pytest.approx(1 / np.sqrt(6), rel=1e-5)
    assert found.log_likelihood == pytest.approx(norm.logpdf(y, y.mean(), 1.0).sum(), abs=1e-8)
    assert list(found.reasons) == ["tau"]
    assert found.notes == ()  # the other searches ended at the same bound
    assert "at a bound of its support" in found.summary().loc["tau", "reason"]
    text = repr(found)
    assert "No standard error of tau:" in text
    assert "at a bound of its support" in " ".join(text.split())
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize("settings", [{}, {"default_transform": None}])
def test_upper_bounds(settings):
    """With and without a transform."""
    y = np.array([1.9, 2.2, 2.0])
    with pm.Model() as model:
        share = pm.Uniform("share", 0.0, 1.0, **settings)
        other = pm.Normal("other", 0.0, 10.0)
        pm.Normal("y", pt.stack([share, other]), 0.5, observed=np.stack([y, y], axis=1))
    found = psf.maximum_likelihood(model, random_seed=1)
    assert found.estimate["share"] == pytest.approx(1.0, abs=1e-3)
    assert found.estimate["other"] == pytest.approx(y.mean(), abs=1e-6)
    assert found.standard_errors["other"] == pytest.approx(0.5 / np.sqrt(3), rel=1e-5)
    assert np.isnan(found.standard_errors["share"])
    where = "at the edge of its support" if settings else "at a bound of its support"
    assert where in found.reasons["share"]


def test_parameters_that_the_data_do_not_determine():
    with pm.Model() as model:
        a, b, c = (pm.Normal(name, 0.0, 3.0) for name in "abc")
        pm.Normal("y", pt.stack([a + b, c]), 0.5, observed=[2.0, 1.0])
    found = psf.maximum_likelihood(model, random_seed=1)
    assert found.estimate["a"] + found.estimate["b"] == pytest.approx(2.0, abs=1e-6)
    assert found.standard_errors["c"] == pytest.approx(0.5, rel=1e-5)
    assert set(found.reasons) == {"a", "b"}
    assert found.notes == ()
    for name in "ab":
        assert np.isnan(found.standard_errors[name])
        assert found.reasons[name].endswith("level as a, b change together")


def test_results_depend_on_the_seed_alone():
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 10.0)
        pm.Normal("y", mu, 1.0, observed=[1.0, 1.3])
    first, again = (psf.maximum_likelihood(model, random_seed=1) for _ in range(2))
    assert first.estimate == again.estimate
    assert first.n_evaluations == again.n_evaluations


class TestRefusals:
    def refused(self, message, **arguments):
        with pytest.raises(ModelError, match=message):
            psf.maximum_likelihood(**arguments)

    def test_discrete_variables(self):
        with pm.Model() as model:
            n = pm.Poisson("n", 3)
            pm.Normal("y", n, 1.0, observed=2.0)
        self.refused("discrete", model=model)

    def test_improper_priors(self):
        with pm.Model() as model:
            mu = pm.Flat("mu")
            pm.Normal("y", mu, 1.0, observed=2.0)
        self.refused("prior of mu is improper", model=model)

    def test_nothing_observed(self):
        with pm.Model() as model:
            pm.Normal("mu", 0.0, 1.0)
        self.refused("must have an observed variable or a Potential", model=model)

    def test_impossible_data(self):
        with pm.Model() as model:
            x = pm.Normal("x", 0.0, 1.0)
            pm.Potential("never", pt.switch(x > 100.0, 0.0, -np.inf))
        self.refused("zero at all of 2000 draws", model=model)

    def test_a_prior_far_from_the_data(self):
        with pm.Model() as model:
            mu = pm.Normal("mu", 0.0, 1.0)
            pm.Normal("y", mu, 1.0, observed=[1e8, 1e8 + 1.0])
        self.refused("the prior and the data contradict each other", model=model, random_seed=1)

    def test_other_arguments(self):
        self.refused("model must be a pymc.Model, got str", model="model")
        with pm.Model() as model:
            mu = pm.Normal("mu", 0.0, 1.0)
            pm.Normal("y", mu, 1.0, observed=2.0)
        self.refused("random_seed must be", model=model, random_seed="one")
