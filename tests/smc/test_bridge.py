"""A bridge of known ratio: unbiased in every population but the pilot."""

import numpy as np
import pytest
from scipy.stats import norm

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.smc.bridge import Cloud, cross
from pymc_statespace_filters.smc.kernel import fitted_kernel, metropolis
from pymc_statespace_filters.smc.moves import Size
from pymc_statespace_filters.smc.particles import Particles, Populations
from pymc_statespace_filters.smc.temperature import next_temperature

WIDTH, K = 0.1, 2


def evaluate(x, rng):
    """Two modes of widths 1/10 and masses 1 : 3, eighty of their standard deviations apart."""
    log_prior = -0.5 * (x**2).sum(axis=1) / 9 - K * np.log(3 * np.sqrt(2 * np.pi))
    modes = [
        np.log(mass) - 0.5 * ((x - at) ** 2).sum(axis=1) / WIDTH**2
        for at, mass in ((-4.0, 0.25), (4.0, 0.75))
    ]
    log_posterior = np.logaddexp(*modes) - K * np.log(WIDTH * np.sqrt(2 * np.pi))
    nothing = np.empty((len(x), 0))
    return Particles(x, log_prior, np.zeros(len(x)), log_posterior - log_prior, nothing, nothing)


def clouds(size, n_populations, seed):
    rng = np.random.default_rng(seed)
    n = size.n_particles
    particles = evaluate(3 * rng.standard_normal(((1 + n_populations) * n, K)), rng)
    pilot, others = particles.at(slice(n)), particles.at(slice(n, None))
    return rng, Cloud(
        Populations.of_equal_weights(pilot, 1),
        Populations.of_equal_weights(others, n_populations),
    )


@pytest.mark.parametrize("waste_free", [True, False])
def test_the_ratio_and_the_masses_of_modes_are_right(waste_free):
    """The mean of 40 unbiased ratios is within 4 of its standard errors: once in 16 000 tests.

    So is the mass of a mode, and the variance within one, which is exact.
    """
    size = Size.of(300, waste_free)
    rng, cloud = clouds(size, 40, 3)
    found = cross(cloud, evaluate, size, rng, refresh=True)
    ratios = np.exp(found.log_ratio)
    assert abs(ratios.mean() - 1) < 4 * ratios.std(ddof=1) / 40**0.5 < 0.4
    x = found.cloud.others.particles.x[:, 0].reshape(40, -1)
    shares = np.average(x > 0, axis=1)
    mean = np.average(shares, weights=ratios)
    error = (((shares - mean) * ratios).std(ddof=1) / ratios.mean()) / 40**0.5
    assert abs(mean - 0.75) < 4 * error < 0.3
    np.testing.assert_allclose(x[x > 0].std(), WIDTH, rtol=0.1)
    assert [one.temperature for one in found.stages][-1] == 1.0


def test_without_refreshing_weights_are_kept_and_the_effective_size_of_the_pilot_is_half():
    size = Size.of(200, waste_free=True)
    rng, cloud = clouds(size, 3, 4)
    found = cross(cloud, evaluate, size, rng)
    assert found.cloud.pilot.effective_sizes[0] >= 0.5 * size.n_particles
    assert (found.cloud.others.effective_sizes < size.n_particles).all()
    np.testing.assert_allclose(np.exp(found.cloud.others.log_weights).sum(axis=1), 1.0)


def test_too_few_distinct_particles_are_an_error():
    x = np.zeros((10, 3))
    nothing = np.empty((10, 0))
    particles = Particles(x, *(np.zeros(10),) * 3, nothing, nothing)
    with pytest.raises(ModelError, match="1 distinct particles"):
        fitted_kernel(Populations.of_equal_weights(particles, 1), 1.0, np.random.default_rng(0))


def _in_slit(x, rng):
    """Of a uniform prior on (-1, 1), the likelihood is positive on (0, 0.04), a fiftieth."""
    inside = (x[:, 0] > 0) & (x[:, 0] < 0.04)
    log_prior = np.where(abs(x[:, 0]) < 1, -np.log(2), -np.inf)
    nothing = np.empty((len(x), 0))
    return Particles(
        x, log_prior, np.zeros(len(x)), np.where(inside, 0.0, -np.inf), nothing, nothing
    )


def _uniform_cloud(size, n_populations):
    rng = np.random.default_rng(7)
    x = rng.uniform(-1, 1, ((1 + n_populations) * size.n_particles, 1))
    particles = _in_slit(x, rng)
    pilot, others = (particles.at(part) for part in np.split(np.arange(len(x)), [size.n_particles]))
    return rng, Cloud(
        Populations.of_equal_weights(pilot, 1), Populations.of_equal_weights(others, n_populations)
    )


def test_particles_of_zero_likelihood_count_as_lost():
    """The mean of 40 unbiased ratios within 4 standard errors: once in 16 000 tests."""
    size = Size.of(200, waste_free=True)
    rng, cloud = _uniform_cloud(size, 40)
    found = cross(cloud, _in_slit, size, rng)
    assert len(found.stages) == 1
    ratios = np.exp(found.log_ratio)
    assert abs(ratios.mean() - 0.02) < 4 * ratios.std(ddof=1) / 40**0.5 < 0.01
    lost = np.isneginf(found.log_ratio)
    assert (found.cloud.others.n_alive[~lost] == size.n_particles).all()
    np.testing.assert_array_equal(found.stages[0].effective_sizes == 0, lost)
    assert lost.any()


@pytest.mark.parametrize("lost", ["pilot", "others"])
def test_no_particle_of_positive_likelihood_is_an_error(lost):
    size = Size.of(20, waste_free=True)
    rng, cloud = _uniform_cloud(size, 2)
    one = getattr(cloud, lost)
    particles = one.particles._replace(increment=np.full(len(one.particles.x), -np.inf))
    cloud = cloud._replace(**{lost: one._replace(particles=particles)})
    if lost == "others":
        pilot = cloud.pilot.particles._replace(increment=np.zeros(size.n_particles))
        cloud = cloud._replace(pilot=cloud.pilot._replace(particles=pilot))
    with pytest.raises(ModelError, match="likelihood is zero at all particles of the p"):
        cross(cloud, _in_slit, size, rng)


# Temperatures leave a given share of the effective number of points.


@pytest.mark.parametrize("share", [0.5, 0.85])
@pytest.mark.parametrize("spread", [1.0, 1e3, 1e9])
@pytest.mark.parametrize("temperature", [0.0, 0.2])
def test_a_share_of_the_effective_number_is_left(temperature, spread, share):
    log_likelihood = -10.0 * spread * np.random.default_rng(86).chisquare(3, 1000)
    log_likelihood[::3] = -np.inf
    raised = next_temperature(temperature, log_likelihood, share)
    weights = np.exp((raised - temperature) * log_likelihood)
    effective = weights.sum() ** 2 / (weights**2).sum()
    assert temperature < raised < 1.0
    assert effective / np.isfinite(log_likelihood).sum() == pytest.approx(share, rel=1e-4)


def test_the_last_temperature_is_one():
    assert next_temperature(0.3, np.array([-1.0, -1.01, -1.02]), 0.85) == 1.0


def test_log_likelihoods_of_all_magnitudes():
    log_likelihood = -np.logspace(40, 60, 100)
    weights = np.exp(next_temperature(0.0, log_likelihood, 0.2) * log_likelihood)
    assert weights.sum() ** 2 / (weights**2).sum() == pytest.approx(20.0, rel=1e-3)


# Moves screened by another density leave the target as it is.


N = 40_000
TARGET, SCREEN = norm(0.0, 1.0), norm(0.7, 1.6)


def evaluating(law, seen=None):
    """Points as particles of a law; the screen is zero below -2.5."""

    def evaluate(x, rng):
        n = len(x)
        if seen is not None:
            seen.append(n)
        log_density = law.logpdf(x[:, 0])
        if law is SCREEN:
            log_density = np.where(x[:, 0] < -2.5, -np.inf, log_density)
        none = np.empty((n, 0))
        return Particles(x, np.zeros(n), np.zeros(n), log_density, none.astype(np.int64), none)

    return evaluate


@pytest.mark.parametrize("temperature", [1.0, 0.25])
def test_the_target_is_invariant(temperature):
    """Particles of the target, as far as the screen is positive, stay so: 4 errors of 4 moments."""
    rng, seen = np.random.default_rng(1), []
    evaluate = evaluating(TARGET, seen)
    law = norm(0.0, 1.0 / np.sqrt(temperature))
    start = law.rvs(3 * N, random_state=rng)
    x = start[start > -2.5][:N, np.newaxis]
    particles = evaluate(x, rng)
    population = Populations.of_equal_weights(particles.at(np.arange(500)), 1)
    kernel = fitted_kernel(population, 1.0, rng, evaluating(SCREEN))
    truth = [np.mean(x**k) for k in range(1, 5)]
    seen.clear()
    for _ in range(10):
        particles, rates = metropolis(particles, kernel, temperature, evaluate, rng)
        assert rates.n_evaluated == seen[-1] < 0.8 * N
    assert not np.isclose(particles.x, x).mean() > 0.2  # nearly all have moved
    for k, expected in enumerate(truth, start=1):
        powers = particles.x**k
        error = np.sqrt(2.0) * powers.std() / np.sqrt(N)
        assert abs(powers.mean() - expected) < 4 * error
    np.testing.assert_array_equal(particles.increment, TARGET.logpdf(particles.x[:, 0]))


def test_no_proposal_may_pass():
    rng = np.random.default_rng(1)
    evaluate = evaluating(TARGET)
    particles = evaluate(rng.normal(size=(50, 1)), rng)

    def impossible(x, rng):
        found = evaluate(x, rng)
        return found._replace(log_prior=np.full(len(x), -np.inf))

    kernel = fitted_kernel(Populations.of_equal_weights(particles, 1), 1.0, rng, impossible)
    moved, rates = metropolis(particles, kernel, 1.0, evaluate, rng)
    assert moved is particles
    assert rates.n_evaluated == rates.all == 0
