"""Loops over members are vector code, whatever functions a model is made of."""

import re

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.compile.mode import Mode

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen.function_types import Graph
from pymc_statespace_filters.compiler.codegen.functions import member_function
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.system import normal_below as below

N = 61  # vectors, and a rest
C = np.array([0.7, 0.3])

FUNCTIONS = {
    "exp": lambda x, a: pt.exp(-a * x),
    "expm1": lambda x, a: pt.expm1(a * x),
    "log": lambda x, a: pt.log(a + x**2),
    "log1p": lambda x, a: pt.log1p(abs(x)),
    "other bases": lambda x, a: pt.exp2(x) + pt.log2(abs(x)) * pt.log10(2 + abs(x)),
    "sin and cos": lambda x, a: pt.sin(a * x) * pt.cos(x),
    "tan": lambda x, a: pt.tan(a * x),
    "angles": lambda x, a: pt.arctan(x) + pt.arctan2(x, a),
    "hyperbolic": lambda x, a: pt.tanh(a * x) + pt.sinh(x) * pt.cosh(x),
    "sigmoid": lambda x, a: pt.sigmoid(a * x),
    "logistic growth": lambda x, a: x / (1 + pt.exp(-x)),
    "softplus": lambda x, a: pt.softplus(x / a),
    "log1mexp": lambda x, a: pt.log1mexp(-abs(x)),
    "logaddexp": lambda x, a: pt.logaddexp(x, a),
    "sqrt": lambda x, a: pt.sqrt(a + x**2),
    "whole powers": lambda x, a: a * x**3 + 1 / (1 + x**-2),
    "other powers": lambda x, a: (a + x**2) ** 1.5 + abs(x) ** a + 2.0**x,
    "large power": lambda x, a: (x / 3) ** 17,
    "abs and sign": lambda x, a: abs(x) * pt.sign(x - a),
    "minimum and maximum": lambda x, a: pt.minimum(x, a) - pt.maximum(x, -a),
    "clip": lambda x, a: pt.clip(x, -a, a),
    "switch": lambda x, a: pt.switch((x > a) & (x < 2), pt.exp(-x), x),
    "truth values": lambda x, a: (x > a) * x + 1.0 * (x < 0),
    "rounding": lambda x, a: pt.floor(x) + pt.ceil(x / a) + pt.round(x) * pt.trunc(3 * x),
    "remainder": lambda x, a: x % a + x // a,
    "below a limit": lambda x, a: pt.add(
        *(f(a * x) for f in (below.log_probability, below.hazard, below.excess, below.variance))
    ),
    "cubic": lambda x, a: psf.mechanics.cubic(x, a, 0.3),
    "freeplay": lambda x, a: psf.mechanics.freeplay(x, 2.0, a),
    "smooth freeplay": lambda x, a: psf.mechanics.freeplay(x, 2.0, a, width=0.2),
    "hysteresis": lambda x, a: psf.mechanics.hysteresis(x, x - a, 2.0, a, 0.4),
    "smooth hysteresis": lambda x, a: psf.mechanics.hysteresis(x, x - a, 2.0, a, 0.4, width=0.2),
}


def vector_arithmetic(function):
    """Whether the machine code of a member function adds or multiplies vectors."""
    text = str(function.entry.optimised())
    return (
        re.search(r"(?:fadd|fmul|fsub|@llvm\.\w+\.v\d+f64)[^\n]*<\d+ x double>", text) is not None
    )


def library_calls(function):
    """What is called rather than built in."""
    text = str(function.entry.optimised())
    called = re.findall(r"call[^\n@]* (?:double|void) @\"?([^\s(\"]+)", text)
    return {name for name in called if not name.startswith("llvm.")}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_members_move_in_vectors_and_as_pytensor_says(name):
    x, c = pt.tensor("x", shape=(1,)), pt.tensor("c", shape=(2,))
    moved = x[0] + c[1] * FUNCTIONS[name](x[0], c[0])
    graph = Graph({"theta": c, "x": x}, [pt.stack([moved])])
    propagate = member_function("propagate", "c, X", graph, "X")
    X = 2 * np.random.default_rng(0).normal(size=(1, N))
    before = X.copy()
    propagate.function(C, X)
    assert vector_arithmetic(propagate)
    assert library_calls(propagate) == set()
    exact = pytensor.function([x, c], moved, mode=Mode("py", None))
    expected = [exact(column, C) for column in before.T]
    np.testing.assert_allclose(X[0], expected, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("n", [8, 9, 20])
def test_any_number_of_states_moves_in_vectors(n):
    x, z = pt.tensor("x", shape=(n,)), pt.tensor("z", shape=(n,))
    graph = Graph({"x": x, "z": z}, [x * pt.roll(x, 1) + pt.sin(x) + z])
    propagate = member_function("propagate", "Z, X", graph, "X")
    X, Z = np.random.default_rng(n).normal(size=(2, n, 2 * 64 + N))
    expected = X * np.roll(X, 1, axis=0) + np.sin(X) + Z
    propagate.function(Z, X)
    assert vector_arithmetic(propagate)
    np.testing.assert_allclose(X, expected, rtol=1e-13, atol=1e-15)


def test_a_call_of_the_library_would_be_noticed():
    x = pt.tensor("x", shape=(1,))
    graph = Graph({"x": x}, [pt.erf(x)])
    propagate = member_function("propagate", "X", graph, "X")
    propagate.function(np.zeros((1, N)))
    (called,) = library_calls(propagate)
    assert called.startswith("psf_erf_")
    assert not vector_arithmetic(propagate)


def counted(x, c):
    return [pm.Poisson.dist(mu=pt.exp(c + x[0]))]


OBSERVED = {
    "gaussian": {"observation": lambda x, c: [c * x[0]], "observation_noise": [[0.3]]},
    "counts": {"observation_dist": counted},
}


@pytest.mark.parametrize("observed", OBSERVED)
def test_densities_of_observations_are_vector_code(observed):
    system = psf.StateSpaceModel(
        transition=lambda x, q: [0.9 * x[0] + q[0]],
        process_noise=[[1.0]],
        initial_mean=[0.0],
        initial_cov=[[1.0]],
        **OBSERVED[observed],
    )
    machine = compile_system(system)
    X, out = np.random.default_rng(0).normal(size=(1, N)), np.empty(N)
    inputs = np.zeros((1, 0))
    machine.log_density.function(
        machine.prepare.function(C[:1]), inputs, 0, 0.0, np.array([2.0]), X, out
    )
    assert vector_arithmetic(machine.log_density)
    assert np.isfinite(out).all()
