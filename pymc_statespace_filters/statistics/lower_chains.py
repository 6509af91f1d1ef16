"""Chains whose log-density stayed far below that of another one."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# Nats, plus one for each parameter, by which the median log-density of a chain may lie below that
# of another: the log-density of a Gaussian posterior has a standard deviation of (d / 2)^(1 / 2).
TOLERATED = 10.0


class LowerChain(NamedTuple):
    """A chain, the highest chain, and the difference of their median log-densities in nats."""

    chain: int
    highest: int
    nats: float

    def __str__(self) -> str:
        return (
            f"chain {self.chain} stayed {self.nats:.0f} nats below chain {self.highest} (median "
            "log-density)"
        )


def nats_below(
    known: float, log_densities: Mapping[int, NDArray[np.float64]], n_parameters: int
) -> float | None:
    """By how many nats all chains stayed below a known level; None if they did not.

    All levels are medians of log-densities: a few points may lie high and hold no mass, as in the
    neck of a funnel.
    """
    if not log_densities or not np.isfinite(known):
        return None
    nats = known - max(float(np.median(values)) for values in log_densities.values())
    return nats if nats > TOLERATED + n_parameters else None


def lower_chains(
    log_densities: Mapping[int, NDArray[np.float64]], n_parameters: int
) -> list[LowerChain]:
    """Find the chains that stayed far below the highest one, from their log-densities (draws,)."""
    levels = {chain: float(np.median(values)) for chain, values in log_densities.items()}
    if not levels:
        return []
    highest = max(levels, key=lambda chain: levels[chain])
    below = {chain: levels[highest] - level for chain, level in levels.items()}
    tolerated = TOLERATED + n_parameters
    return [LowerChain(chain, highest, nats) for chain, nats in below.items() if nats > tolerated]
