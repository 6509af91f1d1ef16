"""The functions of a system as entry points of one signature, so that a filter is compiled once."""

from functools import lru_cache
from typing import Any

from pymc_statespace_filters.compiler.codegen.function_types import MEMBER_ARGUMENTS
from pymc_statespace_filters.compiler.lowering.guide_loops import (
    FOLLOW_ARGUMENTS,
    LOOK_BACK_ARGUMENTS,
    follow_loop,
    look_back_loop,
)
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint, arguments_class

MemberArguments = arguments_class("MemberArguments", MEMBER_ARGUMENTS, __name__)

@lru_cache(maxsize=2048)
def entry_point(system: Any, name: str) -> EntryPoint:
    """A function of a compiled system by its name, not compiled yet."""
    if name in ("follow", "look_back", "start_back"):
        return _of_guide(system, name)
    return getattr(system, name).entry


def _of_guide(system: Any, name: str) -> EntryPoint:
    """A loop of a guide."""
    n, m = system.n, system.n if name == "start_back" else system.m
    if name == "follow":
        step, smooth = system.linearized_step, system.smoothed_cov
        sizes = (n, m, system.n_inputs, system.n_constants)
        step.entry.compile()
        loop = follow_loop(step.entry.external, smooth.function, *sizes)
        keys = step.key, smooth.key
        return EntryPoint(loop, FOLLOW_ARGUMENTS, name, (repr(sizes), *keys), (step.entry,))
    back = getattr(system, "start_back" if name == "start_back" else "step_back")
    loop = look_back_loop(back.function, n, m)
    return EntryPoint(loop, LOOK_BACK_ARGUMENTS, name, (repr((n, m)), back.key))
