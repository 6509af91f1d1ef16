"""A compiled system inside machine code: sizes, and functions that are called by their address.

`system_table` packs a `CompiledSystem` into one vector, `read_system` unpacks it. Both use the
names of `TABLE`, so that no code refers to a slot by its number.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import carray, types

from pymc_statespace_filters.compiler.lowering.entry_points import MemberArguments, entry_point
from pymc_statespace_filters.compiler.lowering.guide_loops import (
    FollowArguments,
    LookBackArguments,
)
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.compiler.native.entry_point import (
    F64_PTR,
    I64_PTR,
    address_of,
    call_address,
)
from pymc_statespace_filters.compiler.native.jit import njit_internal
from pymc_statespace_filters.filters.protocol import System


class Slots(NamedTuple):
    """Places in the table of a system; the free states follow."""

    n: int = 0
    p: int = 1
    n_inputs: int = 2
    n_theta: int = 3
    n_constants: int = 4
    n_free: int = 5
    is_time_invariant: int = 6
    m: int = 7
    has_gaussian_observation: int = 8
    prepare: int = 9
    initialise: int = 10
    propagate: int = 11
    observe: int = 12
    log_density: int = 13
    step_moments: int = 14
    propagate_guided: int = 15
    observation_information: int = 16
    follow: int = 17
    look_back: int = 18
    start_back: int = 19


TABLE = Slots()
N_SLOTS = len(TABLE)

SYSTEM_ARGUMENTS = {
    "table": I64_PTR, "dt": types.float64, "theta": F64_PTR, "n_theta": types.intp,
    "inputs": F64_PTR, "n_rows": types.intp,
}  # fmt: skip
"""What `read_system` reads, as arguments of an entry point."""

NULL = np.int64(0)
"""An address that is not read."""


class TabledSystem(NamedTuple):
    """One evaluation's system: ``c`` its constants, ``inputs`` a row for each step.

    ``free`` are the states that an update may move. Functions are addresses, 0 for those that the
    filter does not use.
    """

    n: int
    m: int
    p: int
    n_theta: int
    dt: float
    is_time_invariant: bool
    has_gaussian_observation: bool
    free: np.ndarray
    c: np.ndarray
    inputs: np.ndarray
    initialise: int
    propagate: int
    observe: int
    log_density: int
    step_moments: int
    propagate_guided: int
    observation_information: int
    follow: int
    look_back: int
    start_back: int


class SystemTable(NamedTuple):
    """The compiled function () -> table, and the key of the system's functions in it."""

    make: Any
    key: str | None


def system_table(system: System, functions: Sequence[str]) -> SystemTable:
    """Pack a system and those of its functions that a filter uses, `prepare` always."""
    used = {name: entry_point(system, name) for name in ("prepare", *functions)}
    for entry in used.values():
        entry.compile()
    symbols = {name: entry.symbol for name, entry in used.items()}
    prepare, initialise = symbols["prepare"], symbols.get("initialise", "")
    propagate, observe = symbols.get("propagate", ""), symbols.get("observe", "")
    log_density, step_moments = symbols.get("log_density", ""), symbols.get("step_moments", "")
    propagate_guided = symbols.get("propagate_guided", "")
    information = symbols.get("observation_information", "")
    follow, look_back = symbols.get("follow", ""), symbols.get("look_back", "")
    start_back = symbols.get("start_back", "")
    constants = np.zeros(N_SLOTS + system.free.size, dtype=np.int64)
    constants[TABLE.n], constants[TABLE.m], constants[TABLE.p] = system.n, system.m, system.p
    constants[TABLE.has_gaussian_observation] = system.gaussian_observation
    constants[TABLE.n_inputs], constants[TABLE.n_theta] = system.n_inputs, system.n_theta
    constants[TABLE.n_constants], constants[TABLE.n_free] = system.n_constants, system.free.size
    constants[TABLE.is_time_invariant] = "step_moments" in used and system.is_time_invariant
    constants[N_SLOTS:] = system.free

    @njit_internal
    def make():
        table = constants.copy()
        table[TABLE.prepare] = address_of(prepare)
        table[TABLE.initialise] = address_of(initialise)
        table[TABLE.propagate] = address_of(propagate)
        table[TABLE.observe] = address_of(observe)
        table[TABLE.log_density] = address_of(log_density)
        table[TABLE.step_moments] = address_of(step_moments)
        table[TABLE.propagate_guided] = address_of(propagate_guided)
        table[TABLE.observation_information] = address_of(information)
        table[TABLE.follow] = address_of(follow)
        table[TABLE.look_back] = address_of(look_back)
        table[TABLE.start_back] = address_of(start_back)
        return table

    keys = [entry.key for entry in used.values()]
    return SystemTable(make, key_of(repr((system.dt, constants.tolist())), *keys))


@njit_internal
def read_system(table, dt, theta, n_theta, inputs, n_rows):
    """Unpack a table, and prepare the constants of one evaluation."""
    slots = carray(table, (N_SLOTS,))
    free = carray(table, (N_SLOTS + slots[TABLE.n_free],))[N_SLOTS:]
    c = np.empty(slots[TABLE.n_constants])
    call_address(slots[TABLE.prepare], (theta, n_theta, c))
    return TabledSystem(
        n=slots[TABLE.n], m=slots[TABLE.m], p=slots[TABLE.p], n_theta=slots[TABLE.n_theta], dt=dt,
        is_time_invariant=slots[TABLE.is_time_invariant] != 0,
        has_gaussian_observation=slots[TABLE.has_gaussian_observation] != 0, free=free, c=c,
        inputs=carray(inputs, (n_rows, slots[TABLE.n_inputs])),
        initialise=slots[TABLE.initialise], propagate=slots[TABLE.propagate],
        observe=slots[TABLE.observe], log_density=slots[TABLE.log_density],
        step_moments=slots[TABLE.step_moments],
        propagate_guided=slots[TABLE.propagate_guided],
        observation_information=slots[TABLE.observation_information],
        follow=slots[TABLE.follow], look_back=slots[TABLE.look_back],
        start_back=slots[TABLE.start_back],
    )  # fmt: skip


@njit_internal
def _call(address, system, k, t, z, width, X, out):
    arguments = MemberArguments(
        c=system.c, inputs=system.inputs, k=k, t=t, z=z, width=width, X=X, out=out,
        n_members=np.int64(X.shape[1]),
    )  # fmt: skip
    call_address(address, arguments)


@njit_internal
def initialise(system, z, width, X):
    """Draw every member's state at step 0 from normals at the address z."""
    _call(system.initialise, system, NULL, 0.0, z, width, X, NULL)


@njit_internal
def propagate(system, k, t, z, width, X):
    """Move every member from step k to k + 1 with its own noise (Eqs. 4.22 and 4.40)."""
    _call(system.propagate, system, k, t, z, width, X, NULL)


@njit_internal
def observe(system, k, t, z, width, X, D):
    """Simulate an observation of every member (Eq. 4.15)."""
    _call(system.observe, system, k, t, z, width, X, D)


@njit_internal
def log_density(system, k, t, d, X, log_p):
    """Write log p(d | x) of every member; components of d that are NaN are left out."""
    _call(system.log_density, system, k, t, d, NULL, X, log_p)


@njit_internal
def propagate_guided(system, k, t, z, width, X, gains):
    """Move every member by noise that these gains shift; X is followed by a row of log ratios."""
    _call(system.propagate_guided, system, k, t, z, width, X, gains)


@njit_internal
def follow(system, first, last, t0, path, gains, steps, cov):
    """Move a path by the mean noise of gains, and linearise its steps, see `guide_loops`."""
    arguments = FollowArguments(
        c=system.c, inputs=system.inputs, first=first, last=last, t0=t0, dt=system.dt, path=path,
        gains=gains, steps=steps, cov=cov,
    )  # fmt: skip
    call_address(system.follow, arguments)


@njit_internal
def look_back(address, first, last, path, steps, gains, psi, misfit):
    """Move psi back, and condition the noise on it, see `guide_loops`."""
    arguments = LookBackArguments(
        first=first, last=last, path=path, steps=steps, gains=gains, psi=psi, misfit=misfit
    )
    call_address(address, arguments)


@njit_internal
def observation_information(system, k, t, d, x, out):
    """Write log p(d | x) at a point x (n, 1), its score and its information."""
    _call(system.observation_information, system, k, t, d, NULL, x, out)


@njit_internal
def step_moments(system, k, t, X, M):
    """Write mean and variance of the next state, given each point X (1, N), to M (2, N)."""
    _call(system.step_moments, system, k, t, NULL, NULL, X, M)
