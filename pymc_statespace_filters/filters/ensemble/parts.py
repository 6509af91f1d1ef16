"""What all filters of the one loop are: a layout of weighted parts, and functions with plans."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ...compiler.native.entry_point import EntryPoint
from ...compiler.native.plan import Plan
from ...errors import ModelError
from ..plan import make_plan
from ..protocol import System
from ..state_law import Layout, StateLaw, gaussian_states, law_of_parts
from .noise import NO_NOISE, NoiseSizes
from .summaries import LAST_EVENTS, STATES_OF_PARTS, SUMMARISE


class PartsFilter:
    """A filter of weighted parts along a record: as it stands, of one Gaussian and without noise.

    A subclass is a frozen dataclass of settings. It gives three functions, its ``entry`` (see
    `loop.member_filter`), `check` and `is_exact_for`. It may give ``settings``, which the functions
    read, and parts of another ``layout`` and number. A part that is alone is no member: its
    effective number is infinite, and `run_filter` has no particles of it.

    Attributes
    ----------
    unbiased : bool
        Whether the mean of the estimates is the likelihood, for any number of members.
    simulates : bool
        Whether an update simulates observations.
    """

    noisy: ClassVar[bool] = False
    unbiased: ClassVar[bool] = False
    has_gradient: ClassVar[bool] = False
    simulates: ClassVar[bool] = False
    entry: ClassVar[EntryPoint]

    def size(self) -> int:
        """Return the number of parts."""
        return 1

    def layout(self, system: System) -> Layout:
        """Return what the columns of the parts hold."""
        return gaussian_states(system.n)

    def settings(self, system: System) -> tuple[float, ...]:
        """Return the filter's own settings that the entry reads, choices by their number."""
        return ()

    def check(self, system: System) -> None:
        """Raise if the filter cannot treat the system."""
        raise NotImplementedError

    def is_exact_for(self, system: System) -> bool:
        """Whether the likelihood, or the mean of its estimates, is that of the system."""
        raise NotImplementedError

    def smoother(self, system: System) -> Plan:
        """Return the plan of the smoother of this filter for one system."""
        raise ModelError(
            f"{type(self).__name__} does not smooth; name a filter that does, such as "
            "filter=psf.EKF()"
        )

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        return "none"

    def law_of_state(self, system: System, states: np.ndarray) -> StateLaw:
        """Return the law of the state, from what the filter leaves (m, S) at m points."""
        return law_of_parts(states, self.layout(system))

    def system_of_parts(self, system: System) -> System:
        """Return the system whose states the members are, if it is another one."""
        return system

    def algorithm(self, system: System) -> "PartsFilter":
        """Return the filter that treats this system: itself, unless it reduces to another."""
        return self

    def noise_sizes(self, system: System) -> NoiseSizes:
        """Return how many normals the filter takes where."""
        return NO_NOISE

    def when_to_resample(self) -> tuple[float, int]:
        """Return below which fraction of the members to resample, and the number of the scheme."""
        return -1.0, 0

    # Plans

    def plan_of_likelihood(self, system: System) -> Plan:
        """Plan the log-likelihood."""
        filter = self.algorithm(system)
        return filter.plan(system, filter.entry, filter.functions())

    def plan_of_states(self, system: System, moment: str) -> Plan:
        """Plan "predicted", "filtered" or "smoothed" states."""
        filter = self.algorithm(system)
        if moment == "smoothed":
            return filter.smoother(system)
        return filter.summarised(system, moment)

    def plan_of_run(self, system: System) -> Plan:
        """Plan one run with all that it computes."""
        return self.algorithm(system).summarised(system, "filtered")

    def summarised(self, system: System, moment: str) -> Plan:
        """Return the plan of a run that writes "predicted" or "filtered" states."""
        last_event = LAST_EVENTS[moment]
        return self.observed(system, STATES_OF_PARTS, observer=SUMMARISE, last_event=last_event)

    def functions(self) -> Sequence[str]:
        """Return the names of the system's functions that the entry calls."""
        simulated = ("observe",) if self.simulates else ()
        return "initialise", "propagate", "log_density", *simulated

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
        size, layout = self.size(), self.layout(system)
        settings = (
            size, *self.noise_sizes(system), *self.when_to_resample(), layout.rows, layout.n_exact,
            len(layout.order), *layout.order, *self.settings(system),
        )  # fmt: skip
        state_size = 1 + (layout.rows + 1) * size  # a step, members and log weights
        return make_plan(
            self.system_of_parts(system), run, functions, settings,
            n_members=size if size > 1 else 0, state_size=state_size, **others,
        )  # fmt: skip
