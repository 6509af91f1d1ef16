"""Whether an unbiased filter is far too low, with a spread over seeds that looks small.

So it is where guided particles follow one of several explanations of the data: once in very many
seeds an estimate is far too high, and makes up for all others. Plain particles do not follow the
guide. Their estimates are unbiased too, and prove the guided ones too low whatever their tails.
"""

import numpy as np
from numpy.typing import NDArray

from ...filters.written import short_form
from .e_values import proved_shortfall, visible_shortfall
from .estimates import Comparison
from .finding import (
    ALPHA,
    FINE,
    OFF,
    TOLERATED,
    UNDECIDED,
    VISIBLE,
    Finding,
    cure,
    difference,
    nats,
    scatter_of,
)

_N_ERRORS = 3.0  # standard errors, where the other filter has none


def shortfall(found: Comparison, bounds: NDArray[np.float64]) -> float:
    """The nats by which some log-likelihood is proved to be above its bound, at level `ALPHA`."""
    known = np.isfinite(bounds)
    if not known.any():
        return -np.inf
    if found.exact is not None:
        return float((found.exact.mean - bounds)[known].max())
    alpha = ALPHA / len(found.unbiased)
    return max(proved_shortfall(one.logs[known], bounds[known], alpha) for one in found.unbiased)


def without_likelihood(found: Comparison, check: str, where: str) -> Finding | None:
    """That the filter gives zero where another one proves that the likelihood is not, if so."""
    lost = np.isneginf(found.checked.mean) & np.isfinite(found.of_witnesses)
    if not lost.any():
        return None
    name = short_form(found.checked.filter)
    best = max(found.witnesses, key=lambda one: np.isfinite(one.mean).sum())
    verdict = (
        f"{name} has no likelihood {where}: it is zero at {lost.sum()} of {lost.size} points, and "
        f"not zero by {short_form(best.filter)}. {cure(found)}"
    )
    return Finding(check, -np.inf, np.nan, ALPHA, np.inf, OFF, verdict)


def low_at(found: Comparison, where: str) -> Finding:
    """Test the estimates of an unbiased filter at some points, ``where`` in words."""
    if (lost := without_likelihood(found, f"low {where}", where)) is not None:
        return lost
    checked, name = found.checked, short_form(found.checked.filter)
    proved = shortfall(found, checked.mean) - _N_ERRORS * checked.typical_error
    mean = difference(checked, found.exact or found.plain or found.witnesses[0])
    visible = _visible(found)
    if proved > TOLERATED:
        scatter = f"its estimates scatter by {nats(checked.scatter)} nats over seeds"
        but = f", although {scatter}" if checked.is_usable else f"; {scatter}"
        outcome = OFF
        verdict = f"{name} is too low {where}, by {nats(proved)} nats at least{but}. {cure(found)}"
    elif visible <= VISIBLE:
        outcome, seen = FINE, f"{nats(max(visible, 0.1))} nats would have been seen"
        verdict = f"no sign that {name} is too low {where}; {seen}"
    else:
        outcome, why = UNDECIDED, f"too much to prove less than {nats(visible)} nats"
        verdict = f"undecided whether {name} is too low {where}: {scatter_of(found)}, {why}"
    return Finding(f"low {where}", mean.mean, mean.se, ALPHA, visible, outcome, verdict)


def _visible(found: Comparison) -> float:
    if found.exact is not None:
        return _N_ERRORS * found.checked.typical_error + TOLERATED
    known = np.isfinite(found.checked.mean)
    if found.plain is None or not found.plain.is_usable or not known.any():
        return np.inf
    alpha = ALPHA / len(found.unbiased)
    seen = visible_shortfall(found.plain.logs[known], found.checked.mean[known], alpha)
    return seen + _N_ERRORS * found.checked.typical_error
