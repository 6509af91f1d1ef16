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

    Attributes
    ----------
    names : sequence of str
        Of the elements of a position.
    length : Length
        Draws that chains were to have after the warm-up.
    seconds : float
        That sampling took.
    convergence : Convergence, optional
        The diagnostics, if they were asked for and there are enough draws.
    positions : ndarray, shape (n, k)
        Draws of the unconstrained space, some of them if they are many.
    rngs : (numpy.random.Generator, numpy.random.Generator)
        For the search of missed parts and the check of filters.
    is_complete : bool
        Whether all chains have made as many iterations as they were to.
    options : ExecutionOptions
        Which checks were asked for, and the level of the report.
    goes_on : bool
        Whether `sample(continue_from=)` takes the draws.
    """

    goes_on = False
    model: Model
    target: Target | RecordTarget
    request: SamplingRequest
    tree: DataTree
    names: Sequence[str]
    length: Length
    seconds: float
    convergence: Convergence | None
    positions: np.ndarray
    rngs: tuple[np.random.Generator, np.random.Generator]
    is_complete: bool
    options: ExecutionOptions


@dataclass(frozen=True)
class EndedDram(EndedRun):
    """Chains of DRAM.

    Attributes
    ----------
    lengths : sequence of int
        Draws of each chain, with those of the warm-up.
    chains : mapping
        Those that have draws after the warm-up, by their number.
    lower : sequence of LowerChain
        Chains that stayed far below the highest one.
    below : float, optional
        By how many nats all stayed below the points that the search for starts has found.
    spread : (int, SeedSpread), optional
        That of the estimates at the highest draw, and whose it is.
    """

    goes_on = True
    lengths: Sequence[int]
    chains: Mapping[int, EndedChain]
    lower: Sequence[LowerChain]
    below: float | None
    spread: tuple[int, SeedSpread] | None


@dataclass(frozen=True)
class EndedNuts(EndedRun):
    """Chains of NUTS.

    Attributes
    ----------
    diverging, energy, n_steps : ndarray, shape (chains, draws)
    is_stuck : bool
        Whether they diverged, and ended as more iterations had not helped.
    is_beaten : bool
        Whether they ended as another sampler takes less.
    n_gradients : int
        With those of the warm-up.
    """

    diverging: np.ndarray
    energy: np.ndarray
    n_steps: np.ndarray
    is_stuck: bool
    is_beaten: bool
    n_gradients: int

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
