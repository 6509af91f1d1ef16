r"""The prior over sub-models: which are permitted, and how probable each of them is.

With ``"beta-binomial"`` every *number* of terms is as probable as any other, and all sets of equal
size are:

.. math::

    p(M) = \frac{1}{(K + 1) \binom{K}{|M|}},

a Binomial prior whose probability of inclusion is itself uniform (Scott and Berger 2010): the
penalty of many candidates comes with it. Otherwise terms are present independently of each other.
What is required of a set restricts either prior to the sets that are permitted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln

from ..errors import ModelError
from ..system.checks import is_finite
from .candidates import Candidates

BETA_BINOMIAL = "beta-binomial"
MOST_COUNTED = 12  # candidates of which all sets are listed
N_DRAWN = 200_000  # sets, where they are too many

Array = NDArray[np.float64]
Sets = NDArray[np.bool_]


@dataclass(frozen=True)
class InclusionPrior:
    """The prior of sets of K candidates.

    ``probability`` (K,) is that of independent candidates, zero and one included; None for the
    beta-binomial prior.
    """

    probability: Array | None
    needed: Sets  # (K, K), which others (columns) a candidate (row) requires

    def permits(self, present: Sets) -> NDArray[np.bool_]:
        """Whether sets (..., K) have what their members require."""
        lacking = present[..., :, None] & self.needed & ~present[..., None, :]
        return np.asarray(~lacking.any(axis=(-1, -2)))

    def log_weight(self, present: Sets) -> Array:
        """The log-probability of sets (..., K) before it is restricted to permitted ones."""
        if self.probability is not None:
            with np.errstate(divide="ignore"):
                log_p, log_not = np.log(self.probability), np.log1p(-self.probability)
            return np.asarray(np.where(present, log_p, log_not).sum(axis=-1))
        n, size = present.shape[-1], present.sum(axis=-1)
        return np.asarray(betaln(size + 1, n - size + 1))

    @property
    def is_open(self) -> NDArray[np.bool_]:
        """Which candidates may be present or absent, (K,)."""
        p = np.full(len(self.needed), 0.5) if self.probability is None else self.probability
        return np.asarray((p > 0) & (p < 1))

    @property
    def n_open(self) -> int:
        """How many these are."""
        return int(self.is_open.sum())

    def all_sets(self) -> Sets:
        """All permitted sets of positive probability, (S, K)."""
        n = self.n_open
        present = np.zeros((2**n, len(self.needed)), dtype=bool)
        present[:, self.is_open] = (np.arange(2**n)[:, None] >> np.arange(n)) & 1
        if self.probability is not None:
            present[:, self.probability == 1] = True
        if not (is_permitted := self.permits(present)).any():
            raise ModelError(
                "requires and inclusion must permit some sub-model: what must be present requires "
                "what must be absent"
            )
        return np.asarray(present[is_permitted])

    def restriction(self, rng: np.random.Generator) -> "Restriction":
        """What the restriction to permitted sets makes of the prior.

        By all sets, or by draws where these are too many.
        """
        if self.n_open <= MOST_COUNTED:
            present = self.all_sets()
            weight = np.exp(self.log_weight(present))
            return Restriction(float(weight.sum()), weight @ present / weight.sum())
        n, p = len(self.needed), self.probability
        if not self.needed.any():
            return Restriction(1.0, np.full(n, 0.5) if p is None else p)
        drawn = rng.random((N_DRAWN, n)) < (rng.random((N_DRAWN, 1)) if p is None else p)
        permitted = drawn[self.permits(drawn)]
        return Restriction(len(permitted) / N_DRAWN, permitted.mean(axis=0))


class Restriction(NamedTuple):
    """Of a prior restricted to permitted sets."""

    share: float  # of the prior, that is permitted
    inclusion: Array  # (K,), of the terms


def read_inclusion(candidates: Candidates, inclusion: Any, requires: Any) -> InclusionPrior:
    """Check the arguments ``inclusion`` and ``requires`` of `select_terms`."""
    return InclusionPrior(_probabilities(candidates, inclusion), _needed(candidates, requires))


def _probabilities(candidates: Candidates, inclusion: Any) -> Array | None:
    if isinstance(inclusion, str) and inclusion == BETA_BINOMIAL:
        return None
    if isinstance(inclusion, Mapping):
        return _probability_of_each(candidates, inclusion)
    if not is_finite(inclusion) or not 0 < inclusion < 1:
        raise ModelError(
            f"inclusion must be {BETA_BINOMIAL!r}, a probability strictly between 0 and 1, "
            f"or a dictionary from candidates to probabilities, got {inclusion!r}"
        )
    return np.full(len(candidates), float(inclusion))


def _probability_of_each(candidates: Candidates, inclusion: Mapping[Any, Any]) -> Array:
    found = np.full(len(candidates), np.nan)
    for key, value in inclusion.items():
        if not is_finite(value) or not 0 <= value <= 1:
            raise ModelError(f"inclusion must be from 0 to 1 for {key!r}, got {value!r}")
        numbers = candidates.numbers(key, "inclusion")
        if not np.isnan(found[numbers]).all():
            raise ModelError(f"inclusion must name every candidate once, got {key!r} again")
        found[numbers] = value
    if missing := [candidates.keys[i] for i in np.flatnonzero(np.isnan(found))]:
        raise ModelError(f"inclusion must have a probability for every candidate: {missing}")
    return found


def _needed(candidates: Candidates, requires: Any) -> Sets:
    needed = np.zeros((len(candidates),) * 2, dtype=bool)
    if requires is None:
        return needed
    if not isinstance(requires, Mapping):
        raise ModelError(
            "requires must be a dictionary from candidates to those without which they are not "
            f"considered, such as {{'k3': 'k1'}}, got {requires!r}"
        )
    for key, others in requires.items():
        rows = candidates.numbers(key, "requires")
        for other in _listed(others):
            needed[np.ix_(rows, candidates.numbers(other, "requires"))] = True
    if _closed(needed).diagonal().any():
        raise ModelError(
            f"requires must not lead from a candidate back to itself, got {requires!r}: what comes "
            "and goes together is one tuple in absent"
        )
    return needed


def _closed(needed: Sets) -> Sets:
    """What candidates require, and what that requires in turn."""
    closed = needed
    for _ in range(len(needed)):
        closed = closed | (closed.astype(int) @ closed.astype(int) > 0)
    return closed


def _listed(others: Any) -> Sequence[Any]:
    return others if isinstance(others, list) else [others]
