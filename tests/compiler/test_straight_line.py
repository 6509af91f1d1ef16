"""Straight-line code compiled without numba's front end gives numba's numbers, in less time."""

import logging
import time

import numba
import numpy as np
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen import functions as lowering
from pymc_statespace_filters.compiler.codegen.function_types import Graph, VectorFunction
from pymc_statespace_filters.compiler.codegen.source import SCALAR_NAMESPACE
from pymc_statespace_filters.compiler.codegen.straight_line import straight_line
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system

MIXED = [
    "v0 = c[0]",
    "v1 = table[k, 1]",
    "v2 = v0 < v1",
    "v3 = (v0 if v2 else v1)",
    "v4 = (v2 and (v1 != v1 or v0 >= 0.5)) ",
    "v5 = (1 if v4 else 0)",
    "v6 = v5 + 3 // 2",
    "v7 = float(v6) * exp(-v3) / (-2.5)",
    "v8 = abs(v7) ** 18",
    "v9 = (not v2) == (v0 == v1)",
    "v10 = arctan2(v0, pair[1]) + (1.0 if v9 else 0.0) - nan * 0.0",
    "table[k, 0] = v8",
]


def by_numba(arguments, lines):
    body = "".join(f"    {line}\n" for line in lines)
    scope = dict(SCALAR_NAMESPACE)
    exec(f"def code({arguments}):\n{body}", scope)
    return numba.njit(scope["code"], error_model="numpy")


def by_block(arguments, lines):
    scope = {"block": straight_line(arguments, lines, SCALAR_NAMESPACE)}
    exec(f"def code({arguments}): return block({arguments})", scope)
    return numba.njit(scope["code"], error_model="numpy")


def test_all_statements_mean_what_they_mean_to_numba():
    lines = [*MIXED, "return (v3, v7, (v8, v10,)), v6, v4"]
    results = []
    for compiler in (by_numba, by_block):
        table = np.array([[9.0, 9.0], [9.0, 0.8]])
        code = compiler("c, table, k, pair", lines)
        results.append([code(np.array([x]), table, 1, (0.3, -1.7)) for x in (0.6, 1.9)])
        results[-1].append(table.tolist())
    np.testing.assert_equal(*results)


def test_operations_that_numba_takes_from_python_and_negative_powers():
    """The first has no code of numba's: PyTensor gives it a function of any number of arguments."""
    system = psf.StateSpaceModel(
        transition=lambda x, q: [x[0] + 0.5, x[1] + q[0]],
        process_noise=[[0.01]],
        observation=lambda x: [
            pt.round(x[0], mode="half_away_from_zero"),
            pt.clip(x[0] ** -17, -1e3, 1e3),
        ],
        observation_noise=np.eye(2),
        initial_mean=[-0.5, 0.0],
        initial_cov=np.zeros((2, 2)),
    )
    with pytest.warns(UserWarning, match="object mode to run RoundHalfAwayFromZero"):
        path = psf.simulate(system, {}, steps=[0, 1, 2, 4], noise=False)
    np.testing.assert_allclose(
        path["observations"], [[-1.0, -1e3], [0.0, 1e3], [1.0, 1e3], [2.0, 1.5**-17]], rtol=1e-12
    )


def test_it_compiles_in_a_fraction_of_the_time():
    """Of numba, for 400 statements; the ratio is about 8."""
    lines = ["v0 = c[0]", *(f"v{i} = v{i - 1} * c[{i % 3}] + {i}.5" for i in range(1, 400))]
    times = []
    for compiler in (by_numba, by_block):
        code, start = compiler("c", [*lines, "return v399"]), time.process_time()
        code(np.ones(3))
        times.append(time.process_time() - start)
    assert times[1] < 0.5 * times[0]


def ring(n):
    """Nonlinear springs around a ring of n / 2 masses."""

    def drift(x, k, a):
        position, speed = x[: n // 2], x[n // 2 :]
        ahead, behind = pt.roll(position, -1) - position, position - pt.roll(position, 1)
        return pt.concatenate([speed, k * (ahead - behind) + a * (ahead**3 - behind**3) - speed])

    return psf.StateSpaceModel(
        psf.EulerMaruyama(drift, 0.3 * np.eye(n), dt=0.01),
        observation=lambda x: x[:2],
        observation_noise=0.1 * np.eye(2),
        initial_mean=np.zeros(n),
        initial_cov=np.eye(n),
    )


def test_twenty_coupled_states_are_written_out(caplog, monkeypatch):
    """On arrays, their EKF takes 50 CPU seconds to compile and runs seventeen times slower."""
    monkeypatch.setattr(lowering, "array_vector_function", None)
    with caplog.at_level(logging.DEBUG, "pymc_statespace_filters"):
        psf.EKF().compile(compile_system(ring(20)))
    assert "parameters, start, predict, update: written out in scalars" in caplog.messages


@pytest.mark.parametrize(
    ("output", "reason"),
    [
        (lambda x: pt.sort(x), "the operation SortOp"),
        (lambda x: x[pt.cast(x[0], "int64")][None], "an index or a shape that depends on the"),
        (lambda x: pt.sin(x) + pt.cos(x), "more than 5 scalar operations"),
    ],
)
def test_the_log_says_why_code_runs_on_arrays(output, reason, caplog, monkeypatch):
    monkeypatch.setattr(lowering, "MAX_EXPRESSIONS", 5)
    monkeypatch.setattr(lowering, "array_vector_function", lambda *arguments: None)
    x = pt.tensor("x", shape=(3,), dtype="float64")
    with caplog.at_level(logging.DEBUG, "pymc_statespace_filters"):
        lowering.vector_functions({"f": VectorFunction("c", Graph({"theta": x}, [output(x)]))})
    (message,) = caplog.messages
    assert message.startswith(f"f: array code, because of {reason}")


def test_only_operations_that_are_needed_count(monkeypatch):
    """A product of which one element is read is written out, though 225 others were tried."""
    monkeypatch.setattr(lowering, "MAX_EXPRESSIONS", 100)
    x = pt.tensor("x", shape=(15,), dtype="float64")
    square = pt.outer(x, x) + 1.0
    ((value,),) = lowering.unrolled(Graph({"theta": x}, [square[3, 4][None]]))
    assert lowering.n_operations([value]) == 2


def test_a_function_of_many_results_becomes_machine_code_in_its_callers_only():
    """Alone, the code of the 1700 constants of forty states took 40 CPU seconds."""
    theta = pt.tensor("theta", shape=(2,), dtype="float64")
    covariance = theta[0] * np.eye(21)
    graph = Graph({"theta": theta}, [covariance.ravel()])
    function = lowering.vector_functions({"f": VectorFunction("c", graph)})["f"]
    assert function.large
    copy = lowering.copy_elements("found, c", "c[{i}]", "found", 441)
    found = np.empty(441)
    scope = {"f": function.function, "copy": copy}
    exec("def fill(theta, c): copy(f(theta), c)", scope)
    numba.njit(scope["fill"])(np.array([3.0, 0.0]), found)
    np.testing.assert_array_equal(found.reshape(21, 21), 3.0 * np.eye(21))
