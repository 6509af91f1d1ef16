"""The twelve records of `by_system`, with the parameters that made them."""

import runpy
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytensor.tensor as pt

import pymc_statespace_filters as psf
from benchmarks.gaussian_bias import walk
from benchmarks.guided import sparse, spikes
from benchmarks.measure import ROOT
from benchmarks.systems import LINEAR, LINEAR_TRUTH, STEPS
from tests.references.records import (
    DOUBLE_WELL,
    PRECISE_DOUBLE_WELL,
    double_well,
    double_well_with_surprises,
)
from tests.systems import DOUBLE_WELL_SYSTEM, double_well_parameters

MANY, MANY_GUIDED = psf.BootstrapPF(20_000), psf.GuidedPF(5000)
GRID = psf.GridFilter()


@dataclass(frozen=True)
class Case:
    """A record of a system at fixed parameters.

    `truth` is the filter that computes the exact log-likelihood, `grid` the point-mass filter that
    is compared with the others.
    """

    name: str
    system: psf.StateSpaceModel
    given: dict[str, float]
    observed: Any
    steps: Any
    truth: Any = MANY
    inputs: Any = None
    grid: psf.GridFilter = GRID


def simulated(name, system, given, steps, truth=MANY, **settings) -> Case:
    """Return a case whose record is simulated by the system itself."""
    made = psf.simulate(system, given, steps=steps, random_seed=1)
    return Case(name, system, given, made["observations"].values, steps, truth, **settings)


def known_well(name, reference, record) -> Case:
    """Return a double well of the tests."""
    given = double_well_parameters(reference)
    return Case(name, DOUBLE_WELL_SYSTEM, given, record.observed, record.steps, GRID)


DUFFING = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(
        lambda x, t: [x[1], -0.2 * x[1] + x[0] - x[0] ** 3 + 0.3 * pt.cos(1.2 * t)],
        [[0.0], [0.2]],
        dt=0.02,
    ),
    observation=lambda x: [x[0]],
    observation_noise=[[0.01**2]],
    initial_mean=[1.0, 0.0],
    initial_cov=np.diag([0.1, 0.1]),
)


# Logarithms of prey and predators. A cycle lasts six units of time, fifteen observations.
LOTKA_VOLTERRA = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(
        lambda x: [1.0 - pt.exp(x[1]), pt.exp(x[0]) - 1.0], 0.15 * np.eye(2), dt=0.02
    ),
    observation=lambda x: [x[0], x[1]],
    observation_noise=0.2**2 * np.eye(2),
    initial_mean=[0.7, 0.0],
    initial_cov=0.1 * np.eye(2),
)


LORENZ_63 = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(
        lambda x: [
            10.0 * (x[1] - x[0]),
            x[0] * (28.0 - x[2]) - x[1],
            x[0] * x[1] - 8.0 / 3.0 * x[2],
        ],
        np.eye(3),
        dt=0.01,
    ),
    observation=lambda x: [x[0]],
    observation_noise=[[1.0]],
    initial_mean=[1.0, 1.0, 20.0],
    initial_cov=np.eye(3),
)


# The kink of the sensor keeps the trapezoidal rule from the default tolerance.
COARSE = psf.GridFilter(tolerance=1e-4)
SIGN_LOST = walk(observation=lambda x, c: [c * abs(x[0])], observation_noise=[[0.04]])


def lorenz_96(x):
    return (pt.roll(x, -1) - pt.roll(x, 2)) * pt.roll(x, 1) - x + 8.0


N_PLACES = 40
LORENZ_96 = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(lorenz_96, 0.5 * np.eye(N_PLACES), dt=0.01),
    observation=lambda x: x,
    observation_noise=np.eye(N_PLACES),
    initial_mean=8.0 + np.sin(np.arange(N_PLACES)),
    initial_cov=np.eye(N_PLACES),
)


def thesis_oscillator(name: str, case: str) -> Case:
    """Return the mass-spring-damper of a study in examples/thesis, with noise of 0.05."""
    study = runpy.run_path(str(ROOT / "examples/thesis/oscillator.py"))
    record = study["CASES"][case]
    return Case(
        name,
        study["oscillator"](memory=record.memory),
        study["TRUTH"] | {"sigma": 0.05} | record.known,
        record.record()["observations"].values,
        record.steps,
        inputs=record.inputs,
    )


def of_guided(name: str, case) -> Case:
    """Return a record of one state from the benchmark of the guided filter."""
    return Case(name, case.system, case.given, case.observed, case.steps, GRID)


def cases() -> list[Case]:
    """Return the records in the order of the table."""
    every_20 = np.arange(20, 2001, 20)
    sensor = {"a": 0.5, "c": 1.0}
    return [
        simulated("linear oscillator", LINEAR, LINEAR_TRUTH, STEPS, psf.EKF()),
        simulated("Lotka-Volterra", LOTKA_VOLTERRA, {}, every_20),
        known_well("double well", DOUBLE_WELL, double_well()),
        of_guided("double well, sparse", sparse()),
        known_well("surprises", PRECISE_DOUBLE_WELL, double_well_with_surprises()),
        simulated("Duffing, precise", DUFFING, {}, np.arange(25, 2501, 25), MANY_GUIDED),
        of_guided("counts", spikes()),
        simulated("sign lost", SIGN_LOST, sensor, every_20[:60] // 4, COARSE, grid=COARSE),
        thesis_oscillator("mass-spring-damper", "case 3"),
        thesis_oscillator("the same with a memory", "case 1, memory"),
        simulated("Lorenz 63", LORENZ_63, {}, every_20),
        simulated("Lorenz 96", LORENZ_96, {}, np.arange(5, 251, 5), psf.GuidedPF(1000)),
    ]
