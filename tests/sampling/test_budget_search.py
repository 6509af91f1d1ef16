"""Which numbers are measured and which is suggested, on laws of the variance that are known."""

import numpy as np
import pytest

from pymc_statespace_filters.sampling.output.likelihood_variance import SeedSpread
from pymc_statespace_filters.sampling.particle_number.search import (
    LEAST,
    MOST_NUMBERS,
    Row,
    choose,
    round_up,
    search,
)

TARGET = (1.0, 3.3)


def budget(law, first, target=TARGET, tail=2.0, rng=None):
    """Rows and choice where the variance is law(N), measured without error if rng is None."""

    def measure(n):
        error = 1.0 if rng is None else rng.chisquare(99) / 99
        variance = law(n) * error
        spread = SeedSpread(100, -1.0, variance, 0.8 * variance, 1.2 * variance, 0)
        return Row(n, spread, tail * variance, 0, 1e-3)

    rows = search(measure, first, target)
    return rows, *choose(rows, target)


def test_pleasant_numbers_round_up_in_small_steps():
    assert [round_up(x) for x in (3, 10, 10.5, 11, 13, 170, 999, 1000, 4100, 61_000)] == [
        10, 10, 11, 11, 14, 180, 1000, 1000, 4500, 70_000,
    ]  # fmt: skip
    numbers = np.geomspace(20, 1e6, 500)
    ratios = np.array([round_up(x) for x in numbers]) / numbers
    assert ratios.min() > 1.0 - 1e-9
    assert ratios.max() < 1.2


@pytest.mark.parametrize("scale", [25.0, 300.0, 2900.0, 12_000.0])
@pytest.mark.parametrize("first", [30, 250, 1000])
def test_the_suggestion_lies_in_the_target_and_the_table_brackets_it(scale, first):
    rows, suggested, reading = budget(lambda n: scale / n, first)
    variances = [row.centre.variance for row in rows]
    assert reading is None
    assert len(rows) <= MOST_NUMBERS
    assert 1.0 < suggested.centre.variance <= 3.3 / 1.2
    if len(rows) < MOST_NUMBERS:
        assert max(variances) > 3.3 or rows[0].n_particles == LEAST
        assert min(variances) < 1.0
    assert [row.n_particles for row in rows] == sorted({row.n_particles for row in rows})


def test_errors_of_measurement_leave_the_suggestion_in_the_target():
    """100 seeds a measurement, 1000 searches: the true variance is in the target in all but 1 %."""
    rng = np.random.default_rng(1)
    scales = np.exp(rng.uniform(np.log(50.0), np.log(2e4), 1000))
    found = [budget(lambda n, a=a: a / n, 500, rng=rng)[1].n_particles for a in scales]
    true = scales / np.array(found)
    assert np.mean((true < 1.0) | (true > 3.3)) <= 0.01


@pytest.mark.parametrize("target", [(0.2, 0.5), (1.2, 2.0), (3.0, 9.0)])
def test_other_targets(target):
    _, suggested, reading = budget(lambda n: 500.0 / n, 400, target, tail=1.0)
    assert reading is None
    assert target[0] <= suggested.centre.variance <= target[1]


def test_a_variance_that_does_not_fall_is_named_after_few_numbers():
    rows, suggested, reading = budget(lambda n: 30.0 + 100.0 / n, 100)
    assert len(rows) <= 3
    assert suggested is rows[-1]
    assert "does not decrease to 3.3: it is 31 with 100 particles and 30." in reading


def test_a_variance_that_falls_too_slowly_ends_at_the_largest_number():
    rows, suggested, reading = budget(lambda n: 5000.0 / n**0.5, 100)
    assert suggested is rows[-1]
    assert rows[-1].n_particles <= 64 * 250
    assert "does not decrease" in reading


def test_too_little_noise_at_ten_particles_is_no_fault():
    rows, suggested, reading = budget(lambda n: 2.0 / n, 1000)
    assert (suggested.n_particles, reading) == (10, None)
    assert rows[0] is suggested


def test_noise_in_the_tail_asks_for_more_particles_within_the_target():
    _, calm, _ = budget(lambda n: 1000.0 / n, 500)
    _, suggested, reading = budget(lambda n: 1000.0 / n, 500, tail=6.0)
    assert reading is None
    assert suggested.n_particles > calm.n_particles
    assert suggested.tail <= 10.0
    assert suggested.centre.variance >= 1.0
    _, largest, reading = budget(lambda n: 1000.0 / n, 500, tail=50.0)
    assert "in the tail" in reading
    assert 1.0 <= largest.centre.variance < calm.centre.variance


def test_failures_at_few_particles_are_climbed_over():
    _, suggested, reading = budget(lambda n: np.inf if n < 300 else 800.0 / n, 20)
    assert reading is None
    assert 1.0 <= suggested.centre.variance <= 3.3
