"""Equations written out in scalars give PyTensor's numbers, and compile without numba."""

import logging
import time
from ctypes import CFUNCTYPE, c_void_p

import numba
import numpy as np
import pytensor
import pytensor.scalar as ps
import pytensor.tensor as pt
import pytest
from pytensor.compile.mode import Mode
from pytensor.graph.replace import graph_replace

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen import functions as lowering
from pymc_statespace_filters.compiler.codegen.expressions import Arena
from pymc_statespace_filters.compiler.codegen.function_types import Graph
from pymc_statespace_filters.compiler.codegen.machine_code import ModuleEntryPoint
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR


def mixed(c):
    """Truth values, whole numbers and floats in all operations that mix them."""
    small = c[0] < c[1]
    least = pt.switch(small, c[0], c[1])
    truth = small & (pt.isnan(c[1]) | pt.ge(c[0], 0.5))
    whole = pt.cast(truth, "int64") + pt.cast(3.7 * c[0], "int64")
    number = pt.cast(whole, "float64") * pt.exp(-least) / -2.5
    other = pt.invert(small) ^ pt.eq(c[0], c[1])
    angle = pt.arctan2(c[0], c[2]) + pt.switch(other, 1.0, 0.0)
    return [
        least, number, abs(number) ** 18, angle, whole // 2, whole % 3, pt.cast(truth, "float64"),
        pt.sign(c[2]), pt.maximum(c[0], c[1]), pt.minimum(c[0], np.nan * c[1]), c[0] // c[1],
        c[2] % c[1], pt.isinf(c[2] / (c[0] - 0.6)), whole & 5, whole | 8, pt.invert(whole),
    ]  # fmt: skip


def test_all_operations_mean_what_they_mean_to_pytensor():
    c = pt.tensor("c", shape=(3,), dtype="float64")
    results = [pt.cast(value, "float64") for value in mixed(c)]
    output = pt.stack(results)
    interpreted = pytensor.function([c], output, mode=Mode("py", None))
    graph = Graph({"theta": c}, [output])
    compiled = lowering.vector_function("f", "c", graph).function
    x, n = pt.tensor("x", shape=(3,), dtype="float64"), len(results)
    (moved,) = graph_replace([output], {c: x})
    members = lowering.member_function("f", "X, out", Graph({"x": x}, [moved]), "out")
    for first in (0.6, 1.9):
        given = np.array([first, 0.8, -1.7])
        with np.errstate(all="ignore"):
            expected = interpreted(given)
        np.testing.assert_allclose(compiled(given), expected, rtol=1e-14)
        X, out = np.repeat(given[:, None], 5, axis=1), np.empty((n, 5))
        members.function(X, out)
        np.testing.assert_allclose(out, np.repeat(expected[:, None], 5, axis=1), rtol=1e-14)


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
    """Of numba, for 150 statements; the ratio is above 10."""
    lines = ["v0 = c[0]", *(f"v{i} = v{i - 1} * c[{i % 3}] + {i}.5" for i in range(1, 150))]
    scope = {}
    exec("def code(c):\n" + "".join(f"    {line}\n" for line in [*lines, "return v149"]), scope)
    by_numba = numba.njit(scope["code"], error_model="numpy")
    start = time.process_time()
    expected = by_numba(np.ones(3))
    middle = time.process_time()
    arena = Arena()
    c = [arena.input(f"c.{i}") for i in range(3)]
    value = c[0]
    for i in range(1, 150):
        value = arena.apply(ps.add, arena.apply(ps.mul, value, c[i % 3]), i + 0.5)
    code, _ = lowering.vector_code([value])
    entry = ModuleEntryPoint(code, {"given": F64_PTR, "out": F64_PTR}, "f")
    entry.key = None
    entry.compile()
    assert time.process_time() - middle < 0.5 * (middle - start)
    given, out = np.ones(3), np.empty(1)
    CFUNCTYPE(None, c_void_p, c_void_p)(entry.address)(given.ctypes.data, out.ctypes.data)
    assert out[0] == pytest.approx(expected, rel=1e-14)


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
        psf.EKF().plan_of_likelihood(compile_system(ring(20)))
    for part in ("start", "predict", "update"):
        assert f"{part}: written out in scalars" in caplog.messages


@pytest.mark.parametrize(
    ("output", "reason"),
    [
        (lambda x: pt.sort(x), "the operation SortOp"),
        (lambda x: x[pt.cast(x[:1], "int64")], "slices or several indices that depend on"),
        (lambda x: pt.sin(x) + pt.cos(x), "more than 5 scalar operations"),
    ],
)
def test_the_log_says_why_code_runs_on_arrays(output, reason, caplog, monkeypatch):
    monkeypatch.setattr(lowering, "MAX_EXPRESSIONS", 5)
    monkeypatch.setattr(lowering, "array_vector_function", lambda *arguments: None)
    x = pt.tensor("x", shape=(3,), dtype="float64")
    with caplog.at_level(logging.DEBUG, "pymc_statespace_filters"):
        lowering.vector_function("f", "c", Graph({"theta": x}, [output(x)]))
    (message,) = caplog.messages
    assert message.startswith(f"f: array code, because of {reason}")


def test_only_operations_that_are_needed_count(monkeypatch):
    """A product of which one element is read is written out, though 225 others were tried."""
    monkeypatch.setattr(lowering, "MAX_EXPRESSIONS", 100)
    x = pt.tensor("x", shape=(15,), dtype="float64")
    square = pt.outer(x, x) + 1.0
    ((value,),) = lowering.unrolled(Graph({"theta": x}, [square[3, 4][None]]))
    assert lowering.n_operations([value]) == 2


def test_a_graph_of_many_small_operations_may_have_more(monkeypatch):
    """Array code takes its time for each of them, however few scalars it has."""
    monkeypatch.setattr(lowering, "MAX_EXPRESSIONS", 20)
    monkeypatch.setattr(lowering, "MANY_NODES", 10)
    x = y = pt.tensor("x", shape=(1,), dtype="float64")
    for _ in range(15):
        y = pt.sin(y) + x
    lowering.unrolled(Graph({"theta": x}, [y]))
    wide = pt.tensor("wide", shape=(15,), dtype="float64")
    with pytest.raises(lowering.NotUnrollableError, match="more than 20 scalar"):
        lowering.unrolled(Graph({"theta": wide}, [pt.sin(wide) + wide]))


def test_a_function_of_many_results_becomes_machine_code_in_its_callers_only():
    """Alone, the code of the 1700 constants of forty states took 40 CPU seconds."""
    theta = pt.tensor("theta", shape=(2,), dtype="float64")
    covariance = theta[0] * np.eye(21)
    graph = Graph({"theta": theta}, [covariance.ravel()])
    function = lowering.vector_function("f", "c", graph)
    assert function.large
    run = function.function
    found = numba.njit(lambda theta: run(theta))(np.array([3.0, 0.0]))
    np.testing.assert_array_equal(np.reshape(found, (21, 21)), 3.0 * np.eye(21))
