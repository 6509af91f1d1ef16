"""What particle filters share: when and how they resample."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.plan import Plan
from ..protocol import System
from .base import EnsembleFilterBase, check_choice, check_count, check_fraction
from .hilbert_sort import ORDER_PARTICLES
from .resampling import SCHEMES, check_sortable, n_normals, smooth_resampling


@dataclass(frozen=True)
class ParticleFilter(EnsembleFilterBase):
    """A filter of weighted particles that are resampled when few of them carry the weight.

    ``counts_copies`` says that copies of a particle count as one where no noise tells them apart.
    """

    n_particles: int
    counts_copies: ClassVar[bool] = False
    _: KW_ONLY
    resample_below: float = 1 / 3
    resampling: str = "systematic"

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_particles", check_count("n_particles", self.n_particles))
        fraction = check_fraction("resample_below", self.resample_below)
        object.__setattr__(self, "resample_below", fraction)
        check_choice("resampling", self.resampling, SCHEMES)

    def size(self) -> int:
        """Return the number of particles."""
        return self.n_particles

    def when_to_resample(self) -> tuple[float, int]:
        """Return below which fraction to resample, and the number of the scheme."""
        return self.resample_below, SCHEMES.index(self.resampling)

    def check(self, system: System) -> None:
        """Raise if the scheme has to sort particles and cannot sort those of so many states."""
        super().check(system)
        check_sortable(self.resampling, system.n)

    def plan(
        self, system: System, run: EntryPoint, functions: Sequence[str], **others: int | EntryPoint
    ) -> Plan:
        """Return the plan of a function; it follows origins if copies stay equal for good."""
        others |= {"follows_origins": int(self.counts_copies and bool(system.undriven_states))}
        if self.resampling == "sorted":
            others["order"] = ORDER_PARTICLES
        return super().plan(system, run, functions, **others)

    def smooth(self, system: System) -> "ParticleFilter":
        """Return this filter with an estimate that changes little when its normals do."""
        return smooth_resampling(self, system.n)

    def resampling_normals(self) -> int:
        """Return how many normals a resampling takes."""
        return n_normals(self.resampling, self.n_particles)
