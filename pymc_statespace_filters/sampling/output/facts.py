"""What a run of chains finds out about itself; `advice` has the words."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pymc.model import Model
from xarray import DataTree

from ...facts import Fact
from ...statistics.lower_chains import LowerChain
from ..run.request import ExecutionOptions, SamplingRequest
from ..run.stopping import Length
from ..starts.modes import Points
from ..target.record_target import RecordTarget
from ..target.sampled_model import Growth
from ..target.target import Target
from ..target.variables import RaveledVariables
from .convergence import Convergence
from .likelihood_variance import SeedSpread
from .phase_statistics import PhaseStatistics

TOLERATED = 0.001  # share of the draws of NUTS that may diverge without a word


def of_model(name: str) -> str:
    """The beginning of a message about one of several models, which have names."""
    return f"Model {name!r}: " if name else ""


@dataclass(frozen=True)
class ChainFact(Fact):
    """One about chains or where they start."""

    of_chains = True


@dataclass(frozen=True)
class SeparateModes(ChainFact):
    """Points that the search for starts has found, perhaps in several modes.

    Before a run, whose end names parameters without a sign, or alone.
    """

    model: Model
    raveled: RaveledVariables
    points: Points
    before_run: bool = False


@dataclass(frozen=True)
class NoisyStarts(ChainFact):
    """Points that the search for starts has found, where the likelihood may be too noisy."""

    model: Model
    target: Target
    found: Points
    rng: np.random.Generator


@dataclass(frozen=True)
class NoisyStart(ChainFact):
    """The spread of the estimates at the start of a chain."""

    model: Model
    chain: int
    spread: SeedSpread


@dataclass(frozen=True)
class WithoutDraws(ChainFact):
    """A model that the results of a run lack, which was interrupted or has ended in an error."""

    name: str
    error: Exception | None = None


@dataclass(frozen=True)
class EndedChain(ChainFact):
    """A chain of DRAM after its warm-up; ``growth`` is that of its adapted proposals."""

    target: Target | RecordTarget
    statistics: PhaseStatistics
    growth: Growth | None = None


@dataclass(frozen=True)
class EndedRun(ChainFact):
    """The chains of a model at their end, with their draws.

    ``positions`` (n, k) are draws of the unconstrained space, some of them if they are many;
    ``rngs`` are for the search of missed parts and the check of filters.
    """

    goes_on = False  # whether `sample(continue_from=)` takes the draws
    model: Model
    target: Target | RecordTarget
    request: SamplingRequest
    tree: DataTree
    names: Sequence[str]  # of the elements of a position
    length: Length  # draws that chains were to have after the warm-up
    seconds: float  # that sampling took
    convergence: Convergence | None  # if it was asked for and there are enough draws
    positions: np.ndarray
    rngs: tuple[np.random.Generator, np.random.Generator]
    is_complete: bool  # all chains have made as many iterations as they were to
    options: ExecutionOptions  # which checks were asked for, and the level of the report


@dataclass(frozen=True)
class EndedDram(EndedRun):
    """Chains of DRAM."""

    goes_on = True
    lengths: Sequence[int]  # draws of each chain, with those of the warm-up
    chains: Mapping[int, EndedChain]  # those that have draws after the warm-up, by their number
    lower: Sequence[LowerChain]  # chains that stayed far below the highest one
    below: float | None  # nats by which all stayed below the points of the search for starts
    spread: tuple[int, SeedSpread] | None  # of the estimates at the highest draw, and whose it is


@dataclass(frozen=True)
class EndedNuts(EndedRun):
    """Chains of NUTS."""

    diverging: np.ndarray  # (chains, draws), as the next two
    energy: np.ndarray
    n_steps: np.ndarray
    is_stuck: bool  # they diverged, and ended as more iterations had not helped
    is_beaten: bool  # they ended as another sampler takes less
    n_gradients: int  # with those of the warm-up

    @property
    def diverges(self) -> bool:
        """Whether more draws have diverged than can be left unsaid."""
        return bool(self.diverging.sum() > TOLERATED * self.diverging.size)


@dataclass(frozen=True)
class Raced(ChainFact):
    """The runs of a race of samplers, in their order, and which one gave the draws.

    ``goal`` is the number of effective draws that they were to have.
    """

    runs: tuple[EndedRun, ...]
    best: EndedRun
    goal: float
