"""The packed table of a system, and entry points: no argument can be taken for another."""

import numpy as np
import pytest
from numba import carray, njit, types

from pymc_statespace_filters.compiler.lowering.entry_points import entry_point
from pymc_statespace_filters.compiler.native.entry_point import (
    F64_PTR,
    I64_PTR,
    EntryPoint,
    arguments_class,
)
from pymc_statespace_filters.filters.plan import (
    N_SLOTS,
    SYSTEM_ARGUMENTS,
    TABLE,
    read_system,
    system_table,
)
from tests.compiled import from_python
from tests.filters.machines import oscillator_machine

FUNCTIONS = ("initialise", "propagate", "observe", "log_density")

ReadArguments = arguments_class(
    "ReadArguments", SYSTEM_ARGUMENTS | {"out": I64_PTR, "reals": F64_PTR}, __name__
)


def _read(table, dt, theta, n_theta, inputs, n_rows, out, reals):
    system = read_system(table, dt, theta, n_theta, inputs, n_rows)
    seen, numbers = carray(out, (12,)), carray(reals, (2,))
    seen[0], seen[1], seen[2], seen[3] = system.n, system.p, system.n_theta, system.c.size
    seen[4], seen[5] = system.inputs.shape
    seen[6], seen[7], seen[8] = system.initialise, system.propagate, system.observe
    seen[9], seen[10], seen[11] = system.log_density, system.step_moments, system.free.size
    numbers[0], numbers[1] = system.dt, system.c[0]


READ = EntryPoint(_read, SYSTEM_ARGUMENTS | {"out": I64_PTR, "reals": F64_PTR}, "read_system")


def test_slots_are_distinct_and_without_gaps():
    assert tuple(TABLE) == tuple(range(N_SLOTS))


def test_what_is_packed_is_read_under_its_own_name():
    """Sizes that all differ, and the address of every function."""
    machine = oscillator_machine()
    machine.n, machine.p, machine.n_inputs, machine.n_theta = 2, 3, 5, 4
    machine.free = np.array([1])
    table = from_python(system_table(machine, FUNCTIONS).make)()
    READ.compile()
    read = READ.external

    @njit(error_model="numpy", nogil=True)
    def unpack(table, theta, inputs):
        out, reals = np.empty(12, np.int64), np.empty(2)
        arguments = ReadArguments(
            table=table.ctypes.data,
            dt=0.25,
            theta=theta.ctypes.data,
            n_theta=theta.size,
            inputs=inputs.ctypes.data,
            n_rows=inputs.shape[0],
            out=out.ctypes.data,
            reals=reals.ctypes.data,
        )
        read(*arguments)
        return out, reals

    seen, numbers = unpack(table, np.full(4, 7.0), np.zeros((6, 5)))
    addresses = [entry_point(machine, name).address for name in FUNCTIONS]
    assert seen.tolist() == [2, 3, 4, 1, 6, 5, *addresses, 0, 1]
    assert numbers.tolist() == [0.25, 7.0]
    assert table[N_SLOTS:].tolist() == [1]


def test_swapped_arguments_of_an_entry_point_are_an_error():
    def function(steps, rows, t0):
        pass

    arguments = {"steps": I64_PTR, "rows": I64_PTR, "t0": types.float64}
    EntryPoint(function, arguments, "function")
    swapped = {"rows": I64_PTR, "steps": I64_PTR, "t0": types.float64}
    message = (
        r"arguments of entry point 'function' must be \['steps', 'rows', 't0'\], the parameters of "
        r"its function, got \['rows', 'steps', 't0'\]"
    )
    with pytest.raises(TypeError, match=message):
        EntryPoint(function, swapped, "function")


def test_arguments_are_given_by_name():
    given = {"n_rows": 6, "inputs": 5, "n_theta": 4, "theta": 3, "dt": 2.0, "table": 1}
    assert ReadArguments(**given, out=7, reals=8) == (1, 2.0, 3, 4, 5, 6, 7, 8)
    with pytest.raises(TypeError):
        ReadArguments(**given | {"tables": 1}, out=7, reals=8)
