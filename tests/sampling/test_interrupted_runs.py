"""Ctrl-C at random moments, often more than once in a run: it returns what is there."""

import signal
import sys
import threading

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice import filter_check, missed
from pymc_statespace_filters.parallel.signals import interrupts_are_noted
from tests.systems import PAIR, PAIR_DATA, STEPS

pytestmark = pytest.mark.usefixtures("interrupts_arrive", "interpreted")

N_INTERRUPTS = 100
TOOL, EVENTS = sys.monitoring.PROFILER_ID, sys.monitoring.events


class Moments:
    """Interrupts this process where a Python function begins, which is where signals are handled.

    In the main thread, from when there is something to return. The functions are counted, so that
    no moment is one of time.
    """

    def __init__(self, rng, mean_gap):
        self.n_sent, self._is_begun = 0, False
        self._rng, self._gap, self._thread = rng, mean_gap, threading.get_ident()
        self._wait = rng.integers(2 * mean_gap)

    def __enter__(self):
        sys.monitoring.use_tool_id(TOOL, "moments")
        sys.monitoring.register_callback(TOOL, EVENTS.PY_START, self._start)
        sys.monitoring.register_callback(TOOL, EVENTS.PY_RETURN, self._return)
        sys.monitoring.set_events(TOOL, EVENTS.PY_START | EVENTS.PY_RETURN)
        return self

    def __exit__(self, *_):
        sys.monitoring.free_tool_id(TOOL)

    def _return(self, code, *_):
        self._is_begun |= code is interrupts_are_noted.__code__
        if code is not interrupts_are_noted.__code__:
            return sys.monitoring.DISABLE
        sys.monitoring.set_events(TOOL, EVENTS.PY_START)
        return None

    def _start(self, *_):
        if not self._is_begun or threading.get_ident() != self._thread:
            return
        self._wait -= 1
        if self._wait < 0:
            self.n_sent += 1
            self._wait = self._rng.integers(2 * self._gap)
            signal.raise_signal(signal.SIGINT)


def conjugate():
    with pm.Model() as model:
        pm.Normal("y", pm.Normal("mu"), 1.0, observed=[1.0, 2.0])
    return model


def rows():
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.2)
        psf.StateSpace("d", PAIR, psf.EKF(), steps=STEPS, observed=PAIR_DATA)
    return model


def nothing():
    pass


def long_check(found):
    """Stands for a check at the end, of which short runs have none."""

    def check(*_):
        for _ in range(20_000):
            nothing()
        return found

    return check


@pytest.fixture
def calls(monkeypatch):
    monkeypatch.setattr(missed, "_missed_parts", long_check([]))
    monkeypatch.setattr(filter_check, "_check", long_check(filter_check.FilterCheck()))
    both, record = {"one": conjugate(), "two": conjugate()}, rows()
    same = {"random_seed": 1, "progressbar": False}
    few = {"draws": 8, "tune": 0, "chains": 2, "cores": 1} | same
    by_nuts = few | {"tune": 4, "initvals": {"mu": 0.0}, "sampler": "nuts"}
    particles = {"draws": 8, "populations": 2} | same
    return {
        "sample_dram": lambda: psf.sample_dram(model=both["one"], **few),
        "sample": lambda: psf.sample(model=both["one"], **by_nuts),
        "tempered": lambda: psf.sample_smc(model=both["one"], **particles),
        "sequential": lambda: psf.sample_smc(model=record, data="sequential", **particles),
        "run_models": lambda: psf.run_models(both, sampler="dram", **few),
        "run_models, particles": lambda: psf.run_models(both, sampler="smc", **particles),
    }


def test_a_hundred_interrupts_return_what_is_there(calls, monkeypatch):
    """Or say that there was no draw; what comes after them is as ever."""
    monkeypatch.setattr(sys, "unraisablehook", lambda *_: None)  # what callbacks of Python lose
    rng, n_sent, gap = np.random.default_rng(5), 0, 60_000
    while n_sent < N_INTERRUPTS:
        for name, call in calls.items():
            found, said = {}, "before there was a draw to return"
            with Moments(rng, gap) as moments:
                try:
                    found = call()
                except KeyboardInterrupt as error:
                    said = str(error)
                finally:
                    sys.monitoring.set_events(TOOL, 0)
            assert "before there was a draw to return" in said, name
            n_sent += moments.n_sent
            for tree in found.values() if isinstance(found, dict) else [found]:
                assert tree["posterior"].sizes["draw"] >= 1
            assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        gap //= 3
