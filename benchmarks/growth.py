"""Growth of the cost of one likelihood with particles, steps and states."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

import pymc_statespace_filters as psf
from benchmarks import ours
from benchmarks.cpp import OPTIONS, Cpp
from benchmarks.measure import FOLDER
from benchmarks.systems import DOUBLE_WELL, DOUBLE_WELL_TRUTH, RING_TRUTH, ring
from benchmarks.timing import Timed

PARTICLES = (250, 1000, 4000, 8000, 16_000)  # each is a compilation
N_STEPS = (500, 1000, 2000, 4000, 8000, 16_000)
STATES = (1, 2, 4, 8, 16, 40)
RING_STEPS = np.arange(0, 501, 20)
LONGEST = 8.0  # CPU seconds: a curve ends before a call that would take longer
ROUNDS = 3


@dataclass(frozen=True)
class Curve:
    """Return CPU seconds of a call at each size; `ends` says why a curve stops early."""

    against: str
    who: str
    sizes: list[int]
    seconds: list[float]
    ends: str = ""


def curve(against: str, who: str, sizes: Iterable[int], make: Callable[[int], Timed]) -> Curve:
    done, seconds = [], []
    try:
        for size in sizes:
            if len(seconds) > 1 and seconds[-1] ** 2 / seconds[-2] > LONGEST:
                return Curve(against, who, done, seconds, f"more than {LONGEST:.0f} s a call")
            timed = make(size)
            timed.warm_up()
            seconds.append(float(np.median([timed.seconds() for _ in range(ROUNDS)])))
            done.append(size)
    except NotImplementedError as reason:
        return Curve(against, who, done, seconds, str(reason))
    return Curve(against, who, done, seconds)


def with_particles() -> list[Curve]:
    def of(filter):
        return lambda n: ours.of("double_well", filter(n)).value()

    def cpp(n):
        return Cpp(list(OPTIONS)[1], FOLDER, "double_well", "pf_enkf").on_held_noise(n)

    return [
        curve("particles", "EnKF", PARTICLES, of(psf.EnKF)),
        curve("particles", "BootstrapPF", PARTICLES, of(psf.BootstrapPF)),
        curve("particles", "PFEnKF", PARTICLES, of(psf.PFEnKF)),
        curve("particles", "exact PF-EnKF, C++ -O3 -ffast-math", PARTICLES, cpp),
    ]


def with_steps() -> list[Curve]:
    def of(filter):
        def make(n):
            steps = np.arange(0, n + 1, 20)
            return ours.Likelihood(DOUBLE_WELL, filter, DOUBLE_WELL_TRUTH, steps=steps).value()

        return make

    filters = {
        "EKF": psf.EKF(),
        "EnKF(250)": psf.EnKF(250),
        "BootstrapPF(250)": psf.BootstrapPF(250),
        "PFEnKF(250)": psf.PFEnKF(250),
    }
    return [curve("steps", who, N_STEPS, of(filter)) for who, filter in filters.items()]


def with_states() -> list[Curve]:
    """Rings of double wells, 500 steps, 26 observations of one state."""

    def of(filter):
        def make(n):
            return ours.Likelihood(ring(n), filter, RING_TRUTH, steps=RING_STEPS).value()

        return make

    filters = {
        "EKF": psf.EKF(),
        "EnKF(250)": psf.EnKF(250),
        "BootstrapPF(250)": psf.BootstrapPF(250),
    }
    return [curve("states", who, STATES, of(filter)) for who, filter in filters.items()]
