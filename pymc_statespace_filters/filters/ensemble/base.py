"""The base class of filters that move members by noise: the functions that they compile.

Settings are checked once, when a filter is constructed.
"""

from collections.abc import Iterable
from numbers import Real
from typing import Any, ClassVar

import numpy as np

from ...compiler.native.plan import Plan
from ...compiler.numerics.normals import BLOCK, padded
from ...errors import ModelError
from ...system.checks import is_integer
from ..protocol import System, check_sensor_has_noise
from ..state_law import Layout, exact_states
from . import ancestral_smoother, backward_simulation
from .ancestral_smoother import CARRY_PAST, LAG
from .backward_simulation import STORE
from .noise import STORE_NORMALS, NoiseSizes, n_stored
from .parts import PartsFilter

MOST_MEMBERS = 10**8


def check_count(name: str, value: object) -> int:
    """Return ``value`` as an int of at least 2, of which the memory may hold the states."""
    if not is_integer(value) or not 2 <= value <= MOST_MEMBERS:
        raise ModelError(f"{name} must be an integer from 2 to {MOST_MEMBERS:.0e}, got {value!r}.")
    return int(value)


def check_fraction(name: str, value: object) -> float:
    """Return ``value`` as a float between 0 and 1."""
    is_real = isinstance(value, Real) and not isinstance(value, bool | np.bool_)
    if not is_real or not 0.0 <= float(value) <= 1.0:  # type: ignore[arg-type]
        raise ModelError(f"{name} must be a number from 0 to 1, got {value!r}.")
    return float(value)  # type: ignore[arg-type]


def check_choice(name: str, value: object, allowed: Iterable[str]) -> None:
    """Raise unless ``value`` is one of the allowed words."""
    words = list(allowed)
    if not isinstance(value, str) or value not in words:
        listed = ", ".join(repr(word) for word in words)
        raise ModelError(f"{name} must be one of {listed}, got {value!r}.")


class EnsembleFilterBase(PartsFilter):
    """A filter whose likelihood is an estimate made with noise; an `EnsembleFilter`.

    Its members are states. A subclass gives their number, `size`; see `PartsFilter` for the rest.
    """

    noisy: ClassVar[bool] = True

    def size(self) -> int:
        """Return the number of members."""
        raise NotImplementedError

    def layout(self, system: System) -> Layout:
        """Return what the columns of the members hold."""
        return exact_states(system.n)

    def smoother(self, system: System) -> Plan:
        """Plan backward simulation, or where a step has no density the ancestral smoother."""
        if system.has_transition_density:
            return self.observed(system, backward_simulation.SMOOTH, ("propagate",), observer=STORE)
        updates = int(self.simulates)
        return self.observed(
            system, ancestral_smoother.SMOOTH, observer=CARRY_PAST, updates=updates, lag=LAG
        )

    def smoothing_method(self, system: System) -> str:
        """Name the method, and the lag if it has one."""
        if system.has_transition_density:
            return "backward simulation"
        return f"ancestries, settled {LAG} observations later"

    def resampling_normals(self) -> int:
        """Return how many normals a resampling takes."""
        return 0

    def smooth(self, system: System) -> "EnsembleFilterBase":
        """Return this filter with an estimate that changes little when its normals do."""
        return self

    def check(self, system: System) -> None:
        """Raise if the filter cannot treat the system, here as a sensor has no noise."""
        check_sensor_has_noise(type(self).__name__, system)

    def is_exact_for(self, system: System) -> bool:
        """Whether the expected likelihood is that of the system, for any number of members."""
        return self.unbiased and system.has_exact_observation_density

    def max_ranks(self) -> int:
        """Return how many ranks can have a whole block of 64 members each.

        A rank with only part of a block might compute it by other instructions, as there are too
        few members for the vector code of the others, and differ in the last bit.
        """
        return max(1, self.size() // BLOCK)

    # Noise

    def noise_sizes(self, system: System) -> NoiseSizes:
        """Return how many normals the filter takes where."""
        simulated = system.r if self.simulates else 0
        resampling = self.resampling_normals()
        return NoiseSizes(padded(self.size()), system.n_start, system.m, simulated, resampling)

    def n_normals(self, system: System, n_steps: Any, n_observations: Any) -> Any:
        """Return how many normals an evaluation stores: a number, or an expression of symbols."""
        sizes = self.algorithm(system).noise_sizes(system)
        return n_stored.py_func(sizes, n_steps, n_observations)

    def plan_of_noise(self, system: System) -> Plan:
        """Plan the function (steps, seed) -> the normals that an evaluation with it uses."""
        return self.algorithm(system).plan(system, STORE_NORMALS, ())
