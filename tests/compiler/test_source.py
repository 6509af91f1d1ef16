"""The text of generated code is canonical: it is part of the key of machine code on disk."""

import os
import subprocess
import sys

import pytensor.scalar as ps

from pymc_statespace_filters.compiler.codegen.expressions import Arena
from pymc_statespace_filters.compiler.codegen.source import Writer, depends_on
from tests.waiting import LIMIT

PRINT_IDENTITY = """
import pymc as pm
import pytensor.tensor as pt
import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen import functions as lowering
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint

EntryPoint.compile = lambda entry: None  # the text is asked for, not the code
sources = []
build = lowering.build
def noted(name, arguments, body, writer, large=False, /, **blocks):
    sources.extend([name, arguments, *body])
    for block, (given, lines) in blocks.items():
        sources.extend([block, given, *lines])
    return build(name, arguments, body, writer, large, **blocks)
lowering.build = noted

def drift(x, t, u, a, b=1.5):
    x0, x1, x2 = x
    return pt.roll(x, 1) * a + pt.stack([pt.sin(x0), pt.erf(b * x1), u[0] * pt.softplus(x2)])

def counts(x, c):
    return [
        pm.Poisson.dist(mu=pt.exp(c + x[0])),
        pm.NegativeBinomial.dist(mu=pt.exp(x[1]), alpha=2),
    ]

common = dict(
    transition=psf.EulerMaruyama(drift, lambda s: [[s, 0], [0, 1], [0, s]], dt=0.1),
    initial_mean=lambda a: [a, 0, 0], initial_cov=[[1.0, 0, 0], [0, 1, 0], [0, 0, 0]], inputs=["f"],
)
gaussian = psf.StateSpaceModel(
    observation=lambda x, e, g: pt.stack([x[0] * pt.exp(e[0]), x[1] + g * e[1]]),
    observation_noise=lambda r: [[r, 0], [0, 1]], **common)
counted = psf.StateSpaceModel(observation_dist=counts, **common)
for system in (gaussian, counted):
    print(system.fingerprint)
    machine = compile_system(system)
    print(machine.propagate.key, machine.log_density.key)
print(psf.EKF().compile_gradient(compile_system(gaussian)).key)
print(psf.EnKF(100).compile(compile_system(gaussian)).key)
print(*sources, sep="\\n")
"""


def test_a_second_process_writes_the_same_text():
    texts = set()
    for seed in ("1", "2024"):
        environment = os.environ | {"PYTHONHASHSEED": seed}
        result = subprocess.run(
            [sys.executable, "-c", PRINT_IDENTITY],
            env=environment,
            capture_output=True,
            timeout=LIMIT,
            text=True,
        )
        assert result.returncode == 0, result.stderr
        assert "None" not in result.stdout.splitlines()[:6]  # every key exists
        texts.add(result.stdout)
    assert len(texts) == 1


def test_a_statement_is_written_once():
    arena = Arena()
    x = arena.input("x.0")
    square = arena.apply(ps.mul, x, x)
    writer = Writer({"x.0": "x[0]"})
    assert writer.statements([arena.apply(ps.add, square, 1.0)]) == [
        "v0 = x[0]", "v1 = v0 * v0", "v2 = v1 + 1.0",
    ]  # fmt: skip
    assert writer.statements([square]) == []
    assert writer.name(square) == "v1"


def test_negative_and_infinite_constants_are_valid_source():
    arena = Arena()
    x = arena.input("x.0")
    writer = Writer({"x.0": "x[0]"})
    lower = arena.apply(ps.sub, x, -2.0)
    line = writer.statements(
        [arena.apply(ps.switch, arena.apply(ps.isnan, x), -float("inf"), lower)]
    )
    assert line[-1].endswith("((-inf) if v1 else v2)")
    assert "v0 - (-2.0)" in line[2]
    assert writer.as_float(float("nan")) == "nan"
    assert writer.as_float(3) == "3.0"


def test_a_deep_expression_is_written_without_recursion():
    arena = Arena()
    value = arena.input("x.0")
    for _ in range(5000):
        value = arena.apply(ps.sin, value)
    assert len(Writer({"x.0": "x[0]"}).statements([value])) == 5001


def test_what_depends_on_a_member_is_found():
    arena = Arena()
    x, c = arena.input("x.0"), arena.input("theta.0")
    shared = arena.apply(ps.exp, c)
    value = arena.apply(ps.mul, shared, x)
    assert depends_on([value], frozenset({"x.0"})) == {x, value}
