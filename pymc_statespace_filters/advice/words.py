"""From a fact to its sentences, by its kind, and to the user."""

import warnings
from collections.abc import Sequence
from functools import singledispatch

from pymc.stats.convergence import SamplerWarning, WarningType, log_warnings

from ..errors import INSIDE, FilterWarning
from ..facts import Fact


@singledispatch
def sentences(fact: Fact) -> list[str]:
    """The sentences about a fact, one for each cause; none if it does no harm."""
    raise TypeError(f"there are no words for {type(fact).__name__}")


def tell(fact: Fact, begin: str = "") -> list[str]:
    """Warn of a fact, in sentences with this beginning; those that were said."""
    # Without a frame of functools, at which Python would place the warning.
    return told.dispatch(type(fact))(fact, begin)


@singledispatch
def told(fact: Fact, begin: str) -> list[str]:
    """How a fact is told; by default in its sentences, each with this beginning."""
    said = [begin + text for text in sentences(fact)]
    if fact.of_chains:
        log(said)
    else:
        warn_of_filters(said)
    return said


def log(texts: Sequence[str], level: str = "warn") -> None:
    """Pass texts to PyMC's logger of chains."""
    log_warnings([SamplerWarning(WarningType.CONVERGENCE, text, level) for text in texts])


def warn_of_filters(texts: Sequence[str]) -> None:
    """Warn at the user's call."""
    for text in texts:
        warnings.warn(text, FilterWarning, skip_file_prefixes=INSIDE)
