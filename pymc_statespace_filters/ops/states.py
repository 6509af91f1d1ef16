"""States along a record, whole runs of a filter, and numbers behind terms: without a derivative."""

from collections.abc import Sequence

import numpy as np

from ..compiler.lowering.compiled_system import CompiledSystem
from ..compiler.native.plan import Plan
from ..compiler.native.planned_function import PlannedFunction
from ..filters.protocol import BatchFilter, EnsembleFilter, Filter, PredictionFilter
from ..filters.signatures import GOING_ON, POINTS, PREDICTIONS, RUN, STATES, TERM_HEALTH
from ..system.model import StateSpaceModel
from .base import FilterOp


class States(FilterOp):
    """Mean, sd and a draw of the state at steps ``wanted``, n_effective, and health.

    ``moment`` is "predicted" (given the observations at earlier steps than the row's), "filtered"
    (also at the row's), "smoothed" (all), or "most probable" (the path that is, given all).
    """

    __props__ = ("system", "filter", "moment")
    signature = STATES

    def __init__(self, system: StateSpaceModel, filter: Filter, moment: str) -> None:
        super().__init__(system, filter)
        self.moment = moment

    def compile(self, system: CompiledSystem) -> PlannedFunction | Plan:
        """The filter's states."""
        return self.filter.compile_states(system, self.moment)


class FilterRun(FilterOp):
    """Terms and health of the likelihood, and the filtered state at ``wanted`` steps.

    It goes on from a state of the filter, empty at the start, and has the state that it leaves.
    """

    signature = RUN

    def compile(self, system: CompiledSystem) -> PlannedFunction | Plan:
        """The filter's run."""
        return self.filter.compile_run(system)


class GoingOn(FilterOp):
    """Terms (B, J), health (B, 3) and states left (B, S) at many points, each from its own state.

    The filter resumes at many points; without columns of states it starts.
    """

    signature = GOING_ON
    filter: BatchFilter

    def __init__(self, system: StateSpaceModel, filter: BatchFilter) -> None:
        super().__init__(system, filter, POINTS)

    def compile(self, system: CompiledSystem) -> PlannedFunction | Plan:
        """The filter at all points, side by side if it can."""
        return self.filter.plan_of_many(system)

    def n_steps(self, inputs: Sequence[np.ndarray]) -> int:
        """Steps of an evaluation at all points."""
        theta, steps, states = inputs[0], inputs[1], inputs[-1]
        first = int(states[0, 0]) if states.size else 0
        return (int(steps[-1]) - first) * len(theta) if steps.size else 0


class TermHealth(FilterOp):
    """Terms (J,) of the likelihood, the effective number (J,) behind each, and health (3,)."""

    signature = TERM_HEALTH
    filter: EnsembleFilter

    def compile(self, system: CompiledSystem) -> PlannedFunction | Plan:
        """The filter's health."""
        return self.filter.compile_health(system)


class Predictions(FilterOp):
    """The law of every observation before it is seen: see `signatures.PREDICTIONS`."""

    signature = PREDICTIONS
    filter: PredictionFilter

    def compile(self, system: CompiledSystem) -> PlannedFunction | Plan:
        """The filter's predictions."""
        return self.filter.compile_predictions(system)
