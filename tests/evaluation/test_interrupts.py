"""Ctrl-C while machine code runs: a KeyboardInterrupt, at once, and nothing else."""

import os
import signal
import time

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.compile.ops import wrap_py

import pymc_statespace_filters as psf
from pymc_statespace_filters.pymc_model.density import ModelDensity
from tests.interrupts import repeat_until_interrupted
from tests.systems import FREE
from tests.waiting import LIMIT, python

pytestmark = pytest.mark.usefixtures("interrupts_arrive")

STEPS = np.arange(1, 301)
DATA = np.sin(STEPS)
LOST = "ignore::pytest.PytestUnraisableExceptionWarning"
MOMENTS = np.linspace(0.005, 0.05, 12)
MOST_LOST = 1  # Python loses about one in a thousand; two of twelve would be a fault of ours


def batch():
    psf.log_likelihood(FREE, psf.EKF(), {"a": np.linspace(0.1, 0.9, 64)}, DATA, steps=STEPS)


def particles():
    psf.log_likelihood(FREE, psf.BootstrapPF(100), {"a": 0.5}, DATA, steps=STEPS)


def run():
    psf.run_filter(FREE, psf.BootstrapPF(100), {"a": 0.5}, DATA, steps=STEPS)


def path():
    psf.simulate(FREE, {"a": 0.5}, steps=[90_000], random_seed=1)


@pytest.mark.filterwarnings(LOST)
@pytest.mark.parametrize("call", [batch, particles, run, path])
def test_an_interrupt_at_any_moment(call):
    """Numba makes the arrays of a result by calls of Python, where a SystemError came of it."""
    call()
    sent = [repeat_until_interrupted(call, moment) for moment in MOMENTS]
    assert sum(sent) <= len(sent) + MOST_LOST


@pytest.mark.filterwarnings("ignore:Numba will use object mode", LOST)
@pytest.mark.parametrize("mode", ["NUMBA", "FAST_COMPILE"])
def test_an_interrupt_of_python_in_machine_code(mode):
    """It was lost in the function that machine code calls, and its value was minus infinity."""

    @wrap_py([pt.dscalar], [pt.dscalar])
    def slow(mu):
        return np.asarray(-float(sum(range(2000))) * mu**2)

    with pm.Model() as model:
        pm.Potential("slow", slow(pm.Normal("mu")))
    with pytensor.config.change_flags(mode=mode):
        density = ModelDensity(model)

    def call():
        assert np.isfinite(density.evaluate(np.zeros((1, 1)))).all()

    sent = [repeat_until_interrupted(call, moment) for moment in MOMENTS]
    assert sum(sent) <= len(sent) + MOST_LOST


LONG = """
import signal, threading, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have had it ignored
import numpy as np
import pymc_statespace_filters as psf
from tests.systems import FREE

def batch(n, last):
    psf.log_likelihood(FREE, psf.EKF(), {"a": np.full(n, 0.5)}, [0.1], steps=[last])

def particles(last):
    psf.log_likelihood(FREE, psf.BootstrapPF(1000), {"a": 0.5}, [0.1], steps=[last])

def until_interrupted(call):
    print("go", flush=True)
    try:
        call()
    except KeyboardInterrupt:
        print("interrupted", flush=True)

particles(10)
batch(2, 10)
until_interrupted(lambda: particles(10**9))
until_interrupted(lambda: batch(1000, 10**8))
until_interrupted(lambda: particles(10**9))
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_a_long_call_ends_at_once_and_so_does_the_process():
    """Alone each call would take an hour."""
    with python("-c", LONG) as child:
        for _ in range(3):
            assert child.stdout.readline() == "go\n"
            time.sleep(0.4)  # most likely until its machine code runs
            child.send_signal(signal.SIGINT)
            assert child.stdout.readline() == "interrupted\n"
        assert child.wait(LIMIT) == 0
