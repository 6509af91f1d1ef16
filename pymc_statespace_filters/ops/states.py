"""States along a record, whole runs of a filter, and numbers behind terms: without a derivative."""

from collections.abc import Sequence

import numpy as np

from ..compiler.lowering.compiled_system import CompiledSystem
from ..compiler.native.plan import Plan
from ..filters.protocol import DifferentiableFilter, EnsembleFilter, Filter, PredictionFilter
from ..system.model import StateSpaceModel
from .base import FilterOp
from .signatures import GOING_ON, POINTS, PREDICTIONS, RUN, STATES, TERM_HEALTH


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

    def plan(self, system: CompiledSystem) -> Plan:
        """The filter's states."""
        return self.filter.plan_of_states(system, self.moment)


class FilterRun(FilterOp):
    """Terms and health of the likelihood, and the filtered state at ``wanted`` steps.

    It goes on from a state of the filter, empty at the start, and has the state that it leaves.
    """

    signature = RUN

    def plan(self, system: CompiledSystem) -> Plan:
        """The filter's run."""
        return self.filter.plan_of_run(system)


class GoingOn(FilterOp):
    """Terms (B, J), health (B, 3) and states left (B, S) at many points, each from its own state.

    The filter resumes at many points; without columns of states it starts.
    """

    signature = GOING_ON
    filter: DifferentiableFilter

    def __init__(self, system: StateSpaceModel, filter: DifferentiableFilter) -> None:
        super().__init__(system, filter, POINTS)

    def plan(self, system: CompiledSystem) -> Plan:
        """The filter at all points, side by side if it can."""
        return self.filter.plan_of_pass(system, of_many=True)

    def n_steps(self, inputs: Sequence[np.ndarray]) -> int:
        """Steps of an evaluation at all points."""
        theta, steps, states = inputs[0], inputs[1], inputs[-1]
        first = int(states[0, 0]) if states.size else 0
        return (int(steps[-1]) - first) * len(theta) if steps.size else 0


class TermHealth(FilterOp):
    """Terms (J,) of the likelihood, the effective number (J,) behind each, and health (3,)."""

    signature = TERM_HEALTH
    filter: EnsembleFilter

    def plan(self, system: CompiledSystem) -> Plan:
        """The filter's health."""
        return self.filter.plan_of_likelihood(system)


class Predictions(FilterOp):
    """The law of every observation before it is seen: see `signatures.PREDICTIONS`."""

    signature = PREDICTIONS
    filter: PredictionFilter

    def plan(self, system: CompiledSystem) -> Plan:
        """The filter's predictions."""
        return self.filter.plan_of_predictions(system)
