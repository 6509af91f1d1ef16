"""The functions of a system as entry points of one signature, so that a filter is compiled once."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

from numba import carray, types

from pymc_statespace_filters.compiler.lowering.guidance import n_gains
from pymc_statespace_filters.compiler.lowering.guide_loops import (
    FOLLOW_ARGUMENTS,
    LOOK_BACK_ARGUMENTS,
    follow_loop,
    look_back_loop,
)
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, EntryPoint, arguments_class

MEMBER_ARGUMENTS = {
    "c": F64_PTR, "inputs": F64_PTR, "k": types.intp, "t": types.float64, "z": F64_PTR,
    "width": types.intp, "X": F64_PTR, "out": F64_PTR, "n_members": types.intp,
}  # fmt: skip
"""Arguments of a function of all members. ``z`` holds normals in rows of ``width``, or one
observation."""

MemberArguments = arguments_class("MemberArguments", MEMBER_ARGUMENTS, __name__)

PREPARE_ARGUMENTS = {"theta": F64_PTR, "n_theta": types.intp, "c": F64_PTR}


@lru_cache(maxsize=2048)
def entry_point(system: Any, name: str) -> EntryPoint:
    """A function of a compiled system by its name, not compiled yet."""
    if name in ("follow", "look_back", "start_back"):
        return _of_guide(system, name)
    sizes = (
        system.n, system.n_start, system.m, system.p, system.r, system.n_inputs, system.n_constants
    )  # fmt: skip
    function = getattr(system, name)
    arguments = PREPARE_ARGUMENTS if name == "prepare" else MEMBER_ARGUMENTS
    parts = (repr(sizes), function.key)
    return EntryPoint(_with_addresses(function.function, name, *sizes), arguments, name, parts)


def _with_addresses(
    function: Any,
    name: str,
    n: int,
    n_start: int,
    m: int,
    p: int,
    r: int,
    n_inputs: int,
    n_constants: int,
) -> Callable:
    """The function with addresses in place of arrays, whose shapes it knows."""

    def prepare(theta, n_theta, c):
        values, out = function(carray(theta, (n_theta,))), carray(c, (n_constants,))
        for i in range(n_constants):
            out[i] = values[i]

    def initialise(c, inputs, k, t, z, width, X, out, n_members):
        members, Z = carray(X, (n, n_members)), carray(z, (n_start, width))
        function(carray(c, (n_constants,)), Z, members)

    def propagate(c, inputs, k, t, z, width, X, out, n_members):
        members, Z = carray(X, (n, n_members)), carray(z, (m, width))
        function(carray(c, (n_constants,)), carray(inputs, (k + 1, n_inputs)), k, t, Z, members)

    def observe(c, inputs, k, t, z, width, X, out, n_members):
        members, Z = carray(X, (n, n_members)), carray(z, (r, width))
        rows, D = carray(inputs, (k + 1, n_inputs)), carray(out, (p, n_members))
        function(carray(c, (n_constants,)), rows, k, t, Z, members, D)

    def log_density(c, inputs, k, t, z, width, X, out, n_members):
        members, d, log_p = carray(X, (n, n_members)), carray(z, (p,)), carray(out, (n_members,))
        rows = carray(inputs, (k + 1, n_inputs))
        function(carray(c, (n_constants,)), rows, k, t, d, members, log_p)

    def step_moments(c, inputs, k, t, z, width, X, out, n_members):
        points, M = carray(X, (n, n_members)), carray(out, (2, n_members))
        function(carray(c, (n_constants,)), carray(inputs, (k + 1, n_inputs)), k, t, points, M)

    size, n_information = n_gains(n, m), 1 + n + n * n

    def propagate_guided(c, inputs, k, t, z, width, X, out, n_members):
        members, Z = carray(X, (n + 1, n_members)), carray(z, (m, width))
        gains, rows = carray(out, (size,)), carray(inputs, (k + 1, n_inputs))
        function(carray(c, (n_constants,)), rows, k, t, gains, Z, members)

    def observation_information(c, inputs, k, t, z, width, X, out, n_members):
        member, d, rows = carray(X, (n, 1)), carray(z, (p,)), carray(inputs, (k + 1, n_inputs))
        values = function(carray(c, (n_constants,)), rows, k, t, d, member, 0)
        results = carray(out, (n_information,))
        for i in range(n_information):
            results[i] = values[i]

    calls = (
        prepare, initialise, propagate, observe, log_density, step_moments, propagate_guided,
        observation_information,
    )  # fmt: skip
    return {call.__name__: call for call in calls}[name]


def _of_guide(system: Any, name: str) -> EntryPoint:
    """A loop of a guide."""
    n, m = system.n, system.n if name == "start_back" else system.m
    if name == "follow":
        step, smooth = system.linearized_step, system.smoothed_cov
        sizes = (n, m, system.n_inputs, system.n_constants)
        loop = follow_loop(step.function, smooth.function, *sizes)
        keys = step.key, smooth.key
        return EntryPoint(loop, FOLLOW_ARGUMENTS, name, (repr(sizes), *keys))
    back = getattr(system, "start_back" if name == "start_back" else "step_back")
    loop = look_back_loop(back.function, n, m)
    return EntryPoint(loop, LOOK_BACK_ARGUMENTS, name, (repr((n, m)), back.key))
