"""IPLF with observations that have a distribution: against exact results and the grid filter."""

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from scipy import stats
from scipy.integrate import quad

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.observation import conditional_moments
from pymc_statespace_filters.compiler.lowering.symbols import symbols_of
from pymc_statespace_filters.ops.base import kernel
from pymc_statespace_filters.ops.likelihood import TapedLogLikelihood, TapePullback
from pymc_statespace_filters.system.distributions import SCALAR_LAWS, law_name
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.distributions import TABLE
from tests.modes import AS_IT_STANDS
from tests.systems import counts

pytestmark = pytest.mark.usefixtures("interpreted")


def observed_by(*distributions):
    """One state, which is observed by distributions of it."""
    return psf.StateSpaceModel(
        transition=lambda x, q: [0.9 * x[0] + q[0]],
        process_noise=[[0.2]],
        observation_dist=lambda x: [f(x[0]) for f in distributions],
        initial_mean=[0.3],
        initial_cov=[[0.8]],
    )


def test_every_distribution_of_the_table_is_tested():
    assert sorted(TABLE) == sorted(map(law_name, SCALAR_LAWS))


def test_means_and_variances_are_those_of_scipy():
    system = observed_by(*(distribution for distribution, _ in TABLE.values()))
    symbols = symbols_of(system)
    mean, cov = pytensor.function(
        list(symbols.values()),
        conditional_moments(system, symbols),
        mode=AS_IT_STANDS,
        on_unused_input="ignore",
    )(*(np.full(v.type.shape, 0.7) for v in symbols.values()))
    laws = [law for _, law in TABLE.values()]
    np.testing.assert_allclose(mean, [law.mean() for law in laws], rtol=1e-7)
    np.testing.assert_allclose(cov, np.diag([law.var() for law in laws]), rtol=1e-7)


def test_normal_distributions_are_gaussian_noise():
    """Exact, and in a partly missing row the component that is there counts."""
    by_distribution = observed_by(
        lambda x: pm.Normal.dist(mu=x, sigma=0.5), lambda x: pm.Normal.dist(mu=2.0 * x, sigma=1.5)
    )
    observed = np.array([[0.1, 0.4], [0.9, np.nan], [1.2, 1.6]])
    found = psf.log_likelihood(by_distribution, psf.IPLF(), {}, observed, steps=[0, 2, 3])
    noise = np.diag([0.5**2, 1.5**2])
    exact = kalman_log_likelihood(
        [[0.9]], [[0.2]], [[1.0], [2.0]], noise, [0.3], [[0.8]], observed=observed, steps=[0, 2, 3]
    )
    np.testing.assert_allclose(found, exact, rtol=1e-11, atol=1e-15)


@pytest.mark.parametrize("count", [0, 1, 7])
def test_the_likelihood_of_a_count_is_close_to_its_integral(count):
    system = counts(a=0.9, initial_mean=0.3, initial_var=0.8)
    found = psf.log_likelihood(system, psf.IPLF(), {"level": 1.0}, [count], steps=[0])

    def density(x):
        return stats.poisson.pmf(count, np.exp(1.0 + x)) * stats.norm.pdf(x, 0.3, 0.8**0.5)

    exact = np.log(quad(density, -8.0, 8.0, epsabs=1e-13)[0])
    np.testing.assert_allclose(found, exact, rtol=0.0, atol=0.02)


COUNTS = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(lambda x, a: [-a * x[0]], [[0.7]], dt=0.1),
    observation_dist=lambda x, c: [
        pm.Poisson.dist(mu=pt.exp(c + x[0])),
        pm.NegativeBinomial.dist(mu=pt.exp(x[0]), alpha=c + 2.0),
    ],
    initial_mean=[0.0],
    initial_cov=[[0.5]],
)


def test_the_gradient_is_that_of_the_likelihood_and_does_not_see_what_is_missing():
    observed = np.array([[4.0, 2.0], [3.0, np.nan], [np.nan, 0.0], [np.nan, np.nan]])
    record = (np.array([0, 5, 10, 20]), observed, np.zeros((0, 0)), 0.0, 0)
    filter, theta = psf.IPLF(n_iterations=2), np.array([0.5, 1.0])
    forward = kernel(TapedLogLikelihood(COUNTS, filter))

    def value(theta):
        return forward(theta, *record)[0]

    *_, tape = forward(theta, *record)
    found = kernel(TapePullback(COUNTS, filter))(theta, *record, tape, np.ones(4))
    weights = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
    for i, h in enumerate([2e-3, 4e-3]):
        moves = theta + np.arange(-4, 5)[:, None] * h * np.eye(2)[i]
        slope = weights @ [value(move).sum() for move in moves] / h
        np.testing.assert_allclose(found[i], slope, rtol=1e-8)
    assert value(theta)[3] == 0.0


STEPS = np.arange(0, 300, 5)
RATE, LEVEL = np.meshgrid(np.linspace(0.02, 3.0, 24), np.linspace(-0.7, 2.3, 16), indexing="ij")


def decays(rate):
    """Euler steps of 0.1 of dx = -rate x dt + 0.7 dW, as parameters of `counts`."""
    return {"a": 1.0 - 0.1 * rate, "noise_var": 0.1 * 0.7**2}


ON_GRID = decays(RATE) | {"level": LEVEL}


def moments_on_grid(terms):
    """Mean and sd of the posterior of rate and level, by their terms on the grid."""
    density = terms.sum(axis=-1) - 0.5 * RATE**2 - 0.5 * (LEVEL / 2.0) ** 2
    weights = np.exp(density - density.max())
    weights /= weights.sum()
    mean = np.array([(weights * v).sum() for v in (RATE, LEVEL)])
    square = np.array([(weights * v**2).sum() for v in (RATE, LEVEL)])
    return mean, np.sqrt(square - mean**2)


@pytest.fixture(scope="module")
def sixty_counts():
    """Sixty counts of mean 3, and mean and sd of the exact posterior of their rate and level."""
    truth = decays(0.5) | {"level": 1.0}
    record = psf.simulate(counts(), truth, steps=STEPS, random_seed=1)["observations"].values
    terms = psf.log_likelihood(counts(), psf.GridFilter(), ON_GRID, record, steps=STEPS)
    return record, *moments_on_grid(terms)


def test_the_posterior_of_counts_is_nearly_exact_and_nuts_samples_it(sixty_counts):
    """By IPLF means are within a tenth of a posterior sd, and deviations within a tenth.

    Those of NUTS have four standard errors more; a hundred draws have ranks as good as thirty.
    """
    record, mean, sd = sixty_counts
    terms = psf.log_likelihood(counts(), psf.IPLF(), ON_GRID, record, steps=STEPS)
    by_iplf = moments_on_grid(terms)
    assert (np.abs(by_iplf[0] - mean) < 0.1 * sd).all(), (by_iplf[0], mean, sd)
    np.testing.assert_allclose(by_iplf[1], sd, rtol=0.1)
    with pm.Model():
        params = decays(pm.HalfNormal("rate", 1.0)) | {"level": pm.Normal("level", 0.0, 2.0)}
        psf.StateSpace("d", counts(), psf.IPLF(), params=params, steps=STEPS, observed=record)
        idata = pm.sample(
            100, tune=100, chains=1, nuts_sampler="pymc", random_seed=4, progressbar=False,
            compute_convergence_checks=False,
        )  # fmt: skip
    draws = np.array([idata.posterior[name].values.ravel() for name in ("rate", "level")])
    assert (np.abs(draws.mean(axis=1) - by_iplf[0]) < 4 * by_iplf[1] / 30**0.5).all()
    ratio = draws.std(axis=1) / by_iplf[1]
    assert (ratio > 0.4).all()
    assert (ratio < 1.7).all()


@pytest.mark.parametrize("filter", [psf.EKF(), psf.UKF()])
def test_filters_of_gaussian_noise_name_the_one_for_distributions(filter):
    with pytest.raises(psf.errors.ModelError, match=r"GuidedPF\(100\).*\(exact\) and by IPLF\(\)"):
        psf.log_likelihood(counts(), filter, {}, [3], steps=[0])


def test_a_density_without_moments_is_refused():
    system = psf.StateSpaceModel(
        transition=lambda x: [x[0]],
        observation_logp=lambda d, x: -((d[0] - x[0]) ** 2),
        initial_mean=[0.0],
        initial_cov=[[1.0]],
    )
    with pytest.raises(psf.errors.ModelError, match="which observation_logp does not give"):
        psf.log_likelihood(system, psf.IPLF(), {}, [3.0], steps=[0])


def test_distributions_outside_the_table_are_named():
    system = observed_by(lambda x: pm.Cauchy.dist(alpha=x, beta=1.0))
    with pytest.raises(
        psf.errors.ModelError, match=r"which it knows for Bernoulli, .*; got cauchy"
    ):
        psf.log_likelihood(system, psf.IPLF(), {}, [3.0], steps=[0])


@pytest.mark.parametrize("law", ["Poisson", "Binomial"])
def test_counts_whose_mean_is_zero_say_nothing(law):
    """At night, where the mean is zero at every state: 0 nats, as those of a missing row."""

    def seen(x, u):
        mean = u[0] * pt.exp(x[0] - 1.0)
        return [pm.Poisson.dist(mean) if law == "Poisson" else pm.Binomial.dist(10, 0.2 * mean)]

    system = psf.StateSpaceModel(
        lambda x, q, a: [a * x[0] + q[0]], process_noise=[[0.1]], observation_dist=seen,
        initial_mean=[0.0], initial_cov=[[0.1]], inputs=["day"],
    )  # fmt: skip
    given = {"steps": range(4), "inputs": np.array([0.0, 1.0, 1.0, 0.0])}
    zero, missing = (
        psf.log_likelihood(system, psf.IPLF(), {"a": 0.9}, [night, 0.0, 1.0, night], **given)
        for night in (0.0, np.nan)
    )
    np.testing.assert_allclose(zero, missing, atol=1e-14)
    with pm.Model() as model:
        pm.Normal("a")
        psf.StateSpace("d", system, psf.IPLF(), observed=[0.0, 0.0, 1.0, 0.0], **given)
    logp, slope = model.compile_logp(), model.compile_dlogp()
    difference = (logp({"a": 0.9 + 1e-5}) - logp({"a": 0.9 - 1e-5})) / 2e-5
    np.testing.assert_allclose(slope({"a": 0.9}), difference, rtol=1e-6)
    with pytest.warns(psf.errors.FilterWarning, match="has density zero wherever this filter"):
        psf.log_likelihood(system, psf.IPLF(), {"a": 0.9}, [1.0, 0.0, 1.0, 0.0], **given)


def test_a_fraction_among_counts_is_named():
    system = counts()
    params = dict.fromkeys(system.parameters, 0.5)
    for filter in (psf.IPLF(), psf.BootstrapPF(100)):
        with pytest.warns(psf.errors.FilterWarning, match=r"y0 = 1.5 is no whole number, and its"):
            psf.log_likelihood(system, filter, params, [2.0, 1.5, 3.0], steps=[0, 1, 2])
