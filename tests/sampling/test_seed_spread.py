"""The spread of estimates over seeds, its interval, and what is said of it."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice.noise import variance_advice
from pymc_statespace_filters.sampling.kernel.state import Evaluation
from pymc_statespace_filters.sampling.output.likelihood_variance import (
    MIDDLE,
    SeedSpread,
    acceptance_share,
    seed_spread,
    spread_of,
)
from pymc_statespace_filters.sampling.target.log_density import LogDensity
from tests.sampling.noisy_toy import noisy_model


def of_variance(variance, n=50, n_failed=0):
    return SeedSpread(n, -3.0, variance, 0.8 * variance, 1.2 * variance, n_failed)


def test_moments_are_those_of_the_finite_estimates():
    values = np.array([-3.0, -np.inf, -1.0, -4.5, -np.inf, -2.0])
    finite = values[np.isfinite(values)]
    spread = spread_of(values)
    assert (spread.n, spread.n_failed) == (4, 2)
    np.testing.assert_allclose(spread[1:3], [finite.mean(), finite.var(ddof=1)], rtol=1e-14)
    assert spread.variance_low < spread.variance < spread.variance_high


def test_interval_is_that_of_a_jackknife_by_hand():
    values = np.random.default_rng(1).normal(size=12)
    logs = np.log([np.delete(values, i).var(ddof=1) for i in range(12)])
    error = np.sqrt(11 / 12 * np.sum((logs - logs.mean()) ** 2))
    spread = spread_of(values)
    t_11 = 2.200985160082949
    np.testing.assert_allclose(spread.variance_high / spread.variance, np.exp(t_11 * error))
    np.testing.assert_allclose(spread.variance / spread.variance_low, np.exp(t_11 * error))


@pytest.mark.parametrize("draw", ["standard_normal", "standard_exponential"])
def test_interval_covers(draw):
    """Variance 1 from 100 numbers, 2000 times; the coverage's standard error is below 0.7 %.

    Skewed numbers are covered less often, but the chi-square interval would cover them in 68 %.
    """
    numbers = getattr(np.random.default_rng(2), draw)((2000, 100))
    spreads = [spread_of(row) for row in numbers]
    coverage = np.mean([s.variance_low < 1.0 < s.variance_high for s in spreads])
    assert 0.86 < coverage < 0.97


def test_estimates_without_spread_or_in_too_small_number():
    assert spread_of(np.full(5, -2.0)) == (5, -2.0, 0.0, 0.0, 0.0, 0, "")
    assert spread_of(np.array([-2.0, -3.0, -np.inf])) == (2, -np.inf, np.inf, 0.0, np.inf, 1, "")
    assert spread_of(np.array([-2.0, -2.0, -2.0, -9.0]))[3:] == (0.0, np.inf, 0, "")


def test_each_row_of_seeds_is_one_evaluation():
    seen = []

    def log_density(position, others, seeds):
        seen.append((position, others, seeds))
        return Evaluation(-float(seeds[0]) if seeds[1] > 0 else -np.inf, 0, np.inf)

    position, others = np.array([0.3]), (np.array(2.0),)
    spread = seed_spread(log_density, position, others, np.array([[1, 1], [4, 1], [9, 0], [7, 1]]))
    assert spread[:3] == (3, -4.0, 9.0)
    assert spread.n_failed == 1
    assert all(call[0] is position and call[1] is others for call in seen)
    assert [tuple(map(int, call[2])) for call in seen] == [(1, 1), (4, 1), (9, 0), (7, 1)]
    assert all(seed.shape == () and seed.dtype == np.int64 for call in seen for seed in call[2])


def test_a_known_noise_is_found():
    """Noise of variance 1.69: missed by 4 standard errors once in 16 000 times."""
    model, seed = noisy_model(noise_sd=1.3)
    density = LogDensity(model, model.value_vars, model.initial_point(), {"d": seed}).bind()
    seeds = np.random.default_rng(4).integers(0, 2**63 - 1, size=(2000, 1))
    spread = seed_spread(density, np.array([1.0]), (), seeds)
    assert abs(spread.variance - 1.69) < 4.0 * 1.69 * np.sqrt(2.0 / 2000)


@pytest.mark.parametrize("variance", [0.04, 1.0, 3.3, 10.0])
def test_acceptance_share_is_that_of_a_chain_on_the_noise_alone(variance):
    """The mean of min(1, e^(new - kept)) over both laws, by quadrature."""
    sd = np.sqrt(variance)
    z = np.linspace(-9.0, 9.0, 1201) * sd
    dz = z[1] - z[0]
    law = np.exp(-0.5 * (z / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi)) * dz
    kept, new = z + 0.5 * variance, z - 0.5 * variance
    move = np.minimum(1.0, np.exp(np.minimum(0.0, new[None, :] - kept[:, None])))
    np.testing.assert_allclose(acceptance_share(variance), law @ move @ law, rtol=1e-4)


def test_a_share_that_a_dozen_estimates_cannot_tell_is_no_number():
    """At 90 it would be 2e-11, where a chain with skewed errors accepted 6 %."""
    text = variance_advice(of_variance(90.0), "at the start", 0)
    assert "accepts few of the moves that it would accept with an exact likelihood" in text
    assert "accepts about 0.02 of the moves" in variance_advice(of_variance(11.0), "here", 0)


@pytest.mark.parametrize("variance", [0.0, 0.05, 1.0, 3.3, 10.0])
def test_nothing_is_said_of_a_fair_spread(variance):
    assert variance_advice(of_variance(variance), "at the start", 0) is None


def test_too_much_noise_names_chain_place_and_cure():
    text = variance_advice(of_variance(40.0 * MIDDLE), "at the start", 3)
    assert text.startswith("Chain 3, at the start: ")
    assert "variance of 72.7 over 50 noise seeds" in text
    assert ": 40 times as many" in text


def test_a_number_that_no_one_would_take_is_not_named():
    text = variance_advice(of_variance(1e7), "here", 0, [psf.BootstrapPF(1000)], "Use EKF().")
    assert "times as many" not in text
    assert text.endswith("More particles would hardly do. Use EKF().")


@pytest.mark.parametrize(
    ("filter", "variance", "fewer"),
    [
        (psf.BootstrapPF(100_000), MIDDLE / 250.0, 250),
        (psf.EnKF(2000), 1e-7, 200),  # ten members are left
        (psf.GuidedPF(5000), MIDDLE / 100.0, 100),
        (psf.GuidedPF(50), MIDDLE / 540.0, None),  # fewer than ten would be
        (psf.GuidedPF(100), 1e-4, None),  # its guide takes five times as long as they do
        (psf.BootstrapPF(100), MIDDLE / 100.0, None),
    ],
    ids=str,
)
def test_fewer_particles_are_advised_where_they_save_time(filter, variance, fewer):
    text = variance_advice(of_variance(variance), "at its highest draw", 1, [filter])
    assert (text is not None) == (fewer is not None)
    if fewer:
        assert text.startswith("Chain 1, at its highest draw: ")
        assert f"about {fewer} times fewer" in text


def test_an_estimate_without_noise_needs_no_advice():
    """That of a guided filter on a linear system varies by rounding only."""
    assert variance_advice(of_variance(2e-29), "at its highest draw", 0) is None


def test_estimates_that_fail_are_named():
    text = variance_advice(of_variance(1.0, n=10, n_failed=20), "at the start", 0)
    assert "failed for 20 of 30 noise seeds" in text
    assert "failed for 8 of 8" in variance_advice(spread_of(np.full(8, -np.inf)), "here", 0)
