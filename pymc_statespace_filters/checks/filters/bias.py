"""How far an approximate filter is from the likelihood, at draws and where the chain did not go.

Three findings. A shortfall is proved as in `low`, by unbiased estimates at any tails. The mean
difference, which moves the evidence, and its covariance with the parameters, which moves them, need
a reference that is close to the likelihood: an exact filter, or particles that scatter little.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from ...filters.protocol import Filter
from ...filters.written import short_form
from .estimates import Comparison, Estimates
from .finding import (
    ALPHA,
    FINE,
    OFF,
    TOLERATED,
    UNDECIDED,
    VISIBLE,
    Difference,
    Finding,
    cure,
    difference,
    nats,
    scatter_of,
)
from .low import shortfall, without_likelihood

Array = NDArray[np.float64]

# Posterior standard deviations by which a parameter may be moved, and by which it would have been
# seen to be moved when no more draws are compared.
_TOLERATED_SHIFT, _SEEN_SHIFT = 0.5, 1.0
_FEWEST = 4  # draws, from which a covariance is taken
# Nats above the errors by which guided particles must exceed plain ones to be preferred to them.
_HIGHER = 0.3
_QUIET = 0.5  # nats by which guided particles scatter at most, whose mean is trusted without others
_N_ERRORS = 3.0


def not_compared(filter: Filter, reason: str) -> Finding:
    """That there was no witness, and why."""
    verdict = f"undecided whether {short_form(filter)} is off: {reason}"
    return Finding("bias", np.nan, np.nan, ALPHA, np.inf, UNDECIDED, verdict)


def bias_at_draws(found: Comparison, x: Array, names: Sequence[str]) -> list[Finding]:
    """Compare an approximate filter with the likelihood at draws.

    ``x`` (m, k) are the draws in standard deviations, and ``names`` those of their elements.
    """
    if (lost := without_likelihood(found, "bias", "at draws")) is not None:
        return [lost]
    name, reference = short_form(found.checked.filter), reference_of(found)
    if reference is None:
        return [_without_reference(found, name)]
    bias, other = difference(found.checked, reference), short_form(reference.filter)
    if bias.n < 2:
        return [not_compared(found.checked.filter, f"{other} fails at draws")]
    moved = _shifts(reference.mean - found.checked.mean, x, names, bias)
    visible = abs(bias.mean) + bias.margin
    size = f"{nats(abs(bias.mean))} ± {nats(bias.se)} nats"
    side = "below" if bias.mean < 0.0 else "above"
    what = f"{name} is {size} {side} {other} at draws"
    most = max((one.visible for one in moved), default=bias.most_spread)
    moves = f"no parameter would move by more than {max(most, 0.1):.1f} sd"
    worst = max(moved, key=lambda one: abs(one.statistic) * (one.outcome == OFF), default=None)
    is_moved = worst is not None and worst.outcome == OFF
    if abs(bias.mean) - bias.margin > TOLERATED or is_moved or bias.least_spread > VISIBLE:
        outcome = OFF
        moves = f"; {worst.verdict}" if worst is not None and is_moved else ""
        verdict = (
            f"{what}, by which the log-evidence is off, and this varies by {nats(bias.spread)} "
            f"between draws{moves}. {cure(found)}"
        )
    elif visible <= VISIBLE and most <= VISIBLE:
        outcome, place = FINE, f"{size} {side}"
        begin = f"no sign that {name} is off: it is {place} {other} at draws, and"
        if visible <= TOLERATED and most <= _TOLERATED_SHIFT:
            begin = f"{name} is close to {other}: {place} it at draws;"
        verdict = (
            f"{begin} {moves} if the filter were exact (a warning begins where more than "
            f"{TOLERATED:g} nat or {_TOLERATED_SHIFT:g} sd are certain)"
        )
    else:
        outcome = UNDECIDED
        verdict = (
            f"undecided whether {name} is off: {what}, and {moves}, which is too uncertain to tell"
        )
    bias_row = Finding("bias", bias.mean, bias.se, ALPHA, visible, outcome, verdict)
    return [bias_row, *moved]


def is_settled(findings: Sequence[Finding]) -> bool:
    """Whether more draws would tell no more than these findings about them."""
    first, *shifts = findings
    is_seen = first.visible <= VISIBLE and all(one.visible <= _SEEN_SHIFT for one in shifts)
    return first.outcome == OFF or not shifts or is_seen


def bias_elsewhere(found: Comparison, draws: Comparison) -> list[Finding]:
    """Test whether the filter is lower at other points than at draws, whose chain avoids them.

    Lower by more than what is usual between draws. Nothing if that is not known.
    """
    lost = without_likelihood(found, "bias elsewhere", "at points as likely as its draws")
    if lost is not None:
        return [lost]
    reference = reference_of(draws)
    if reference is None:
        return []
    name = short_form(found.checked.filter)
    usual = difference(draws.checked, reference)
    proved = shortfall(found, found.checked.mean - usual.mean) - _N_ERRORS * usual.se
    if proved > VISIBLE + _N_ERRORS * usual.spread:
        outcome = OFF
        verdict = (
            f"{name} keeps the chain away from points that are as likely as its draws: there it is "
            f"{nats(proved)} nats lower at least, against the likelihood, than at draws. "
            f"{cure(found)}"
        )
    else:
        outcome, verdict = FINE, f"no sign that {name} keeps the chain away from other points"
    return [Finding("bias elsewhere", proved, np.nan, ALPHA, np.nan, outcome, verdict)]


def reference_of(found: Comparison) -> Estimates | None:
    """The estimates that are closest to the likelihood; None if none are known to be close.

    Where plain and guided particles differ the higher ones are: unbiased estimates fail by being
    too low nearly always.
    """
    if found.exact is not None:
        return found.exact
    plain, guided = found.plain, found.guided
    if plain is None or not plain.is_usable:
        return guided if guided is not None and guided.scatter <= _QUIET else None
    if guided is None or not guided.is_usable:
        return plain
    gap = guided.mean - plain.mean
    gap = gap[np.isfinite(gap)]
    if gap.size < 2:
        return plain
    spread = float(gap.std(ddof=1) / np.sqrt(gap.size))
    if abs(gap.mean()) <= 3.0 * spread + _HIGHER:
        return min(plain, guided, key=lambda one: one.typical_error)
    return guided if gap.mean() > 0.0 else plain


def _without_reference(draws: Comparison, name: str) -> Finding:
    proved = shortfall(draws, draws.checked.mean)
    if proved > TOLERATED:
        verdict = (
            f"{name} is at least {nats(proved)} nats too low at some draws, and so is the "
            f"log-evidence. {cure(draws)}"
        )
        return Finding("bias", -proved, np.nan, ALPHA, np.nan, OFF, verdict)
    return not_compared(draws.checked.filter, scatter_of(draws))


def _shifts(lost: Array, x: Array, names: Sequence[str], bias: Difference) -> list[Finding]:
    """By how many posterior standard deviations what the filter lacks moves each parameter.

    To first order, its covariance with the parameter over the parameter's standard deviation: at
    most its own standard deviation.
    """
    known = np.isfinite(lost)
    x, lost, n = x[known], lost[known], int(known.sum())
    if n < _FEWEST:
        return []
    products = (x - x.mean(axis=0)) * (lost - lost.mean())[:, None] * n / (n - 1)
    margin = stdtrit(n - 1, 1.0 - ALPHA / (2.0 * len(names)))
    ends = products.mean(axis=0), products.std(axis=0, ddof=1) / np.sqrt(n)
    return [
        _shift(name, float(shift), float(se), float(margin * se), bias.most_spread)
        for name, shift, se in zip(names, *ends, strict=True)
    ]


def _shift(name: str, shift: float, se: float, margin: float, most: float) -> Finding:
    visible = min(abs(shift) + margin, most)
    outcome = UNDECIDED if visible > VISIBLE else FINE
    moved = f"would move by less than {max(visible, 0.1):.1f} sd"
    if abs(shift) - margin > _TOLERATED_SHIFT:
        outcome, moved = OFF, f"would move by {shift:+.1f} ± {se:.1f} sd"
    verdict = f"the posterior of {name} {moved} if the filter were exact"
    return Finding(f"shift of {name}", shift, se, ALPHA, visible, outcome, verdict)
