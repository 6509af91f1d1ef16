"""Filters with a gradient: a forward pass that leaves a tape, and a backward pass along it."""

from typing import ClassVar

from ..compiler.native.plan import Plan
from ..compiler.native.planned_function import PlannedFunction
from .protocol import System
from .signatures import GRADIENT, LIKELIHOOD, PULLBACK, TAPED


class TapedFilter:
    """Compiles the likelihood and its gradient from the plans of both passes."""

    noisy: ClassVar[bool] = False
    has_gradient: ClassVar[bool] = True

    def plan_of_pass(
        self, system: System, *, leaves_tape: bool = False, goes_back: bool = False
    ) -> Plan:
        """Plan a pass along a record; one that leaves a tape and goes back is the gradient."""
        raise NotImplementedError

    def compile(self, system: System) -> PlannedFunction:
        """Compile the log-likelihood."""
        return PlannedFunction(self.plan_of_pass(system), *LIKELIHOOD)

    def compile_taped(self, system: System) -> PlannedFunction:
        """Compile the forward pass, with a third result: the tape."""
        return PlannedFunction(self.plan_of_pass(system, leaves_tape=True), *TAPED)

    def compile_pullback(self, system: System) -> PlannedFunction:
        """Compile the backward pass along the tape."""
        return PlannedFunction(self.plan_of_pass(system, goes_back=True), *PULLBACK)

    def compile_gradient(self, system: System) -> PlannedFunction:
        """Compile both passes as one function."""
        plan = self.plan_of_pass(system, leaves_tape=True, goes_back=True)
        return PlannedFunction(plan, *GRADIENT)

    def plan_of_many(
        self, system: System, *, leaves_tape: bool = False, goes_back: bool = False
    ) -> Plan:
        """Plan a pass along many records, or of many points."""
        return self.plan_of_pass(system, leaves_tape=leaves_tape, goes_back=goes_back)
