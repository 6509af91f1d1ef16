"""Two forms of one function, scalars and arrays: a caller cannot tell them apart."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from pytensor import wrap_py
from scipy import stats

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen import functions as lowering
from pymc_statespace_filters.compiler.codegen.array_fallback import _frontier, array_code
from pymc_statespace_filters.compiler.codegen.function_types import Graph
from pymc_statespace_filters.compiler.codegen.functions import member_function, vector_function
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.ops.base import kernel
from pymc_statespace_filters.ops.likelihood import LogLikelihood


def vector(name, size):
    return pt.tensor(name, shape=(size,), dtype="float64")


@pytest.fixture
def on_arrays(monkeypatch):
    def switch():
        monkeypatch.setattr(lowering, "MAX_EXPRESSIONS", 0)

    return switch


def pair_of_functions():
    """Two outputs, and every kind of input."""
    theta, x, t, d = vector("theta", 2), vector("s", 3), pt.dscalar("t"), vector("d", 1)
    inputs = {"theta": theta, "t": t, "d": d, "s": x}
    outputs = [pt.roll(x, 1) * theta[0] + t, pt.atleast_1d(pt.sum(x**2) - d[0] * theta[1])]
    outputs[0] = pt.specify_shape(outputs[0], (3,))
    return vector_function("f", "c, t, d, s", Graph(inputs, outputs))


def test_a_vector_function_is_the_same_on_arrays(on_arrays):
    arguments = (np.array([0.3, 2.0]), 1.5, np.array([0.7]), np.array([1.0, -2.0, 0.5]))
    scalar = pair_of_functions()
    on_arrays()
    array = pair_of_functions()
    assert scalar.key is not None
    assert array.key not in (None, scalar.key)
    for function in (scalar.function, array.function):
        vector_part, (number,) = function(*arguments)
        np.testing.assert_allclose(vector_part, [1.65, 1.8, 0.9], rtol=1e-14)
        assert number == pytest.approx(5.25 - 1.4, rel=1e-14)


def member_graph():
    theta, x, z = vector("theta", 2), vector("x", 2), vector("z", 2)
    matrix = pt.stack([[1.0, theta[0]], [0.0, pt.exp(theta[1])]])
    return Graph({"theta": theta, "x": x, "z": z}, [matrix @ matrix @ x + theta[1] * z])


def propagated(compiled):
    X = np.array([[1.0, -2.0, 0.3], [0.5, 4.0, 0.0]])
    Z = np.linspace(-1, 1, 2 * 64).reshape(2, 64)  # wider than the ensemble, as the filters' is
    compiled.function(np.array([0.4, 0.2]), Z, X)
    return X


def test_a_member_function_is_the_same_on_arrays(on_arrays):
    make = lambda: member_function("move", "c, Z, X", member_graph(), "X")  # noqa: E731
    scalar = propagated(make())
    on_arrays()
    np.testing.assert_allclose(propagated(make()), scalar, rtol=1e-13)


def test_what_no_member_enters_is_computed_before_the_loop():
    text = member_function("move", "c, Z, X", member_graph(), "X").entry.code.text
    before, _, inside = text.partition("for.body:")
    assert '@"psf.exp"(double' in before
    assert "call" not in inside.partition("declare")[0]
    # The parameters are read before; in the loop, two states and two normals of the member.
    assert inside.count("load double") == 4


def test_on_arrays_too_it_is_computed_before_the_loop():
    graph = member_graph()
    inputs = list(graph.inputs.values())
    shared = _frontier(inputs, inputs[1:], graph.outputs)
    assert all(variable not in inputs[1:] for variable in shared)
    assert any(variable.type.ndim == 2 for variable in shared)  # the product of the two matrices


def test_a_value_for_every_member_is_the_same_on_arrays(on_arrays):
    x = vector("x", 2)
    graph = Graph({"x": x}, [pt.atleast_1d(pt.sum(x**2))])
    X, out = np.array([[1.0, 2.0, 3.0], [0.0, 1.0, 2.0]]), np.empty(3)
    for _ in range(2):
        out[:] = 0.0
        member_function("density", "c, X, out", graph, "out").function(np.zeros(1), X, out)
        np.testing.assert_allclose(out, [1.0, 5.0, 13.0])
        on_arrays()


def test_an_exception_of_one_member_is_nan_for_that_member():
    """The inverse of a matrix that is not finite raises; the other members go on."""
    x = vector("x", 2)
    inverse = pt.linalg.inv(pt.stack([[x[0], 0.0], [0.0, x[1]]]))
    graph = Graph({"x": x}, [pt.diagonal(inverse)])
    X = np.array([[2.0, 0.0, np.nan, 4.0], [5.0, 1.0, 1.0, 10.0]])
    member_function("move", "c, X", graph, "X").function(np.zeros(1), X)
    np.testing.assert_allclose(X[:, [0, 3]], [[0.5, 0.25], [0.2, 0.1]])
    assert np.isnan(X[:, 1:3]).all()


def test_an_exception_before_the_members_is_nan_for_all():
    theta, x = vector("theta", 1), vector("x", 1)
    inverse = pt.linalg.inv(pt.stack([[theta[0]]]))
    graph = Graph({"theta": theta, "x": x}, [inverse @ x])
    move = member_function("move", "c, X", graph, "X").function
    X = np.array([[1.0, 2.0]])
    move(np.array([4.0]), X)
    np.testing.assert_allclose(X, [[0.25, 0.5]])
    move(np.array([0.0]), X)
    assert np.isnan(X).all()


def test_an_exception_of_a_vector_function_is_nan(on_arrays):
    on_arrays()
    s = vector("s", 1)
    graph = Graph({"s": s}, [pt.linalg.inv(s[None, :]).ravel(), pt.atleast_1d(s[0])])
    function = vector_function("f", "s", graph).function
    assert np.isnan(function(np.array([0.0]))[0]).all()
    assert np.isnan(function(np.array([0.0]))[1]).all()
    assert function(np.array([2.0]))[0][0] == 0.5


def test_a_failing_parameter_check_is_not_finite(on_arrays):
    theta = vector("theta", 1)
    graph = Graph({"theta": theta}, [pt.atleast_1d(pm.logp(pm.Poisson.dist(mu=theta[0]), 3))])
    for _ in range(2):
        logp = vector_function("f", "c", graph).function
        assert not np.isfinite(logp(np.array([-1.0]))[0])
        assert logp(np.array([2.0]))[0] == pytest.approx(stats.poisson(2.0).logpmf(3), rel=1e-12)
        on_arrays()


@wrap_py(itypes=[pt.dvector], otypes=[pt.dvector])
def _black_box(x):
    return x


def test_what_has_no_machine_code_is_named():
    system = psf.StateSpaceModel(
        transition=lambda x: pt.specify_shape(_black_box(x), (2,)),
        observation=lambda x: [x[0]],
        observation_noise=[[1.0]],
        initial_mean=[0.0, 1.0],
        initial_cov=np.eye(2),
    )
    with pytest.raises(psf.errors.LoweringError, match=r"pytensor.tensor operations.*_black_box"):
        compile_system(system).propagate  # noqa: B018
    with pytest.raises(psf.errors.LoweringError, match=r"_black_box|[Nn]o|gradient"):
        psf.log_likelihood(system, psf.EnKF(10), {}, [0.0], steps=[1])


def test_keys_tell_settings_apart():
    keys = {
        kernel(
            LogLikelihood(
                psf.StateSpaceModel(
                    transition=lambda x, a: [a * x[0]],
                    observation=lambda x: [x[0]],
                    observation_noise=[[noise]],
                    initial_mean=[0.0],
                    initial_cov=[[1.0]],
                    dt=dt,
                ),
                psf.EnKF(10),
            )
        ).key
        for noise in (1.0, 2.0)
        for dt in (0.1, 0.2)
    }
    assert len(keys) == 4
    assert None not in keys


def test_what_is_no_number_may_stand_in_a_graph_on_arrays():
    """Here None, for an axis of any length; the derivative of a filter's update holds some."""
    s = vector("s", 3)
    some = s[: s[0].astype("int64")]
    rows = pt.specify_shape(pt.outer(some, some), (None, 2))
    assert array_code([s], [rows.sum(axis=0)]).key is not None
