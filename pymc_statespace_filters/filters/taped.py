"""Filters with a gradient: a forward pass that leaves a tape, and a backward pass along it."""

from typing import ClassVar

from ..compiler.native.plan import Plan
from .protocol import System


class TapedFilter:
    """Plans the likelihood as the forward pass alone."""

    noisy: ClassVar[bool] = False
    has_gradient: ClassVar[bool] = True

    def plan_of_pass(
        self,
        system: System,
        *,
        of_many: bool = False,
        leaves_tape: bool = False,
        goes_back: bool = False,
    ) -> Plan:
        """Plan a pass along a record; one that leaves a tape and goes back is the gradient."""
        raise NotImplementedError

    def plan_of_likelihood(self, system: System) -> Plan:
        """Plan the log-likelihood."""
        return self.plan_of_pass(system)
