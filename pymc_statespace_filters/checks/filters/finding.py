"""What a check finds: a row of its table, and the difference of two filters behind it."""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, stdtrit

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


class Difference(NamedTuple):
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

    @property
    def most_spread(self) -> float:
        """The upper end, with the noise: no parameter is moved by more standard deviations."""
        dof = max(self.n - 1, 1)
        return float(self.se * np.sqrt(self.n * dof / chdtri(dof, 1.0 - ALPHA)))


def difference(checked: Estimates, reference: Estimates) -> Difference:
    """At the points where both are known."""
    values = checked.mean - reference.mean
    known = np.isfinite(values)
    noise = float(np.mean((checked.error**2 + reference.error**2)[known])) if known.any() else 0.0
    n = int(known.sum())
    if n < 2:
        return Difference(n, np.nan, np.inf, np.nan)
    variance = float(values[known].var(ddof=1))
    spread = np.sqrt(max(variance - noise, 0.0))
    return Difference(n, float(values[known].mean()), np.sqrt(max(variance, noise) / n), spread)


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
            scatter = f"scatter by {nats(guided.scatter)} nats here"
            rest = f" and {scatter}"
            if plain is not None:
                rest = f", {scatter} and agree with those of plain particles"
            return f"Use {short_form(guided.filter)}: its estimates are unbiased{rest}."
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
