"""Which numbers of particles to measure, and which to suggest: the variance falls about as 1/N."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from pymc_statespace_filters.sampling.output.likelihood_variance import TOO_NOISY, SeedSpread

# Numbers that are tried: two digits at most, each at most a sixth above the one before.
_MANTISSAS = (1, 1.1, 1.2, 1.4, 1.6, 1.8, 2, 2.2, 2.5, 2.8, 3, 3.5, 4, 4.5, 5, 5.5, 6, 7, 8, 9, 10)
LEAST = 10  # particles
MOST_NUMBERS = 7
# The largest step from one number to the next, for the law is rough where the variance is large;
# and the largest number, in units of the first and of this many particles at least.
_JUMP, _GROWTH, _FIRST = 8.0, 64, 250
# The variance does not fall if eight times the particles leave this share of it, or more.
_STUBBORN = 0.6
# Distance kept from the upper end of the target, for what is measured has an error.
_MARGIN = 1.2


class Row(NamedTuple):
    """What is known of one number of particles.

    Attributes
    ----------
    n_particles : int
    centre : SeedSpread
    tail : float
        Largest variance at the tail points; NaN where it was not measured.
    n_failed : int
        Evaluations that failed, at all points.
    seconds : float
        Of one evaluation at the centre.
    """

    n_particles: int
    centre: SeedSpread
    tail: float
    n_failed: int
    seconds: float


def search(measure: Callable[[int], Row], first: int, target: tuple[float, float]) -> list[Row]:
    """Measure numbers of particles until the variance at the centre brackets the target.

    Parameters
    ----------
    measure : callable
    first : int
        The number to begin with.
    target : (float, float)

    Returns
    -------
    list of Row
        Seven at most, from the smallest number to the largest.
    """
    rows = [measure(first)]
    while len(rows) < MOST_NUMBERS:
        wanted = _next_number(rows, first, target)
        if wanted is None:
            break
        rows = sorted([*rows, measure(wanted)])
    return rows


def choose(rows: Sequence[Row], target: tuple[float, float]) -> tuple[Row, str | None]:
    """Choose the smallest number whose variance lies in the target, and in the tail below 10.

    Returns
    -------
    Row
    str or None
        Why the choice is not good, if it is not.
    """
    low, high = target
    inside = [row for row in rows if low <= row.centre.variance <= high]
    safe = [row for row in inside if row.centre.variance <= high / _margin(target)] or inside
    calm = [row for row in safe if row.tail <= TOO_NOISY]
    if calm:
        return calm[0], None
    if inside:
        row = inside[-1]
        return row, (
            f"in the tail of the pilot posterior the variance of the estimated log-likelihood "
            f"reaches {row.tail:.3g} with {row.n_particles} particles: chains will stand still "
            "there for long. More particles than the target asks for may be worth their time"
        )
    quiet = [row for row in rows if row.centre.variance < low]
    if quiet and quiet[0].n_particles <= LEAST:
        return quiet[0], None
    if quiet:
        return quiet[0], (
            f"no number that was tried brings the variance between {low:g} and {high:g}: "
            f"{quiet[0].n_particles} particles lie below it, at {quiet[0].centre.variance:.3g}"
        )
    first, last = rows[0], rows[-1]
    return last, (
        f"the variance of the estimated log-likelihood at the centre does not come down to "
        f"{high:g}: it is {first.centre.variance:.3g} with {first.n_particles} particles and "
        f"{last.centre.variance:.3g} with {last.n_particles}, the most that were tried. If it "
        "falls slower than one over the number, particles collapse at some observation: see at "
        "which one the terms of psf.log_likelihood scatter over seeds, and compare the filters "
        "there"
    )


def _margin(target: tuple[float, float]) -> float:
    return min(_MARGIN, (target[1] / target[0]) ** 0.25)


def _next_number(rows: Sequence[Row], first: int, target: tuple[float, float]) -> int | None:
    """Give the next number to measure, None if there is none."""
    low, high = target
    margin, most = _margin(target), _GROWTH * max(first, _FIRST)
    aim = high / margin**2
    numbers = [row.n_particles for row in rows]
    nearest = min(
        rows, key=lambda row: (abs(_log_ratio(row.centre.variance, aim)), -row.n_particles)
    )
    if abs(_log_ratio(nearest.centre.variance, aim)) > math.log(margin):
        factor = min(_JUMP, max(1.0 / _JUMP, nearest.centre.variance / aim))
        wanted = min(most, pleasant(nearest.n_particles * factor))
        if wanted not in numbers and not _is_stubborn(rows, high):
            return wanted
    calmer = _calmer_number(rows, target)
    if calmer is not None:
        return calmer
    if numbers[0] > LEAST and not any(row.centre.variance > high for row in rows):
        return pleasant(0.5 * numbers[0])
    if numbers[-1] < most and any(low <= row.centre.variance <= high for row in rows[-1:]):
        return min(most, pleasant(2.5 * numbers[-1]))
    return None


def _calmer_number(rows: Sequence[Row], target: tuple[float, float]) -> int | None:
    """Give a number with less noise in the tail that the centre still allows, if one is needed."""
    inside = [row for row in rows if target[0] <= row.centre.variance <= target[1]]
    if not inside or any(row.tail <= TOO_NOISY for row in inside):
        return None
    row, margin = inside[-1], _margin(target)
    factor = min(margin * row.tail / TOO_NOISY, row.centre.variance / (target[0] * margin))
    wanted = pleasant(row.n_particles * factor)
    return wanted if wanted > row.n_particles else None


def pleasant(number: float) -> int:
    """Round up to a number of two digits at most, and no less than ten."""
    if number <= LEAST:
        return LEAST
    decade = 10 ** math.floor(math.log10(number))
    return next(round(m * decade) for m in _MANTISSAS if m * decade >= number * (1.0 - 1e-9))


def _is_stubborn(rows: Sequence[Row], high: float) -> bool:
    noisy = [row for row in rows if row.centre.variance > high]
    return any(
        b.n_particles >= _JUMP * a.n_particles
        and b.centre.variance >= _STUBBORN * a.centre.variance
        for a in noisy
        for b in noisy
        if a.centre.variance < math.inf
    )


def _log_ratio(variance: float, aim: float) -> float:
    return math.log(min(max(variance, 1e-12), 1e12) / aim)
