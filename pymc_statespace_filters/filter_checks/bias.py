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
from scipy.stats import t as student_t

from ..filters.recommendation import short_form
from .estimates import Comparison, Estimates
from .finding import ALPHA, FINE, OFF, TOLERATED, UNDECIDED, VISIBLE, Finding, cure, nats
from .low import shortfall
from .points import Points

Array = NDArray[np.float64]

# Posterior standard deviations by which a parameter may be moved.
_TOLERATED_SHIFT = 0.5
# Nats above the errors by which guided particles must exceed plain ones to be preferred to them.
_HIGHER = 0.3


class _Difference(NamedTuple):
    """Filter minus reference at draws: values, errors of the reference, mean and its error."""

    values: Array
    errors: Array
    mean: float
    se: float


def bias_at_draws(found: Comparison, points: Points, names: Sequence[str]) -> list[Finding]:
    """Compare an approximate filter with the likelihood at the points, of which some are draws."""
    draws = found.at(points.spread == 1.0)
    name, proved = short_form(found.checked.filter), shortfall(draws, draws.checked.mean)
    reference = reference_of(draws)
    if reference is None:
        return [_without_reference(draws, name, proved)]
    bias = _difference(draws.checked, reference)
    moved = _shifts(found, points, names, reference)
    margin = student_t.ppf(1.0 - ALPHA / 2.0, max(bias.values.size - 1, 1)) * bias.se
    visible = abs(bias.mean) + margin
    what = (
        f"{name} is {nats(abs(bias.mean))} ± {nats(bias.se)} nats "
        f"{'below' if bias.mean < 0.0 else 'above'} {short_form(reference.filter)} at draws"
    )
    worst = max(moved, key=lambda one: abs(one.statistic), default=None)
    moves = "" if worst is None else f"; {worst.verdict}"
    is_off = proved > VISIBLE or abs(bias.mean) - margin > TOLERATED
    if is_off or any(one.outcome == OFF for one in moved):
        outcome, verdict = OFF, f"{what}, and so is the log-evidence{moves}. {cure(draws)}"
    elif visible <= VISIBLE:
        outcome, verdict = FINE, f"no sign that {name} is off: {what}{moves}"
    else:
        outcome = UNDECIDED
        verdict = f"undecided whether {name} is off: {what}, too uncertain to exclude {VISIBLE:g}"
    bias_row = Finding("bias", bias.mean, bias.se, ALPHA, visible, outcome, verdict)
    return [bias_row, *moved]


def bias_elsewhere(found: Comparison, draws: Comparison) -> Finding | None:
    """Test whether the filter is lower at other points than at draws, whose chain avoids them.

    None if it is not known by how much it is too low at draws.
    """
    reference = reference_of(draws)
    if reference is None:
        return None
    name = short_form(found.checked.filter)
    usual = _difference(draws.checked, reference)
    proved = shortfall(found, found.checked.mean - usual.mean) - 3.0 * usual.se
    if proved <= VISIBLE:
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


def _without_reference(draws: Comparison, name: str, proved: float) -> Finding:
    if proved > TOLERATED:
        verdict = (
            f"{name} is at least {nats(proved)} nats too low at some draws, and so is the "
            f"log-evidence. {cure(draws)}"
        )
        return Finding("bias", -proved, np.nan, ALPHA, np.nan, OFF, verdict)
    return Finding("bias", np.nan, np.nan, ALPHA, np.inf, UNDECIDED, _undecided(draws, name))


def _undecided(draws: Comparison, name: str) -> str:
    if draws.plain is None:
        return f"undecided whether {name} is off: no unbiased filter takes this system"
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
    values = values[known]
    errors = np.hypot(checked.error, reference.error)[known]
    if values.size < 2:
        return _Difference(values, errors, values.sum(), np.inf)
    scatter = max(float(values.var(ddof=1)), float((errors**2).mean()))
    return _Difference(values, errors, float(values.mean()), float(np.sqrt(scatter / values.size)))


def _shifts(
    found: Comparison, points: Points, names: Sequence[str], at_draws: Estimates
) -> list[Finding]:
    """By how many posterior standard deviations the difference moves each parameter.

    To first order, its covariance with the difference over its standard deviation. Points spread
    out by a factor tell the same with the square of that factor: both are averaged.
    """
    kind = type(at_draws.filter)
    groups = []
    for spread in np.unique(points.spread[points.spread > 0.0]):
        rows = points.spread == spread
        here = found.at(rows)
        same = [one for one in (here.exact, here.plain, *here.guided) if one is not None]
        reference = next(one for one in same if type(one.filter) is kind)
        groups.append((spread, points.z[rows], here.checked.mean - reference.mean))
    level = 1.0 - ALPHA / (2.0 * max(len(names), 1))
    rows_found = []
    for column, name in enumerate(names):
        parts = [_shift(z[:, column], values, spread) for spread, z, values in groups]
        weights = np.array([1.0 / se**2 for _, se, _ in parts])
        if not weights.sum() > 0.0:
            continue
        shift = float(weights @ [one for one, _, _ in parts] / weights.sum())
        se = float(weights.sum() ** -0.5)
        margin = student_t.ppf(level, max(sum(dof for _, _, dof in parts), 1)) * se
        outcome = OFF if abs(shift) - margin > _TOLERATED_SHIFT else FINE
        if outcome == FINE and abs(shift) + margin > VISIBLE:
            outcome = UNDECIDED
        verdict = f"{name} moves by {shift:+.1f} ± {se:.1f} of its posterior sd"
        rows_found.append(
            Finding(f"shift of {name}", shift, se, ALPHA, abs(shift) + margin, outcome, verdict)
        )
    return rows_found


def _shift(z: Array, values: Array, spread: float) -> tuple[float, float, int]:
    """The shift by points of one spread, its standard error and degrees of freedom."""
    known = np.isfinite(values)
    n = int(known.sum())
    if n < 4:
        return 0.0, np.inf, 0
    z, lost = z[known] - z[known].mean(), -(values[known] - values[known].mean())
    products = z * lost
    shift = products.sum() / (n - 1) / spread**2
    se = products.std(ddof=1) / np.sqrt(n) / spread**2
    return float(shift), float(max(se, 1e-12)), n - 1
