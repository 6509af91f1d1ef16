"""Evidences under stretched priors, against closed forms and quadrature."""

import arviz as az
import numpy as np
import pymc as pm
import pytest
from scipy.integrate import quad
from scipy.interpolate import PchipInterpolator
from scipy.stats import halfnorm, multivariate_normal, norm, uniform

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.comparison.scaled_prior import ScaledPrior, average_ratios
from tests.evidence.analytic import Regression, autoregressive

SHAPE = (4, 1000)


def posterior(**draws):
    return az.from_dict({"posterior": draws})


class OneParameter:
    """Evidence by quadrature, and draws by the inverse of the distribution function."""

    def __init__(self, prior, log_likelihood, ends):
        self.prior, self.log_likelihood, self.ends = prior, log_likelihood, ends
        grid = np.linspace(*ends, 4001)
        density = self._density(prior, grid)
        levels = np.append(0, np.cumsum((density[1:] + density[:-1]) / 2))
        levels /= levels[-1]
        rising = np.append(np.diff(levels) > 1e-12, True)
        self.inverse = PchipInterpolator(levels[rising], grid[rising])

    def draws(self, rng):
        return self.inverse(norm.cdf(autoregressive(SHAPE, 0.3, rng)))

    def log_ratio(self, stretched):
        of_each = []
        for prior in (stretched, self.prior):
            lower, upper = np.clip(prior.support(), *self.ends)
            of_each.append(quad(lambda x, p=prior: self._density(p, x), lower, upper)[0])
        return np.log(of_each[0] / of_each[1])

    def _density(self, prior, x):
        return prior.pdf(x) * np.exp(self.log_likelihood(x))


def test_errors_are_honest_on_a_regression():
    """Sixty chains, four widths: mean squared z within 4 of its standard errors of one."""
    rng = np.random.default_rng(1)
    target = Regression(3, 8, rng, sd=2.0)
    with pm.Model() as model:
        pm.Normal("w", 0, target.scale, shape=3)
    prior = ScaledPrior(model, ["w"])
    widths = [0.3, 0.7, 1.4, 3.0]
    exact = [exact_log_evidence(target, width) - target.log_evidence for width in widths]
    z, n_reliable = [], 0
    for _ in range(60):
        draws = posterior(w=target.posterior((4, 500), rng, correlation=0.5).draws)
        found = prior.curve(draws, widths)
        assert all(one.beyond == 0 for one in found)
        n_reliable += sum(one.is_reliable for one in found)
        z.append([(one.log_ratio - e) / one.error for one, e in zip(found, exact, strict=True)])
    assert n_reliable >= 0.98 * 60 * len(widths)  # chains may disagree by chance
    squares = np.square(z).mean(axis=0)
    assert (np.abs(squares - 1) < 4 * np.sqrt(2 / 60)).all(), squares
    assert (np.abs(np.mean(z, axis=0)) < 4 / np.sqrt(60)).all()


def exact_log_evidence(target, width):
    marginal = (width * target.scale) ** 2 * target.x @ target.x.T + target.sd**2 * np.eye(8)
    return multivariate_normal(np.zeros(8), marginal).logpdf(target.y)


def check(target, model, stretched, width):
    draws = posterior(x=target.draws(np.random.default_rng(2)))
    [found] = ScaledPrior(model, ["x"]).curve(draws, [width])
    assert found.is_reliable, found
    unseen = 1 / 4000  # what no draw has met is in no error
    assert abs(found.log_ratio - target.log_ratio(stretched)) < 4 * found.error + unseen
    return found


@pytest.mark.parametrize("width", [0.5, 2.0])
def test_a_positive_prior_is_stretched_from_zero(width):
    def log_likelihood(x):
        """Five observations of variance x^2 whose squares sum to 6."""
        return -5 * np.log(x) - 3 / x**2

    target = OneParameter(halfnorm(scale=2), log_likelihood, (0.05, 12))
    with pm.Model() as model:
        pm.HalfNormal("x", 2)
    found = check(target, model, halfnorm(scale=2 * width), width)
    assert found.error < 0.02


def peak(x):
    return norm.logpdf(x, 1.2, 0.2)


@pytest.mark.parametrize(
    ("lower", "upper", "half_as_wide", "twice_as_wide"),
    [
        (0, 2.5, uniform(0, 1.25), uniform(0, 5)),  # from zero
        (-2.5, 3.5, uniform(-1, 3), uniform(-5.5, 12)),  # about the middle
        (0.4, 3.0, uniform(1.05, 1.3), uniform(-0.9, 5.2)),
    ],
)
def test_uniform_priors(lower, upper, half_as_wide, twice_as_wide):
    target = OneParameter(uniform(lower, upper - lower), peak, (lower, upper))
    with pm.Model() as model:
        pm.Uniform("x", lower, upper)
    check(target, model, half_as_wide, 0.5)
    found = check(target, model, twice_as_wide, 2.0)
    assert found.log_ratio == pytest.approx(-np.log(2), abs=1e-12)  # of one kind of weight
    assert found.error == 0


def test_the_mirror_image_of_a_uniform_prior_from_zero():
    target = OneParameter(uniform(-2.5, 2.5), lambda x: peak(-x), (-2.5, 0))
    with pm.Model() as model:
        pm.Uniform("x", -2.5, 0)
    check(target, model, uniform(-1.25, 1.25), 0.5)


def test_what_lies_beyond_the_bounds_is_not_guessed():
    """The likelihood N(x; 1.2, 0.2^2) is cut off at 1.3: a wider prior sees 31 per cent more."""
    target = OneParameter(uniform(0, 1.3), peak, (0, 1.3))
    with pm.Model() as model:
        pm.Uniform("x", 0, 1.3)
    x = target.draws(np.random.default_rng(2))
    wide, nothing = ScaledPrior(model, ["x"]).curve(posterior(x=x), [1.5, 0.01])
    assert wide.beyond > 0.31 / 0.69
    assert not wide.is_reliable
    with pm.Model() as mirrored:
        pm.Uniform("x", -1.3, 0)
    [mirror_image] = ScaledPrior(mirrored, ["x"]).curve(posterior(x=-x), [1.5])
    assert mirror_image.beyond == pytest.approx(wide.beyond)
    check(target, model, uniform(0, 0.65 * 1.6), 0.8)  # narrower is known
    assert nothing.log_ratio == -np.inf  # none of the draws is left
    assert not nothing.is_reliable


def test_truncated_priors_are_stretched_from_their_only_end():
    with pm.Model() as model:
        pm.TruncatedNormal("x", 1.0, 0.7, lower=0.5)
    x = np.random.default_rng(3).uniform(0.6, 1.4, SHAPE)
    [found] = ScaledPrior(model, ["x"]).curve(posterior(x=x), [2.0])
    ratio = norm.pdf(0.5 + (x - 0.5) / 2, 1, 0.7) / 2 / norm.pdf(x, 1, 0.7)
    assert found.log_ratio == pytest.approx(np.log(ratio.mean()), abs=1e-12)
    assert found.beyond == 0


def test_dependent_priors_are_stretched_given_what_they_depend_on():
    """mu ~ N(0, 4), theta ~ N(mu, 1), y ~ N(theta, 1) with y = 1.5: all normal."""
    y, covariance = 1.5, np.array([[4.0, 4.0], [4.0, 5.0]])
    gain = covariance[:, 1] / 6
    chol = np.linalg.cholesky(covariance - np.outer(gain, covariance[1]))
    draws = gain * y + autoregressive((4, 5000, 2), 0.2, np.random.default_rng(4)) @ chol.T
    given = posterior(mu=draws[..., 0], theta=draws[..., 1])
    with pm.Model() as model:
        pm.Normal("theta", pm.Normal("mu", 0, 2), 1)
    actual = norm.logpdf(y, 0, 6**0.5)
    for names, width, variance in [
        (["theta"], 0.5, 4 + 0.25 + 1),
        (["theta"], 1.3, 4 + 1.69 + 1),
        (["mu"], 1.3, 4 * 1.69 + 1 + 1),
        (["mu", "theta"], 0.5, 1 + 0.25 + 1),
    ]:
        [found] = ScaledPrior(model, names).curve(given, [width])
        exact = norm.logpdf(y, 0, variance**0.5) - actual
        assert abs(found.log_ratio - exact) < 4 * found.error < 0.1, (names, width)


def test_vectors_of_every_shape():
    """Against the ratios of SciPy's densities."""
    rng = np.random.default_rng(5)
    cov = np.array([[2.0, 0.3], [0.3, 1.0]])
    with pm.Model(coords={"place": ["a", "b"]}) as model:
        pm.MvNormal("v", [1.0, 2.0], cov)
        pm.Normal("m", [[0.0], [1.0]], 2.0, shape=(2, 3))
        pm.Uniform("u", [0.0, -1.0], [4.0, 5.0], dims="place")
    v, m = rng.standard_normal((*SHAPE, 2)), rng.standard_normal((*SHAPE, 2, 3))
    u = np.full((*SHAPE, 2), 2.0)
    [found] = ScaledPrior(model, ["v", "m", "u"]).curve(posterior(v=v, m=m, u=u), [0.8])
    wide, actual = (multivariate_normal([1, 2], f * cov).logpdf(v) for f in (0.64, 1))
    centres = np.array([[0.0], [1.0]])
    wide_m, actual_m = (norm.logpdf(m, centres, s).sum((-1, -2)) for s in (1.6, 2.0))
    log_ratio = wide - actual + wide_m - actual_m - 2 * np.log(0.8)
    assert found.log_ratio == pytest.approx(np.log(np.exp(log_ratio).mean()), abs=1e-10)


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (lambda: pm.Flat("x"), "improper and cannot be scaled"),
        (lambda: pm.HalfFlat("x"), "improper and cannot be scaled"),
        (lambda: pm.Beta("x", 2, 2), "cannot be scaled"),
        (lambda: pm.Dirichlet("x", np.ones(3)), "cannot be scaled"),
        (lambda: pm.VonMises("x", 0, 1), "cannot be scaled"),
        (lambda: pm.LKJCorr("x", n=3, eta=2), "cannot be scaled"),
        (lambda: pm.ZeroSumNormal("x", shape=3), "cannot be scaled"),
    ],
)
def test_priors_without_a_width(law, message):
    with pm.Model() as model:
        law()
    with pytest.raises(ModelError, match=rf"the prior of 'x' .*{message}"):
        ScaledPrior(model, ["x"])


def test_heavy_tails_are_seen():
    """Draws of the prior itself: at four times its width the weights have Pareto's k 0.94."""
    z = np.random.default_rng(6).standard_normal(SHAPE)
    heavy = average_ratios(z**2 / 2 * (1 - 1 / 16), np.zeros(SHAPE))
    assert heavy.pareto_k > 0.5
    assert not heavy.is_reliable
    light = average_ratios(z**2 / 2 * (1 - 1 / 1.05), np.zeros(SHAPE))
    assert light.pareto_k < 0.3
    assert light.is_reliable


def test_what_lies_beyond_is_weighed_as_the_draws_are():
    """Half the draws weigh three times as much as the others, and only they are at the edge."""
    heavy = np.arange(4000).reshape(SHAPE) % 2
    found = average_ratios(np.log(1.0 + 2 * heavy), np.where(heavy, 0.4, 0.0))
    assert found.beyond == pytest.approx(0.3)
    assert found.log_ratio == pytest.approx(np.log(2))


def test_autocorrelated_draws_are_worth_less():
    log_ratio = 0.3 * autoregressive((4, 4000, 1), 0.9, np.random.default_rng(7))[..., 0]
    # The terms themselves have the correlation 0.9 nearly: 19 of them are worth one.
    alone = np.exp(0.3**2) - 1
    assert average_ratios(
        log_ratio, np.zeros((4, 4000))
    ).error ** 2 * 16_000 / alone == pytest.approx(19, rel=0.25)


def test_few_effective_draws_are_not_enough():
    log_ratio = np.where(np.arange(4000).reshape(SHAPE) % 100 == 0, 0.0, -np.inf)  # 40 of 4000
    few = average_ratios(log_ratio, np.zeros(SHAPE))
    assert few.log_ratio == pytest.approx(np.log(0.01))
    assert few.n_effective < 100
    assert not few.is_reliable
