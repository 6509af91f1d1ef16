"""The functions of a machine as entries, all of one form, so that a filter is the same for all."""

from collections.abc import Callable
from typing import NamedTuple

from numba import carray, types

from pymc_statespace_filters.compiler.lowering.ensemble import Machine
from pymc_statespace_filters.compiler.lowering.scalar_state import OneState
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, EntryPoint

# c, inputs, k, t, what comes to all members (Z and its columns, or d), X, out, number of members
_MEMBERS = (
    F64_PTR, F64_PTR, types.intp, types.float64, F64_PTR, types.intp, F64_PTR, F64_PTR, types.intp,
)  # fmt: skip


class MachineEntries(NamedTuple):
    """One for each function of a `Machine`; ``observe`` is None where the machine has none."""

    prepare: EntryPoint
    initialise: EntryPoint
    propagate: EntryPoint
    log_density: EntryPoint
    observe: EntryPoint | None


class OneStateEntries(NamedTuple):
    """Those of a `OneState`: ``start`` writes (valid or 0, mean, variance)."""

    start: EntryPoint
    move: EntryPoint
    log_density: EntryPoint


def machine_entries(machine: Machine) -> MachineEntries:
    """Entries around the functions of a machine, not compiled yet."""
    sizes = (machine.n, machine.m, machine.p, machine.r, machine.n_inputs, machine.n_constants)
    n, m, p, r, n_inputs, n_constants = sizes
    prepare, initialise, propagate = machine.prepare, machine.initialise, machine.propagate
    observe, log_density = machine.observe, machine.log_density

    def prepare_constants(theta, n_theta, c):
        values, out = prepare(carray(theta, (n_theta,))), carray(c, (n_constants,))
        for i in range(n_constants):
            out[i] = values[i]

    def initialise_members(c, inputs, k, t, z, width, x, out, n_members):
        X, Z = carray(x, (n, n_members)), carray(z, (n, width))
        initialise(carray(c, (n_constants,)), Z, X)

    def propagate_members(c, inputs, k, t, z, width, x, out, n_members):
        X, Z = carray(x, (n, n_members)), carray(z, (m, width))
        propagate(carray(c, (n_constants,)), carray(inputs, (k + 1, n_inputs)), k, t, Z, X)

    def observe_members(c, inputs, k, t, z, width, x, out, n_members):
        X, Z, D = carray(x, (n, n_members)), carray(z, (r, width)), carray(out, (p, n_members))
        observe(carray(c, (n_constants,)), carray(inputs, (k + 1, n_inputs)), k, t, Z, X, D)

    def log_density_members(c, inputs, k, t, z, width, x, out, n_members):
        X, d, log_p = carray(x, (n, n_members)), carray(z, (p,)), carray(out, (n_members,))
        log_density(carray(c, (n_constants,)), carray(inputs, (k + 1, n_inputs)), k, t, d, X, log_p)

    key = key_of(repr(sizes), machine.key)
    return MachineEntries(
        prepare=_entry(prepare_constants, (F64_PTR, types.intp, F64_PTR), key),
        initialise=_entry(initialise_members, _MEMBERS, key),
        propagate=_entry(propagate_members, _MEMBERS, key),
        log_density=_entry(log_density_members, _MEMBERS, key),
        observe=_entry(observe_members, _MEMBERS, key) if machine.observe is not None else None,
    )


def one_state_entries(system: OneState) -> OneStateEntries:
    """Entries around the functions of a system of one state, not compiled yet."""
    p, n_inputs, n_theta = system.p, system.n_inputs, system.n_theta
    start, valid, move, log_density = system.start, system.valid, system.move, system.log_density

    def start_state(theta, n_theta, first):
        c, out = carray(theta, (n_theta,)), carray(first, (3,))
        out[0] = valid(c)
        moments = start(c)
        out[1], out[2] = moments[0], moments[1]

    def move_state(c, inputs, k, t, z, width, x, out, n_members):
        X, M = carray(x, (1, n_members)), carray(out, (2, n_members))
        move(carray(c, (n_theta,)), carray(inputs, (k + 1, n_inputs)), k, t, X, M)

    def log_density_state(c, inputs, k, t, z, width, x, out, n_members):
        X, d, log_p = carray(x, (1, n_members)), carray(z, (p,)), carray(out, (n_members,))
        log_density(carray(c, (n_theta,)), carray(inputs, (k + 1, n_inputs)), k, t, d, X, log_p)

    return OneStateEntries(
        start=_entry(start_state, (F64_PTR, types.intp, F64_PTR), system.key),
        move=_entry(move_state, _MEMBERS, system.key),
        log_density=_entry(log_density_state, _MEMBERS, system.key),
    )


def _entry(function: Callable, arguments: tuple, key: str | None) -> EntryPoint:
    name = function.__name__
    return EntryPoint(function, arguments, name, key_of(name, key))
