"""Plans of filters and entry points: no argument is taken for another, nothing damaged is read."""

import ctypes
import mmap
from copy import copy

import numpy as np
import pytest
from numba import types

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen.arguments import MEMBER_ARGUMENTS, MemberArguments
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, I64_PTR, EntryPoint
from pymc_statespace_filters.compiler.native.plan import (
    DAMAGED,
    HEADER,
    N_HEADER,
    N_RECORD,
    N_REQUEST,
    N_RESULTS,
    RECORD,
    REQUEST,
    RESULTS,
    Refusal,
    plan_entry,
)
from pymc_statespace_filters.compiler.native.planned_function import PlannedFunction
from pymc_statespace_filters.filters.calls import OK, opened, reals_at, single_record
from pymc_statespace_filters.filters.plan import (
    N_WORDS,
    PLAN,
    make_plan,
    read_system,
    settings_of,
)
from pymc_statespace_filters.ops.base import kernel
from pymc_statespace_filters.ops.likelihood import LogLikelihoodOfNoise
from tests.systems import PAIR, PAIR_DATA, STEPS, pair

FUNCTIONS = ("initialise", "propagate", "observe", "log_density")
RECORD_ARGUMENTS = (("theta", 1), ("steps", 1), ("observed", 2), ("inputs", 2), ("t0", 0))
N_SEEN = 20


def _read(plan, record, request, results):
    status, call = opened(plan, record, request, results)
    call.results[RESULTS.n_normals] = N_SEEN
    if status != OK or call.request[REQUEST.sizes_only]:
        return status
    data = single_record(call, 0, 0, call.record[RECORD.n_rows])
    system, settings = read_system(call.plan, data.theta, data.inputs), settings_of(call.plan)
    seen = reals_at(call.results[RESULTS.normals], (N_SEEN,))
    seen[0], seen[1], seen[2], seen[3] = system.n, system.p, system.n_theta, system.c.size
    seen[4], seen[5] = system.inputs.shape
    seen[6], seen[7], seen[8] = system.initialise, system.propagate, system.observe
    seen[9], seen[10], seen[11] = system.log_density, system.step_moments, system.free.size
    seen[12], seen[13], seen[14] = system.dt, system.c[0], system.free[0]
    seen[15], seen[16], seen[17] = settings.size, settings[0], settings[1]
    seen[18], seen[19] = data.t0, data.steps[1]
    return status


def test_slots_are_distinct_and_without_gaps():
    assert (*HEADER, *PLAN) == tuple(range(N_WORDS))
    for slots, size in ((RECORD, N_RECORD), (REQUEST, N_REQUEST), (RESULTS, N_RESULTS)):
        assert tuple(slots) == tuple(range(size))


def test_what_is_packed_is_read_under_its_own_name():
    """Sizes that all differ, and the address of every function."""
    system = copy(compile_system(PAIR))
    system.n, system.p, system.n_inputs, system.n_theta = 2, 3, 5, 4
    system.free, n_constants = np.array([1]), system.n_constants
    plan = make_plan(system, plan_entry(_read, "read"), FUNCTIONS, (0.125, 8.0))
    read = PlannedFunction(plan, RECORD_ARGUMENTS, (("normals", 1),))
    steps, observed = np.array([1, 4]), np.zeros((2, 3))
    seen = read(np.full(4, 7.0), steps, observed, np.zeros((6, 5)), 0.75)
    addresses = [system.entry_point(name).address for name in FUNCTIONS]
    assert seen.tolist() == [
        2, 3, 4, n_constants, 6, 5, *addresses, 0, 1, system.dt, 7.0, 1, 2, 0.125, 8.0, 0.75, 4,
    ]  # fmt: skip


def call(words, address=None):
    """The status of a call with these words as plan."""
    plan = psf.BootstrapPF(20).plan_of_likelihood(compile_system(PAIR))
    vectors = [np.zeros(size, np.int64) for size in (N_RECORD, N_REQUEST, N_RESULTS)]
    vectors[1][REQUEST.sizes_only] = 1
    at = plan.address if words is None else words.ctypes.data
    return plan.run(address or at, *(vector.ctypes.data for vector in vectors))


def words_of_plan():
    plan = psf.BootstrapPF(20).plan_of_likelihood(compile_system(PAIR))
    first = np.ctypeslib.as_array((ctypes.c_int64 * N_HEADER).from_address(plan.address))
    size = int(first[HEADER.n_words])
    return np.array((ctypes.c_int64 * size).from_address(plan.address), np.int64)


def test_plans_of_equal_code_are_the_same_words():
    """The words of the first one must not be freed when a second one is made."""
    filter = psf.BootstrapPF(20)
    plans = [filter.plan_of_likelihood(compile_system(PAIR)) for _ in range(2)]
    plans.append(filter.plan_of_likelihood(compile_system(pair())))
    assert len({plan.address for plan in plans}) == 1
    assert len({id(plan) for plan in plans}) > 1


def test_a_damaged_plan_is_refused():
    """Each word changed, two words exchanged, and more or fewer words than there are."""
    sound = words_of_plan()
    assert call(sound) != DAMAGED
    rng = np.random.default_rng(1)
    for place in range(sound.size):
        for change in (1, int(rng.integers(2, 2**62))):
            words = sound.copy()
            words[place] ^= change
            assert call(words) == DAMAGED
    for _ in range(200):
        words, (i, j) = sound.copy(), rng.choice(sound.size, 2, replace=False)
        words[[i, j]] = words[[j, i]]
        assert (call(words) == DAMAGED) == (sound[i] != sound[j])
    for size in (0, 1, N_HEADER, sound.size - 1, sound.size + 1, 2**40, -1, 2**63 - 1):
        words = sound.copy()
        words[HEADER.n_words] = size
        assert call(words) == DAMAGED


def test_nothing_behind_the_header_of_a_damaged_plan_is_read():
    """The header is the end of a page, and the next page must not be read."""
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "mprotect"):
        pytest.skip("pages are protected by mprotect")
    page = mmap.PAGESIZE
    memory = mmap.mmap(-1, 2 * page)
    base = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    header = words_of_plan()[:N_HEADER]
    header[HEADER.n_words] += 1
    address = base + page - header.nbytes
    ctypes.memmove(address, header.ctypes.data, header.nbytes)
    assert libc.mprotect(ctypes.c_void_p(base + page), page, 0) == 0
    try:
        assert call(None, address) == DAMAGED
    finally:
        libc.mprotect(ctypes.c_void_p(base + page), page, 3)


RECORD_OF_PAIR = {
    "theta": np.array([0.7, 0.2]), "steps": STEPS, "observed": PAIR_DATA,
    "inputs": np.zeros((STEPS[-1] + 1, 0)), "t0": 0.0, "normals": np.empty(0),
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "status"),
    [
        ({"steps": STEPS[::-1].copy()}, 2),
        ({"steps": np.maximum(STEPS, STEPS[1])}, 2),
        ({"steps": STEPS - 1 - STEPS[0]}, 2),
        ({"observed": PAIR_DATA[:-1]}, 5),
        ({"observed": PAIR_DATA[:, :1].copy()}, 5),
        ({"normals": np.zeros(7)}, 9),
    ],
)
def test_a_record_that_does_not_fit_is_refused_from_python_and_from_compiled_code(change, status):
    likelihood = kernel(LogLikelihoodOfNoise(PAIR, psf.BootstrapPF(20)))
    arguments = (RECORD_OF_PAIR | change).values()
    for function in (likelihood, likelihood.function):
        with pytest.raises(psf.errors.ModelError) as error:
            function(*arguments)
        assert str(error.value) == Refusal(status).message


def test_python_and_compiled_code_give_the_same_bits():
    likelihood = kernel(LogLikelihoodOfNoise(PAIR, psf.BootstrapPF(20)))
    (terms, health), (theirs, state) = (
        function(*RECORD_OF_PAIR.values()) for function in (likelihood, likelihood.function)
    )
    np.testing.assert_array_equal(terms, theirs)
    np.testing.assert_array_equal(health, state)
    in_columns = RECORD_OF_PAIR | {"observed": np.asfortranarray(PAIR_DATA)}
    np.testing.assert_array_equal(likelihood.function(*in_columns.values())[0], terms)


def test_swapped_arguments_of_an_entry_point_are_an_error():
    def function(steps, rows, t0):
        pass

    arguments = {"steps": I64_PTR, "rows": F64_PTR, "t0": types.float64}
    EntryPoint(function, arguments, "function")
    swapped = {"rows": F64_PTR, "steps": I64_PTR, "t0": types.float64}
    message = (
        r"arguments of entry point 'function' must be \['steps', 'rows', 't0'\], the parameters of "
        r"its function, got \['rows', 'steps', 't0'\]"
    )
    with pytest.raises(TypeError, match=message):
        EntryPoint(function, swapped, "function")


def test_arguments_are_given_by_name():
    given = {name: place for place, name in enumerate(MEMBER_ARGUMENTS)}
    assert MemberArguments(**dict(reversed(given.items()))) == tuple(range(len(given)))
    with pytest.raises(TypeError):
        MemberArguments(**given | {"members": 1})
