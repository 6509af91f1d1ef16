"""The base class of filters that move members by noise: the functions that they compile.

Settings are checked once, when a filter is constructed.
"""

from collections.abc import Iterable, Sequence
from numbers import Real
from typing import Any, ClassVar

import numpy as np

from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.plan import Plan
from ...compiler.native.planned_function import PlannedFunction
from ...compiler.numerics.normals import BLOCK, padded
from ...errors import ModelError
from ...system.checks import is_integer
from ..plan import make_plan
from ..protocol import System, check_sensor_has_noise
from ..signatures import LIKELIHOOD_OF_NOISE, NORMALS, RUN, STATES, TERM_HEALTH
from ..state_law import Layout, StateLaw, exact_states, law_of_parts
from .noise import STORE_NORMALS, NoiseSizes, n_stored
from .summaries import LAST_EVENTS, STATES_OF_PARTS, SUMMARISE

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


class EnsembleFilterBase:
    """A filter whose likelihood is an estimate made with noise; an `EnsembleFilter`.

    A subclass is a frozen dataclass of settings. It gives its ``entry`` (see `loop.member_filter`),
    `size` and `settings`, which the entry reads, and how it smooths.

    Attributes
    ----------
    unbiased : bool
        Whether the mean of the estimates is the likelihood, for any number of members.
    simulates : bool
        Whether an update simulates an observation of every member.
    """

    noisy: ClassVar[bool] = True
    unbiased: ClassVar[bool] = False
    has_gradient: ClassVar[bool] = False
    simulates: ClassVar[bool] = False
    entry: ClassVar[EntryPoint]

    def size(self) -> int:
        """Return the number of members."""
        raise NotImplementedError

    def settings(self, system: System) -> tuple[float, ...]:
        """Return the filter's own settings that the entry reads, choices by their number."""
        return ()

    def when_to_resample(self) -> tuple[float, int]:
        """Return below which fraction of the members to resample, and the number of the scheme."""
        return -1.0, 0

    def smoother(self, system: System) -> Plan:
        """Return the plan of the smoother of this filter for one system."""
        raise NotImplementedError

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        raise NotImplementedError

    def resampling_normals(self) -> int:
        """Return how many normals a resampling takes."""
        return 0

    def ordering(self) -> EntryPoint | None:
        """Return the function that sorts members, if the filter sorts them."""
        return None

    def law_of_state(self, system: System, states: np.ndarray) -> StateLaw:
        """Return the law of the state, from what the filter leaves (m, S) at m points."""
        return law_of_parts(states, self.layout(system))

    def system_of_parts(self, system: System) -> System:
        """Return the system whose states the members are, if it is another one."""
        return system

    def layout(self, system: System) -> Layout:
        """Return what the columns of the members hold."""
        return exact_states(system.n)

    def algorithm(self, system: System) -> "EnsembleFilterBase":
        """Return the filter that treats this system: itself, unless it reduces to another."""
        return self

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

    def stored_noise(self, system: System) -> PlannedFunction:
        """Compile the function (steps, seed) -> the normals that an evaluation with it uses."""
        plan = self.algorithm(system).plan(system, STORE_NORMALS, ())
        return PlannedFunction(plan, *NORMALS)

    # Compiled functions

    def compile(self, system: System) -> PlannedFunction:
        """Compile the log-likelihood."""
        return PlannedFunction(self.algorithm(system).evaluation(system), *LIKELIHOOD_OF_NOISE)

    def compile_health(self, system: System) -> PlannedFunction:
        """Compile the effective number behind every term of `compile`."""
        return PlannedFunction(self.algorithm(system).evaluation(system), *TERM_HEALTH)

    def compile_states(self, system: System, moment: str) -> PlannedFunction:
        """Compile "predicted", "filtered" or "smoothed" states."""
        filter = self.algorithm(system)
        if moment == "smoothed":
            return PlannedFunction(filter.smoother(system), *STATES)
        return PlannedFunction(filter.summarised(system, moment), *STATES)

    def compile_run(self, system: System) -> PlannedFunction:
        """Compile one run with all that it computes."""
        return PlannedFunction(self.algorithm(system).summarised(system, "filtered"), *RUN)

    def summarised(self, system: System, moment: str) -> Plan:
        """Return the plan of a run that writes "predicted" or "filtered" states."""
        last_event = LAST_EVENTS[moment]
        return self.observed(system, STATES_OF_PARTS, observer=SUMMARISE, last_event=last_event)

    def functions(self) -> Sequence[str]:
        """Return the names of the system's functions that the entry calls."""
        simulated = ("observe",) if self.simulates else ()
        return "initialise", "propagate", "log_density", *simulated

    def evaluation(self, system: System) -> Plan:
        """Return the plan of the filter's entry point for one system."""
        return self.plan(system, self.entry, self.functions())

    def observed(
        self,
        system: System,
        run: EntryPoint,
        functions: Sequence[str] = (),
        **others: int | EntryPoint,
    ) -> Plan:
        """Return the plan of a function that runs the filter with a callback.

        ``functions`` are those of the system that it calls besides the filter's.
        """
        functions = (*self.functions(), *functions)
        return self.plan(system, run, functions, evaluate=self.entry, **others)

    def plan(
        self, system: System, run: EntryPoint, functions: Sequence[str], **others: int | EntryPoint
    ) -> Plan:
        """Return the plan of a function that reads the settings of this filter."""
        size, order = self.size(), self.ordering()
        layout = self.layout(system)
        settings = (
            size, *self.noise_sizes(system), *self.when_to_resample(), layout.rows, layout.n_exact,
            len(layout.order), *layout.order, *self.settings(system),
        )  # fmt: skip
        if order is not None:
            others = {**others, "order": order}
        state_size = 1 + (layout.rows + 1) * size  # a step, members and log weights
        return make_plan(
            self.system_of_parts(system), run, functions, settings, n_members=size,
            state_size=state_size, **others,
        )  # fmt: skip
