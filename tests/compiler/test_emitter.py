"""The text of generated modules is canonical: it is the key of machine code on disk."""

import io
import os
import subprocess
import sys
from contextlib import redirect_stdout
from ctypes import CFUNCTYPE, c_void_p

import numpy as np
import pytensor.scalar as ps
import pytest

from pymc_statespace_filters.compiler.codegen.emitter import depends_on
from pymc_statespace_filters.compiler.codegen.expressions import Arena
from pymc_statespace_filters.compiler.codegen.functions import vector_code
from pymc_statespace_filters.compiler.codegen.machine_code import Module, ModuleEntryPoint
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, EntryPoint
from tests.waiting import LIMIT

PRINT_IDENTITY = """
import pymc as pm
import pytensor.tensor as pt
import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen.machine_code import Module, ModuleEntryPoint
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint
from pymc_statespace_filters.ops.base import kernel
from pymc_statespace_filters.ops.likelihood import LogLikelihood, LogLikelihoodGradient

EntryPoint.compile = lambda entry: None  # the text is asked for, not the code
ModuleEntryPoint.compile = lambda entry: None
sources = []
finished = Module.finished
def noted(module):
    code = finished(module)
    sources.extend([code.text, *code.inlined, *(entry.symbol for entry in code.needs)])
    return code
Module.finished = noted

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
print(kernel(LogLikelihoodGradient(gaussian, psf.EKF())).key)
print(kernel(LogLikelihood(gaussian, psf.EnKF(100))).key)
print(*sources, sep="\\n")
"""


CALLED_BY_SYMBOL = """
import numpy as np, pytensor.tensor as pt, pymc_statespace_filters as psf
system = psf.StateSpaceModel(
    transition=lambda x, q, a: [a * pt.erf(x[0]) + q[0]], process_noise=[[0.3]],
    observation=lambda x: [x[0]], observation_noise=[[0.4]],
    initial_mean=[1.0], initial_cov=[[0.1]],
)
record = {"a": 1.0}, np.zeros((3, 1))
for filter in (psf.EKF(), psf.BootstrapPF(20)):
    print(psf.log_likelihood(system, filter, *record, steps=[0, 1, 2]).tolist())
"""


@pytest.fixture(scope="module")
def here_and_second():
    """What `CALLED_BY_SYMBOL` prints here, and then, before the other script, elsewhere.

    There strings have other hashes.
    """
    here = io.StringIO()
    with redirect_stdout(here):
        exec(CALLED_BY_SYMBOL, {})
    second = subprocess.run(
        [sys.executable, "-c", CALLED_BY_SYMBOL + PRINT_IDENTITY],
        env=os.environ | {"PYTHONHASHSEED": "2024"},
        capture_output=True,
        timeout=LIMIT,
        text=True,
    )
    assert second.returncode == 0, second.stderr
    return here.getvalue(), second.stdout


def test_a_second_process_writes_the_same_text(here_and_second, monkeypatch):
    here, second = here_and_second
    for owner in (EntryPoint, ModuleEntryPoint):  # of which the script replaces methods
        monkeypatch.setattr(owner, "compile", owner.compile)
    monkeypatch.setattr(Module, "finished", Module.finished)
    with redirect_stdout(io.StringIO()) as first:
        exec(PRINT_IDENTITY, {})
    first = first.getvalue()
    assert "None" not in first.splitlines()[:6]  # every key exists
    assert second.removeprefix(here) == first


def test_machine_code_from_disk_finds_what_it_calls_by_symbol(here_and_second):
    """In a second process no code is generated, so nothing asks for the function by itself."""
    here, second = here_and_second
    assert second.startswith(here)
    assert len(here.splitlines()) == 2


def operations(*values):
    """The instructions that compute these values of x, and nothing else."""
    code, used = vector_code(values)
    lines = code.text.partition("define")[2].splitlines()
    made = [line.partition(" = ")[2] for line in lines if " = " in line]
    return used, [line for line in made if not line.startswith("getelementptr")]


def test_an_instruction_is_emitted_once():
    arena = Arena()
    x = arena.input("x.0")
    square = arena.apply(ps.mul, x, x)
    used, made = operations(arena.apply(ps.add, square, 1.0), square)
    assert used == ["x.0"]
    assert [line.split()[0] for line in made] == ["load", "fmul", "fadd"]


def test_negative_infinite_and_whole_constants():
    arena = Arena()
    x = arena.input("x.0")
    lower = arena.apply(ps.sub, x, -2.5)
    value = arena.apply(ps.switch, arena.apply(ps.isnan, x), -float("inf"), lower)
    code, _ = vector_code([value, float("nan"), 3])
    entry, out = ModuleEntryPoint(code, {"given": F64_PTR, "out": F64_PTR}, "f"), np.empty(3)
    entry.compile()
    call = CFUNCTYPE(None, c_void_p, c_void_p)(entry.address)
    for given, expected in ((0.5, 3.0), (np.nan, -np.inf)):
        at = np.array([given])
        call(at.ctypes.data, out.ctypes.data)
        np.testing.assert_array_equal(out, [expected, np.nan, 3.0])


def test_the_same_code_is_kept_under_each_of_its_names():
    """As what does nothing is, of a system that stays where it is."""
    code, _ = vector_code([7.0])
    out = np.zeros(1)
    for name in ("one", "another"):
        entry = ModuleEntryPoint(code, {"given": F64_PTR, "out": F64_PTR}, name)
        entry.compile()
        assert entry.address
        CFUNCTYPE(None, c_void_p, c_void_p)(entry.address)(out.ctypes.data, out.ctypes.data)
        assert out[0] == 7.0


def test_a_deep_expression_is_emitted_without_recursion():
    arena = Arena()
    value = arena.input("x.0")
    for _ in range(5000):
        value = arena.apply(ps.sin, value)
    _, made = operations(value)
    assert len(made) == 5001


def test_what_depends_on_a_member_is_found():
    arena = Arena()
    x, c = arena.input("x.0"), arena.input("theta.0")
    shared = arena.apply(ps.exp, c)
    value = arena.apply(ps.mul, shared, x)
    assert depends_on([value], frozenset({"x.0"})) == {x, value}
