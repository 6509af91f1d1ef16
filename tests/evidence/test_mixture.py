"""The mixture that proposes points: a normalised law, near the draws, whatever they are."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_t

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.estimators.student_mixture import choose_mixture
from pymc_statespace_filters.statistics.student_mixture import (
    DEGREES_OF_FREEDOM,
    StudentMixture,
    _m_step,
    fit_mixture,
    likeliest_mixture,
    place_components,
    standardised,
)
from tests.evidence.analytic import gaussian
from tests.evidence.targets import Banana, TwoModes


def some_mixture():
    rng = np.random.default_rng(40)
    chols = np.tril(rng.standard_normal((3, 4, 4)))
    chols[:, range(4), range(4)] = rng.uniform(0.5, 2.0, (3, 4))
    return StudentMixture(np.array([0.2, 0.5, 0.3]), rng.standard_normal((3, 4)), chols)


def test_density_is_that_of_scipy():
    mixture, x = some_mixture(), 3 * np.random.default_rng(41).standard_normal((50, 4))
    components = zip(mixture.weights, mixture.means, mixture.chols, strict=True)
    expected = sum(
        weight * multivariate_t(mean, chol @ chol.T, df=DEGREES_OF_FREEDOM).pdf(x)
        for weight, mean, chol in components
    )
    np.testing.assert_allclose(np.exp(mixture.log_density(x)), expected, rtol=1e-10)


def test_draws_have_the_density():
    """E_q[g / q] is the integral of any other density g: one, here to 3 errors or so."""
    mixture = some_mixture()
    law = multivariate_t(np.zeros(4), 2 * np.eye(4), df=8)
    x = mixture.sample(100_000, np.random.default_rng(42))
    ratios = np.exp(law.logpdf(x) - mixture.log_density(x))
    assert abs(ratios.mean() - 1) < 4 * ratios.std() / len(x) ** 0.5 < 0.05


def test_an_affine_map_changes_the_density_by_its_determinant():
    mixture, rng = some_mixture(), np.random.default_rng(43)
    mean, chol = rng.standard_normal(4), np.diag([1e-6, 1.0, 3.0, 1e6]) + np.tril(np.ones(4), -1)
    x = rng.standard_normal((20, 4))
    moved = mixture.affine(mean, chol).log_density(mean + x @ chol.T)
    expected = mixture.log_density(x) - np.log(np.diag(chol)).sum()
    np.testing.assert_allclose(moved, expected, rtol=1e-6)


def test_steps_of_em_never_lower_the_density_of_the_draws():
    """But for what the components borrow, nothing beside so many draws."""
    rng = np.random.default_rng(44)
    x = some_mixture().sample(4000, rng)
    mixture, reached = place_components(x, 3, rng), []
    for _ in range(30):
        log_joint = mixture.log_joint(x)
        log_density = np.logaddexp.reduce(log_joint)
        reached.append(log_density.mean())
        mixture = _m_step(mixture, x, np.exp(log_joint - log_density))
    assert np.min(np.diff(reached)) > -1e-3
    assert reached[-1] > reached[0] + 0.3


def test_the_law_that_made_the_draws_is_where_em_stays():
    """Its 44 parameters follow 4000 draws by 44 / 8000 nats, give or take."""
    mixture = some_mixture()
    x = mixture.sample(4000, np.random.default_rng(44))
    gain = fit_mixture(x, mixture).log_density(x).mean() - mixture.log_density(x).mean()
    assert 0 < gain < 0.015


def test_modes_are_found_with_their_weights():
    rng = np.random.default_rng(45)
    posterior = TwoModes(2).posterior((4, 1000), rng)
    mixture = choose_mixture(posterior, rng)
    left = mixture.means[:-1, 0] < 0
    share = (posterior.draws[..., 0] < 0).mean()
    assert mixture.weights[:-1][left].sum() == pytest.approx(0.9 * share, abs=0.02)


@pytest.mark.parametrize("make", [lambda: TwoModes(2), lambda: Banana(4)])
def test_more_components_than_one_where_they_help(make):
    rng = np.random.default_rng(46)
    assert len(choose_mixture(make().posterior((4, 1000), rng), rng).weights) > 2


def test_few_different_draws_give_a_mixture_all_the_same():
    rng = np.random.default_rng(47)
    draws = np.repeat(rng.standard_normal((1, 4, 2)), 5, axis=1)
    posterior = replace(gaussian(2, (1, 20), rng), draws=draws)
    mixture = choose_mixture(posterior, rng)
    assert np.isfinite(mixture.log_density(mixture.sample(100, rng))).all()


def test_draws_that_do_not_vary():
    rng = np.random.default_rng(48)
    posterior = gaussian(2, (2, 500), rng)
    posterior.draws[..., 1] = 0.0
    with pytest.raises(ModelError, match="vary in every direction"):
        choose_mixture(posterior, rng)


def test_as_many_components_as_held_out_draws_want():
    """Two where there are two groups; one of a Student distribution, whatever else is tried."""
    rng = np.random.default_rng(4)
    groups = np.concatenate([rng.normal(-4.0, 1.0, 400), rng.normal(4.0, 1.0, 400)])
    for draws, count in ((groups, 2), (rng.standard_t(5, 800), 1)):
        z = standardised(rng.permutation(draws)[:, np.newaxis]).z
        found = likeliest_mixture(z[::2], z[1::2], range(1, 6), rng, least_gain=0.02)
        assert len(found.weights) == count
