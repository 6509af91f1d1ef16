"""Search over numbers of particles N, for a variance that is about proportional to 1/N."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from ..output.likelihood_variance import TOO_NOISY, SeedSpread

# Numbers tried have two digits at most, and each is at most a sixth above the one before.
_MANTISSAS = (1, 1.1, 1.2, 1.4, 1.6, 1.8, 2, 2.2, 2.5, 2.8, 3, 3.5, 4, 4.5, 5, 5.5, 6, 7, 8, 9, 10)
LEAST = 10  # particles
MOST_NUMBERS = 7
# Largest ratio of consecutive numbers, because 1/N is inaccurate for large variances; and the
# largest number, as a multiple of the first or of so many particles.
_JUMP, _GROWTH, _FIRST = 8.0, 64, 250
# The variance does not decrease if this fraction or more is left with eight times the particles.
_STAGNANT = 0.6
# Factor kept from the upper end of the target, for the error of measurement.
_MARGIN = 1.2


class Row(NamedTuple):
    """Measurements with one number of particles."""

    n_particles: int
    centre: SeedSpread
    tail: float  # largest variance at the tail points; NaN if it was not measured
    n_failed: int  # evaluations, at all points
    seconds: float  # CPU time of one evaluation at the centre


def search(measure: Callable[[int], Row], first: int, target: tuple[float, float]) -> list[Row]:
    """Measure numbers of particles until the variance at the centre brackets the target.

    The rows, seven at most, are in the order of the numbers.
    """
    rows = [measure(first)]
    while len(rows) < MOST_NUMBERS:
        proposed = _next_number(rows, first, target)
        if proposed is None:
            break
        rows = sorted([*rows, measure(proposed)])
    return rows


def choose(rows: Sequence[Row], target: tuple[float, float]) -> tuple[Row, str | None]:
    """Choose the smallest number with a variance in the target, and below 10 in the tail.

    Also the problem with the choice, if there is one.
    """
    low, high = target
    inside = [row for row in rows if low <= row.centre.variance <= high]
    safe = [row for row in inside if row.centre.variance <= high / _margin(target)] or inside
    quiet_in_tail = [row for row in safe if row.tail <= TOO_NOISY]
    if quiet_in_tail:
        return quiet_in_tail[0], None
    if inside:
        row = inside[-1]
        return row, (
            f"in the tail of the pilot posterior the variance of the estimated log-likelihood "
            f"reaches {row.tail:.3g} with {row.n_particles} particles: chains will stay at one "
            "point for long there. More particles than the target requires may be worth their time"
        )
    quiet = [row for row in rows if row.centre.variance < low]
    if quiet and quiet[0].n_particles <= LEAST:
        return quiet[0], None
    if quiet:
        return quiet[0], (
            f"no number tried gives a variance between {low:g} and {high:g}: with "
            f"{quiet[0].n_particles} particles it is {quiet[0].centre.variance:.3g}"
        )
    first, last = rows[0], rows[-1]
    return last, (
        f"the variance of the estimated log-likelihood at the centre does not decrease to "
        f"{high:g}: it is {first.centre.variance:.3g} with {first.n_particles} particles and "
        f"{last.centre.variance:.3g} with {last.n_particles}, the most tried. If it decreases "
        "slower than 1/N, particles collapse at some observation"
    )


def best_guess(rows: Sequence[Row], target: tuple[float, float]) -> tuple[int, Row | None]:
    """The number to suggest after an unfinished search, and its row if it was measured.

    If no number has a variance in the target, one is extrapolated: variance proportional to 1/N.
    """
    low, high = target
    aim = high / _margin(target) ** 2
    inside = [row for row in rows if low <= row.centre.variance <= high]
    if inside:
        row = min(inside, key=lambda row: abs(_log_ratio(row.centre.variance, aim)))
        return row.n_particles, row
    row = nearest_row(rows, aim)
    if not 0.0 < row.centre.variance < math.inf:
        return row.n_particles, row
    return round_up(row.n_particles * row.centre.variance / aim), None


def nearest_row(rows: Sequence[Row], aim: float) -> Row:
    """The row whose variance is nearest to the aim, of several the one with most particles."""
    return min(rows, key=lambda row: (abs(_log_ratio(row.centre.variance, aim)), -row.n_particles))


def _margin(target: tuple[float, float]) -> float:
    return min(_MARGIN, (target[1] / target[0]) ** 0.25)


def _next_number(rows: Sequence[Row], first: int, target: tuple[float, float]) -> int | None:
    """The next number to measure, None if there is none."""
    low, high = target
    margin, most = _margin(target), _GROWTH * max(first, _FIRST)
    aim = high / margin**2
    numbers = [row.n_particles for row in rows]
    nearest = nearest_row(rows, aim)
    if abs(_log_ratio(nearest.centre.variance, aim)) > math.log(margin):
        factor = min(_JUMP, max(1.0 / _JUMP, nearest.centre.variance / aim))
        proposed = min(most, round_up(nearest.n_particles * factor))
        if proposed not in numbers and not _is_stagnant(rows, high):
            return proposed
    for_tail = _number_for_tail(rows, target)
    if for_tail is not None:
        return for_tail
    if numbers[0] > LEAST and not any(row.centre.variance > high for row in rows):
        return round_up(0.5 * numbers[0])
    if numbers[-1] < most and any(low <= row.centre.variance <= high for row in rows[-1:]):
        return min(most, round_up(2.5 * numbers[-1]))
    return None


def _number_for_tail(rows: Sequence[Row], target: tuple[float, float]) -> int | None:
    """A larger number for less noise in the tail, if needed and within the target at the centre."""
    inside = [row for row in rows if target[0] <= row.centre.variance <= target[1]]
    if not inside or any(row.tail <= TOO_NOISY for row in inside):
        return None
    row, margin = inside[-1], _margin(target)
    factor = min(margin * row.tail / TOO_NOISY, row.centre.variance / (target[0] * margin))
    proposed = round_up(row.n_particles * factor)
    return proposed if proposed > row.n_particles else None


def round_up(number: float) -> int:
    """Round up to a number of at most two digits, at least ten."""
    if number <= LEAST:
        return LEAST
    decade = 10 ** math.floor(math.log10(number))
    return next(round(m * decade) for m in _MANTISSAS if m * decade >= number * (1.0 - 1e-9))


def _is_stagnant(rows: Sequence[Row], high: float) -> bool:
    noisy = [row for row in rows if row.centre.variance > high]
    return any(
        b.n_particles >= _JUMP * a.n_particles
        and b.centre.variance >= _STAGNANT * a.centre.variance
        for a in noisy
        for b in noisy
        if a.centre.variance < math.inf
    )


def _log_ratio(variance: float, aim: float) -> float:
    return math.log(min(max(variance, 1e-12), 1e12) / aim)
