"""What a check finds: a row of its table."""

import math
from typing import NamedTuple

import numpy as np

from ...filters.bootstrap import BootstrapPF
from ...filters.guided_pf import GuidedPF
from ...filters.protocol import Filter
from ...filters.rbpf import RBPF
from ...filters.written import short_form
from ...pymc_model.inspection import resized
from .estimates import Comparison, Estimates

# The probability at most with which a filter that is right is found to be off.
ALPHA = 0.01
# Nats: a filter is off if it is proved to be so by more than the first; it passes if it would have
# been found to be off by the second.
TOLERATED, VISIBLE = 1.0, 3.0

EXACT, FINE, OFF, UNDECIDED = "exact", "no sign", "off", "undecided"

# The variance of an estimated log-likelihood with which a chain works well.
_GOOD_VARIANCE = 1.8
# Plain particles for a guided one, which takes about five times as long, up to which they are
# preferred: nothing leads them astray.
_AS_CHEAP = 10


class Finding(NamedTuple):
    """One check: its name, what was estimated, and what that means."""

    check: str
    statistic: float
    se: float
    alpha: float
    visible: float  # a difference that would have been seen
    outcome: str
    verdict: str


def nats(value: float) -> str:
    """A number of nats, with a digit below ten."""
    return f"{value:.1f}" if abs(value) < 10.0 else f"{value:.0f}"


def scatter_of(found: Comparison) -> str:
    """How much the noisy filters scatter, as a reason."""
    return " and ".join(
        f"{short_form(one.filter)} scatters by {nats(one.scatter)} nats"
        for one in (found.checked, *found.witnesses)
        if one.filter.noisy
    )


def cure(found: Comparison) -> str:
    """Name a filter that works at these points; a sentence."""
    plain = found.plain if found.plain is not None and found.plain.is_usable else None
    if found.exact is not None and plain is None:
        return f"Use {short_form(found.exact.filter)}, which computes this likelihood."
    is_enough, guided = None if plain is None else _enough(plain), found.guided
    is_of_other_kind = guided is not None and not isinstance(found.checked.filter, GuidedPF)
    if guided is not None and is_of_other_kind and guided.is_usable:
        agrees = plain is None or abs(np.median(guided.mean - plain.mean)) <= TOLERATED
        if agrees and (is_enough is None or _size(is_enough) > _AS_CHEAP * _size(guided.filter)):
            others = "" if plain is None else " and agree with those of plain particles"
            return (
                f"Use {short_form(guided.filter)}: its estimates are unbiased, scatter by "
                f"{nats(guided.scatter)} nats here{others}."
            )
    if is_enough is not None:
        return f"Use {short_form(is_enough)}, whose estimates are unbiased."
    return (
        "No filter is known to work here: BootstrapPF and GuidedPF are unbiased with any number of "
        "particles, but these were too few."
    )


def _size(filter: Filter) -> int:
    assert isinstance(filter, BootstrapPF | RBPF | GuidedPF)
    return filter.n_particles


def _enough(plain: Estimates) -> Filter:
    """Plain particles in a number that suits a chain."""
    number = max(_size(plain.filter) * plain.scatter**2 / _GOOD_VARIANCE, 100.0)
    digit = 10 ** math.floor(math.log10(number))
    return resized(plain.filter, digit * math.ceil(number / digit))
