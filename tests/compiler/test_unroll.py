"""Code in scalars gives the numbers of PyTensor's own functions, whatever a user writes."""

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.compile.mode import Mode

from pymc_statespace_filters.compiler.codegen import functions as lowering
from pymc_statespace_filters.compiler.codegen.expressions import Arena
from pymc_statespace_filters.compiler.codegen.function_types import Graph
from pymc_statespace_filters.compiler.codegen.functions import vector_function
from pymc_statespace_filters.compiler.codegen.scalarize import NotUnrollableError, unroll
from pymc_statespace_filters.compiler.lowering.staged import staged
from pymc_statespace_filters.system.equations import as_vector
from tests.compiler import example_functions

POINTS = np.array([[0.3, -0.7, 1.4], [-1.3, 0.0, 2.0]])
INTERPRETED = Mode(linker="py", optimizer=None)


def traced(group):
    """One graph with an output for each program: it compiles much faster than a graph for each."""
    x = pt.tensor("x", shape=(3,), dtype="float64")
    return x, [as_vector(name, program(x)) for name, program in group.items()]


def lowered(x, outputs):
    compiled = vector_function("f", "c", Graph({"theta": x}, outputs)).function
    return compiled if len(outputs) > 1 else lambda point: (compiled(point),)


def assert_same(group, x, outputs, rtol):
    """The programs' outputs at x, lowered, are those of PyTensor's own functions."""
    references = [pytensor.function([x], y, mode=INTERPRETED) for y in outputs]
    function = lowered(x, outputs)
    for point in POINTS:
        for name, reference, value in zip(group, references, function(point), strict=True):
            with np.errstate(all="ignore"):
                expected = reference(point)
            np.testing.assert_allclose(value, expected, rtol=rtol, atol=1e-15, err_msg=name)


@pytest.mark.parametrize("group", ["MOVING", "ARITHMETIC", "LOGIC", "ALGEBRA", "SOLVED", "NESTED"])
def test_unrolled_code_equals_pytensor(group, monkeypatch):
    x, outputs = traced(getattr(example_functions, group))
    # Whatever has no scalar form raises here, where array code would step in.
    monkeypatch.setattr(lowering, "array_vector_function", None)
    assert_same(getattr(example_functions, group), x, outputs, rtol=1e-13)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_small_systems_of_equations_are_solved_as_by_numpy(n):
    """Random matrices and permutations, with zeros on the diagonal."""
    p = pt.tensor("p", shape=(n * n + n,), dtype="float64")
    A, b = p[: n * n].reshape((n, n)), p[n * n :]
    outputs = [pt.linalg.solve(A, b), pt.linalg.inv(A).ravel(), pt.linalg.det(A)[None]]
    function = lowered(p, outputs)
    rng = np.random.default_rng(n)
    order = rng.permuted(np.tile(np.arange(n), (5, 1)), axis=1)
    matrices = [rng.normal(size=(n, n)) + 2 * np.eye(n) for _ in range(5)]
    for matrix in [*matrices, *np.eye(n)[order], np.eye(n)[::-1]]:
        right = rng.normal(size=n)
        solution, inverse, det = function(np.concatenate([matrix.ravel(), right]))
        scale = np.linalg.cond(matrix)
        for value, expected in (
            (solution, np.linalg.solve(matrix, right)),
            (inverse, np.linalg.inv(matrix).ravel()),
            (det, [np.linalg.det(matrix)]),
        ):
            error = np.abs(np.array(value) - expected).max() / np.abs(expected).max()
            assert error < 1e-14 * scale
    # A singular matrix: no solution, no inverse, the determinant zero.
    solution, inverse, (zero,) = function(np.concatenate([np.zeros(n * n), np.ones(n)]))
    assert np.isnan(solution).all()
    assert np.isnan(inverse).any()
    assert zero == 0.0


def test_three_equations_are_eliminated_with_the_largest_pivots():
    """Without exchanges the small pivot would cost ten digits, with cofactors eight."""
    p = pt.tensor("p", shape=(12,), dtype="float64")
    function = lowered(p, [pt.linalg.solve(p[:9].reshape((3, 3)), p[9:])])
    rng = np.random.default_rng(3)
    u, v = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))
    for matrix in (
        np.array([[1e-12, 1, 0], [1, 1, 0], [0, 1, 1]]),
        u @ np.diag([1, 1e-4, 1e-8]) @ v,
    ):
        x = np.array([1.0, -2.0, 3.0])
        (solution,) = function(np.concatenate([matrix.ravel(), matrix @ x]))
        np.testing.assert_allclose(solution, x, rtol=1e-15 * np.linalg.cond(matrix) * 30)


def test_what_does_not_unroll_runs_on_arrays():
    """Not all of it here: numba takes seconds for its sort and its eigenvalues."""
    x, outputs = traced(example_functions.ARRAYS_ONLY)
    for output in outputs:
        with pytest.raises(NotUnrollableError):
            lowering.unrolled(Graph({"theta": x}, [output]))
    quick = {name: example_functions.ARRAYS_ONLY[name] for name in ("cumsum", "scan")}
    assert_same(quick, *traced(quick), rtol=1e-12)


def test_a_value_that_is_not_finite_never_turns_into_a_finite_one():
    names = ("elementary", "whole powers", "sums", "clip")
    group = {name: example_functions.ARITHMETIC[name] for name in names}
    group["cholesky"] = example_functions.ALGEBRA["cholesky"]
    group["switch"] = example_functions.LOGIC["switch"]
    x, outputs = traced(group)
    references = [pytensor.function([x], y, mode=INTERPRETED) for y in outputs]
    function = lowered(x, outputs)
    for poison in (np.nan, np.inf, -np.inf):
        point = np.array([poison, 1.0, -2.0])
        for name, reference, value in zip(group, references, function(point), strict=True):
            with np.errstate(all="ignore"):
                unknown = np.isnan(reference(point))
            assert not np.isfinite(np.asarray(value)[unknown]).any(), name


def test_a_large_graph_is_not_written_out():
    x = pt.tensor("x", shape=(3,), dtype="float64")
    y = x
    for _ in range(20):
        y = pt.sin(y) + x
    arena = Arena()
    values = np.empty(3, dtype=object)
    values[:] = [arena.input(f"x.{i}") for i in range(3)]
    with pytest.raises(NotUnrollableError, match="more than 50"):
        unroll(arena, [x], [values], [y], 50)


# Constants of an evaluation that array code computes.


def test_array_code_takes_its_arguments_alone():
    theta = pt.tensor("theta", shape=(3,), dtype="float64")
    extended = pt.specify_shape(pt.concatenate([theta, pt.cumsum(theta)]), (6,))
    evaluate = staged("extend", [theta], extended).function
    found = evaluate(np.array([3.0, 1.0, 2.0]))
    np.testing.assert_array_equal(found, [3.0, 1.0, 2.0, 3.0, 4.0, 6.0])
