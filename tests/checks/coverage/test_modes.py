"""A mode that particles have missed is found from points on their way, and nothing else is."""

import numpy as np
import pytest
from scipy.stats import norm

from pymc_statespace_filters.checks.coverage import missed_modes
from pymc_statespace_filters.checks.coverage.missed_modes import (
    SIZES,
    Visited,
    _integrated,
    joined,
    missed_mode,
    thinned,
)
from pymc_statespace_filters.smc.particles import Particles, Populations

R, N, SD = 10, 100, 0.08
CENTRES, SDS, MASSES = (
    np.array([[-4.0, 0.0], [4.0, 0.0]]),
    np.array([1.0, SD]),
    np.array([0.7, 0.3]),
)
SHIFT = 5.0  # the log of the evidence


def log_density(x, rng=None):
    """A wide normal distribution of mass 0.7 and a narrow one of 0.3."""
    squares = ((x[:, None] - CENTRES) ** 2).sum(axis=-1) / SDS**2
    parts = np.log(MASSES / (2 * np.pi * SDS**2)) - squares / 2
    return np.logaddexp(*parts.T) + SHIFT


def drawn(share, rng):
    """Particles of which a share is in the narrow mode."""
    which = (rng.random(R * N) < share).astype(int)
    return CENTRES[which] + SDS[which, None] * rng.standard_normal((R * N, 2))


def populations_of(x):
    zero, none = np.zeros(len(x)), np.empty((len(x), 0))
    return Populations.of_equal_weights(
        Particles(x, log_density(x), zero, zero, none.astype(int), none), R
    )


def on_the_way(rng):
    """Points of a normal distribution as wide as a prior, and of a tempered one."""
    wide, near = 10 * rng.standard_normal((500, 2)), 4 * rng.standard_normal((500, 2))
    near = np.concatenate([near, CENTRES[1] + [[0.2, 0.2], [-0.25, 0.1]]])
    return joined(
        [Visited(x, log_density(x), np.full(len(x), i)) for i, x in enumerate((wide, near))]
    )


def looked(share, seed, n_evaluations=2000, evaluate=log_density, lost=0.0):
    rng = np.random.default_rng(seed)
    scatter = 0.05 * rng.standard_normal(R)
    return missed_mode(
        populations_of(drawn(share, rng)),
        SHIFT - lost + scatter,
        on_the_way(rng),
        evaluate,
        n_evaluations,
        rng,
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_mode_that_no_particle_has_met_is_found_with_its_mass(seed):
    """The evidence of the particles is then that of the other mode."""
    found = looked(0.0, seed, lost=-np.log(0.7))
    np.testing.assert_allclose(found.centre, CENTRES[1], atol=0.05)
    assert found.share == 0.0
    assert found.posterior == pytest.approx(0.3, abs=0.06)
    assert found.errors > 5


@pytest.mark.parametrize("seed", range(3))
def test_a_mode_that_few_particles_have_met_is_found(seed):
    found = looked(0.1, seed, n_evaluations=SIZES[-1], lost=0.25)
    np.testing.assert_allclose(found.centre, CENTRES[1], atol=0.1)
    assert found.share == pytest.approx(0.1, abs=0.04)
    assert found.posterior == pytest.approx(0.3, abs=0.06)


def test_particles_that_are_right_lack_nothing():
    """With two modes, at most 1 of 40 is said to lack one; a rate of 11 % fails 19 times in 20."""
    assert sum(looked(0.3, seed) is not None for seed in range(40)) <= 1


def test_populations_that_differ_widely_have_wide_errors():
    """One of ten is in the narrow mode, the others are not; then each has a tenth there."""
    rng = np.random.default_rng(1)
    x = np.concatenate([drawn(float(i == 0), rng)[:N] for i in range(R)])
    args = np.full(R, SHIFT), on_the_way(rng), log_density, 2000, rng
    assert missed_mode(populations_of(x), *args) is None
    alike = populations_of(np.random.default_rng(2).permutation(x))
    assert missed_mode(alike, *args).posterior > 0.2


def test_evidences_that_differ_widely_have_wide_errors():
    """They say too little of the wide mode, within their errors."""
    rng = np.random.default_rng(1)
    log_evidences = SHIFT - 0.5 + np.where(np.arange(R) % 2, 0.7, -2.0)
    args = on_the_way(rng), log_density, SIZES[-1], rng
    assert missed_mode(populations_of(drawn(0.3, rng)), log_evidences, *args) is None


def test_an_integral_is_that_over_the_ellipsoid():
    """Of a normal density over an interval; 200 points know it to 0.05."""

    def normal(x, rng):
        return norm.logpdf(x[:, 0])

    place = _integrated(np.zeros(1), np.full((1, 1), 0.3), normal, np.random.default_rng(1))
    end = 0.3 * (1 + 3 * 2**0.5 + 4) ** 0.5
    assert place.holds(np.array([[0.99 * end], [1.01 * end]])).tolist() == [True, False]
    exact = norm.cdf(end) - norm.cdf(-end)
    assert np.exp(place.log_integral) == pytest.approx(exact, abs=0.15)
    assert place.error * exact < 0.05


def test_a_noisy_density_is_no_mode():
    def noisy(x, rng):
        return log_density(x) + rng.standard_normal(len(x)) - 0.5

    assert sum(looked(0.3, seed, evaluate=noisy) is not None for seed in range(10)) == 0
    assert looked(0.0, 1, evaluate=noisy, lost=-np.log(0.7)).posterior > 0.2


def test_it_evaluates_no_more_points_than_it_may():
    counted = []

    def evaluate(x, rng):
        counted.append(len(x))
        return log_density(x)

    assert looked(0.0, 1, SIZES[-1] - 1, evaluate) is None
    assert not counted
    looked(0.0, 1, 1100, evaluate)
    assert sum(counted) == SIZES[-1] + sum(SIZES)


def test_the_mixture_is_fitted_to_no_more_draws_than_there_are_particles(monkeypatch):
    """Copies of particles would hide how few there are."""
    fitted, fit = [], missed_modes.fitted_mixture
    monkeypatch.setattr(
        missed_modes, "fitted_mixture", lambda x, rng: fitted.append(x) or fit(x, rng)
    )
    looked(0.3, 1)
    (draws,) = fitted
    assert len(draws.z) == R * N


def test_the_fullest_stage_is_thinned_first_and_of_these_the_earliest():
    stage = np.repeat(np.arange(4), [3, 8, 8, 8])
    visited = Visited(np.arange(27.0)[:, None], np.arange(27.0), stage)
    found = thinned(visited, 20)
    assert np.bincount(found.stage).tolist() == [3, 4, 4, 8]
    assert found.x[:7, 0].tolist() == [0, 1, 2, 3, 5, 7, 9]
    np.testing.assert_array_equal(found.x[:, 0], found.log_density)
    assert thinned(visited, 27) is visited


def test_particles_in_one_point_are_not_compared():
    rng = np.random.default_rng(1)
    one = populations_of(np.ones((R * N, 2)))
    assert missed_mode(one, np.zeros(R), on_the_way(rng), log_density, 2000, rng) is None


def test_a_place_without_any_density_is_none():
    """Only visited points have a density: the model has gone, or noise has taken it."""

    def nowhere(x, rng):
        return np.full(len(x), -np.inf)

    assert looked(0.0, 1, evaluate=nowhere) is None
