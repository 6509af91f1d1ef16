"""Filters with a gradient: a forward pass that leaves a tape, and a backward pass along it."""

from typing import ClassVar

from ..compiler.native.plan import Plan
from .protocol import DifferentiableFilter, System


class TapedFilter:
    """Plans the likelihood as the forward pass alone."""

    noisy: ClassVar[bool] = False
    has_gradient: ClassVar[bool] = True

    def plan_of_likelihood(self: DifferentiableFilter, system: System) -> Plan:
        """Plan the log-likelihood."""
        return self.plan_of_pass(system)
