"""The functions of a system as entry points of one signature, so that a filter is compiled once."""

from functools import lru_cache
from typing import Any

from llvmlite import ir

from ..codegen.function_types import VectorFunction
from ..codegen.functions import vector_functions
from ..codegen.machine_code import INT, Module, ModuleEntryPoint
from ..codegen.members import LLVM_TYPES
from ..native.entry_point import EntryPoint
from .guidance import smoothed_cov, step_back
from .guide_loops import (
    FOLLOW_ARGUMENTS,
    LOOK_BACK_ARGUMENTS,
    LOOP_ARGUMENTS,
    follow_loop,
    look_back_loop,
)


@lru_cache(maxsize=2048)
def entry_point(system: Any, name: str) -> EntryPoint:
    """A function of a compiled system by its name, not compiled yet."""
    if name == "follow":
        return _follow(system)
    if name in ("look_back", "start_back"):
        return _look_back(system.n, system.n if name == "start_back" else system.m)
    return getattr(system, name).entry


def _follow(system: Any) -> EntryPoint:
    """The loop of a guide that linearises the steps of a system."""
    module = Module()
    main = module.function("main", [LLVM_TYPES[kind] for kind in FOLLOW_ARGUMENTS.values()])
    builder = ir.IRBuilder(main.append_basic_block())
    linearize = builder.ptrtoint(module.entry(system.linearized_step.entry), INT)
    module.call(builder, _follow_loop(system.n, system.m), [*main.args, linearize])
    builder.ret_void()
    return ModuleEntryPoint(module.finished(), FOLLOW_ARGUMENTS, "follow")


@lru_cache
def _follow_loop(n: int, m: int) -> EntryPoint:
    function = VectorFunction("step, gains, cov", smoothed_cov(n, m))
    smooth = vector_functions({"smoothed_cov": function})["smoothed_cov"]
    loop = follow_loop(smooth.function, n, m)
    return EntryPoint(loop, LOOP_ARGUMENTS, "follow", (repr((n, m)), smooth.key))


@lru_cache
def _look_back(n: int, m: int) -> EntryPoint:
    """The loop of a guide that goes back; none of its arithmetic is the system's."""
    function = VectorFunction("step, path, psi", step_back(n, m))
    back = vector_functions({"step_back": function})["step_back"]
    loop = look_back_loop(back.function, n, m)
    return EntryPoint(loop, LOOK_BACK_ARGUMENTS, "look_back", (repr((n, m)), back.key))
