"""How far an approximate filter is from the likelihood, at draws and where the chain did not go.

Three findings. A shortfall is proved as in `low`, by unbiased estimates at any tails. The mean
difference, which moves the evidence, and its covariance with the parameters, which moves them, need
a reference that is close to the likelihood: an exact filter, or plain particles that scatter
little. Guided particles alone are none, as they may go astray where the filter does.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, stdtrit

from ...filters.written import short_form
from .estimates import Comparison, Estimates
from .finding import ALPHA, FINE, OFF, TOLERATED, UNDECIDED, VISIBLE, Finding, cure, nats
from .low import shortfall, without_likelihood
from .points import Points

Array = NDArray[np.float64]

# Posterior standard deviations by which a parameter may be moved.
_TOLERATED_SHIFT = 0.5
_FEWEST = 4  # points of one spread, from which a covariance is taken
# Nats above the errors by which guided particles must exceed plain ones to be preferred to them.
_HIGHER = 0.3
_N_ERRORS = 3.0


class _Difference(NamedTuple):
    """Filter minus reference at n draws: the mean, its standard error, and the spread.

    The spread is the standard deviation without the part that is due to the noise of both.
    """

    n: int
    mean: float
    se: float
    spread: float

    @property
    def margin(self) -> float:
        """Half of the confidence interval of the mean."""
        return float(stdtrit(max(self.n - 1, 1), 1.0 - ALPHA / 2.0) * self.se)

    @property
    def least_spread(self) -> float:
        """The lower end of an interval for the spread, as if differences were normal."""
        dof = max(self.n - 1, 1)
        return float(self.spread * np.sqrt(dof / chdtri(dof, ALPHA)))


def bias_at_draws(found: Comparison, points: Points, names: Sequence[str]) -> list[Finding]:
    """Compare an approximate filter with the likelihood at the points, of which some are draws."""
    draws = found.at(points.spread == 1.0)
    if (lost := without_likelihood(draws, "bias", "at draws")) is not None:
        return [lost]
    name, reference = short_form(found.checked.filter), reference_of(draws)
    if reference is None:
        return [_without_reference(draws, name)]
    bias = _difference(draws.checked, reference)
    if bias.n < 2:
        verdict = f"undecided whether {name} is off: {short_form(reference.filter)} fails at draws"
        return [Finding("bias", np.nan, np.nan, ALPHA, np.inf, UNDECIDED, verdict)]
    moved = _shifts(found, points, names, reference)
    visible = abs(bias.mean) + bias.margin
    size = f"{nats(abs(bias.mean))} ± {nats(bias.se)} nats"
    side, other = "below" if bias.mean < 0.0 else "above", short_form(reference.filter)
    what = f"{name} is {size} {side} {other} at draws"
    worst = max(moved, key=lambda one: abs(one.statistic), default=None)
    moves = "" if worst is None else f"; {worst.verdict}"
    is_moved = any(one.outcome == OFF for one in moved)
    if abs(bias.mean) - bias.margin > TOLERATED or is_moved or bias.least_spread > VISIBLE:
        outcome = OFF
        verdict = (
            f"{what}, by which the log-evidence is off, and this varies by {nats(bias.spread)} "
            f"between draws{moves}. {cure(draws)}"
        )
    elif any(one.outcome == UNDECIDED for one in moved):
        outcome = UNDECIDED
        verdict = f"undecided whether {name} is off: {what}{moves}, which is too uncertain to tell"
    elif visible <= VISIBLE:
        outcome = FINE
        verdict = (
            f"{name} is close to {other}: {size} {side} it at draws{moves} (a warning begins where "
            f"more than {TOLERATED:g} nat or {_TOLERATED_SHIFT:g} sd are certain)"
        )
    else:
        outcome = UNDECIDED
        verdict = f"undecided whether {name} is off: {what}, too uncertain to exclude {VISIBLE:g}"
    bias_row = Finding("bias", bias.mean, bias.se, ALPHA, visible, outcome, verdict)
    return [bias_row, *moved]


def bias_elsewhere(found: Comparison, draws: Comparison) -> Finding | None:
    """Test whether the filter is lower at other points than at draws, whose chain avoids them.

    Lower by more than what is usual between draws. None if that is not known.
    """
    lost = without_likelihood(found, "bias elsewhere", "at points as likely as its draws")
    if lost is not None:
        return lost
    reference = reference_of(draws)
    if reference is None:
        return None
    name = short_form(found.checked.filter)
    usual = _difference(draws.checked, reference)
    proved = shortfall(found, found.checked.mean - usual.mean) - _N_ERRORS * usual.se
    if not proved > VISIBLE + _N_ERRORS * usual.spread:
        verdict = f"no sign that {name} keeps the chain away from other points"
        return Finding("bias elsewhere", proved, np.nan, ALPHA, np.nan, FINE, verdict)
    verdict = (
        f"{name} keeps the chain away from points that are as likely as its draws: there it is "
        f"{nats(proved)} nats lower at least, against the likelihood, than at draws. {cure(found)}"
    )
    return Finding("bias elsewhere", proved, np.nan, ALPHA, np.nan, OFF, verdict)


def reference_of(found: Comparison) -> Estimates | None:
    """The estimates that are closest to the likelihood; None if none are known to be close.

    Where plain and guided particles differ the higher ones are: unbiased estimates fail by being
    too low nearly always.
    """
    if found.exact is not None:
        return found.exact
    plain = found.plain
    if plain is None or not plain.is_usable:
        return None
    for guided in found.guided:
        gap = guided.mean - plain.mean
        gap = gap[np.isfinite(gap)]
        if not guided.is_usable or gap.size < 2:
            continue
        spread = float(gap.std(ddof=1) / np.sqrt(gap.size))
        if abs(gap.mean()) <= 3.0 * spread + _HIGHER:
            return min(plain, guided, key=lambda one: one.typical_error)
        return guided if gap.mean() > 0.0 else plain
    return plain


def _without_reference(draws: Comparison, name: str) -> Finding:
    proved = shortfall(draws, draws.checked.mean)
    if proved > TOLERATED:
        verdict = (
            f"{name} is at least {nats(proved)} nats too low at some draws, and so is the "
            f"log-evidence. {cure(draws)}"
        )
        return Finding("bias", -proved, np.nan, ALPHA, np.nan, OFF, verdict)
    return Finding("bias", np.nan, np.nan, ALPHA, np.inf, UNDECIDED, _undecided(draws, name))


def _undecided(draws: Comparison, name: str) -> str:
    text = f"undecided whether {name} is off: no filter without a guide takes this system"
    if draws.plain is not None:
        text = (
            f"undecided whether {name} is off: plain particles, {short_form(draws.plain.filter)}, "
            f"scatter by {nats(draws.plain.scatter)} nats"
        )
    for one in draws.guided:
        gap = float(np.median(draws.checked.mean - one.mean))
        text += (
            f"; {short_form(one.filter)} is {nats(abs(gap))} nats "
            f"{'above' if gap < 0.0 else 'below'} {name}, but may go astray where that does"
        )
    return text


def _difference(checked: Estimates, reference: Estimates) -> _Difference:
    values = checked.mean - reference.mean
    known = np.isfinite(values)
    noise = float(np.mean((checked.error**2 + reference.error**2)[known])) if known.any() else 0.0
    n = int(known.sum())
    if n < 2:
        return _Difference(n, np.nan, np.inf, np.nan)
    variance = float(values[known].var(ddof=1))
    spread = np.sqrt(max(variance - noise, 0.0))
    return _Difference(n, float(values[known].mean()), np.sqrt(max(variance, noise) / n), spread)


def _shifts(
    found: Comparison, points: Points, names: Sequence[str], at_draws: Estimates
) -> list[Finding]:
    """By how many posterior standard deviations the difference moves each parameter.

    To first order, its covariance with the difference over its standard deviation. At points spread
    out by a factor it is larger by the square of that factor.
    """
    kind = type(at_draws.filter)
    witnesses = [one for one in (found.exact, found.plain, *found.guided) if one is not None]
    reference = next(one for one in witnesses if type(one.filter) is kind)
    lost = reference.mean - found.checked.mean
    products = np.concatenate(
        [
            _products(points.z[rows], lost[rows], spread)
            for spread in np.unique(points.spread[points.spread > 0.0])
            for rows in [(points.spread == spread) & np.isfinite(lost)]
        ]
    )
    if len(products) < _FEWEST:
        return []
    shifts = products.mean(axis=0)
    errors = products.std(axis=0, ddof=1) / np.sqrt(len(products))
    margin = stdtrit(len(products) - 1, 1.0 - ALPHA / (2.0 * len(names)))
    return [
        _shift(name, float(shift), float(se), float(margin * se))
        for name, shift, se in zip(names, shifts, errors, strict=True)
    ]


def _products(z: Array, lost: Array, spread: float) -> Array:
    """Terms (n, k) whose mean is the covariance, scaled to the spread of draws; none of too few."""
    n = len(lost)
    if n < _FEWEST:
        return z[:0]
    centred = (z - z.mean(axis=0)) * (lost - lost.mean())[:, None]
    return centred * n / (n - 1) / spread**2


def _shift(name: str, shift: float, se: float, margin: float) -> Finding:
    outcome = OFF if abs(shift) - margin > _TOLERATED_SHIFT else FINE
    if outcome == FINE and abs(shift) + margin > VISIBLE:
        outcome = UNDECIDED
    moved = f"would move by {shift:+.1f} ± {se:.1f} sd if the filter were exact"
    verdict = f"the posterior of {name} {moved}"
    return Finding(f"shift of {name}", shift, se, ALPHA, abs(shift) + margin, outcome, verdict)
