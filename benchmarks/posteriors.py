"""Posteriors on which starts and samplers are measured, most of them narrow compared to the prior.

Double well, mass-spring-damper and sunspots are those of the other benchmarks and of the guide. The
oscillators are seen precisely, so that a draw from their prior lies hundreds of standard deviations
of the posterior away, in a landscape with many ridges.
"""

from collections.abc import Callable

import numpy as np
import pymc as pm

import pymc_statespace_filters as psf
from benchmarks.sampling import double_well_model
from benchmarks.systems import MASS_SPRING_DAMPER, MASS_SPRING_DAMPER_TRUTH, simulated

N_SAMPLES, OSCILLATOR_DT = 600, 0.05


def mass_spring_damper(filter=None) -> pm.Model:
    """Nine parameters, 101 observations, by EKF unless a filter is given."""
    inputs, observed = simulated(MASS_SPRING_DAMPER, MASS_SPRING_DAMPER_TRUTH)
    with pm.Model() as model:
        for name, sd in {"c": 1, "c3": 1, "sigma": 1, "gamma": 0.1}.items():
            pm.HalfNormal(name, sd)
        for name, sd in {"k": 10, "k2": 5, "k3": 5, "gain": 3, "x0": 1}.items():
            pm.Normal(name, 0, sd)
        psf.StateSpace(
            "d", MASS_SPRING_DAMPER, filter or psf.EKF(), steps=np.arange(0, 2001, 20),
            inputs=inputs, observed=observed,
        )  # fmt: skip
    return model


def oscillator(x, u, c, k, k3=0.0, c3=0.0, gain=1.0):
    position, velocity = x
    force = gain * u[0] - c * velocity - c3 * velocity**3 - k * position - k3 * position**3
    return [velocity, force]


def coupled(x, u, c, k, c2, k2, gain=1.0, k3=0.0, mass2=1.0):
    first, second, v1, v2 = x
    between = k2 * (second - first) + c2 * (v2 - v1)
    pull = gain * u[0] - k * first - k3 * first**3 - c * v1 + between
    return [v1, v2, pull, -between / mass2]


def driven(truth: dict[str, float], drift: Callable, n_states: int, seed: int, sensor=0.01):
    """A record of a driven oscillator, 600 samples at .05 s, and the system."""
    half = n_states // 2
    noise = np.zeros((n_states, 1))
    noise[half] = 1.0

    def start(x0=0.0):
        return [x0, *[0.0] * (n_states - 1)]

    system = psf.StateSpaceModel(
        transition=psf.EulerMaruyama(drift, lambda sigma: sigma * noise, dt=OSCILLATOR_DT),
        observation=lambda x: [x[0]],
        observation_noise=lambda sensor=sensor: [[sensor**2]],
        initial_mean=start,
        initial_cov=1e-4 * np.eye(n_states),
        inputs=["force"],
    )
    t = np.arange(N_SAMPLES + 1) * OSCILLATOR_DT
    force = np.sin(1.3 * t + 0.02 * t**2)[:, None]
    made = psf.simulate(
        system, truth, steps=np.arange(N_SAMPLES + 1), inputs=force, random_seed=seed
    )
    return system, force, made["observations"].values


def narrow(truth: dict[str, float], drift: Callable = oscillator, n_states=2, seed=1) -> pm.Model:
    """The posterior of all parameters of a driven oscillator that is seen precisely.

    Priors are lognormal within a factor of three for what is positive, and normal for the rest.
    """
    system, force, observed = driven(truth, drift, n_states, seed)
    with pm.Model() as model:
        for name in truth:
            if name in ("k3", "c3", "x0"):
                pm.Normal(name, 0.0, 2.0 if name != "x0" else 0.5)
            else:
                centre = {"sigma": 0.1, "sensor": 0.02, "c": 0.3, "c2": 0.3}.get(name, 2.0)
                pm.LogNormal(name, np.log(centre), 1.0)
        psf.StateSpace(
            "d", system, psf.EKF(), steps=np.arange(N_SAMPLES + 1), inputs=force,
            observed=observed,
        )  # fmt: skip
    return model


def two_modes() -> pm.Model:
    """A double well in which the sign of the observed state is lost: the mean has two signs."""
    system = psf.StateSpaceModel(
        transition=lambda x, q, a, mean: [mean + a * (x[0] - mean) + q[0]],
        process_noise=lambda sigma: [[sigma**2]],
        observation=lambda x: [x[0] ** 2],
        observation_noise=[[0.05]],
        initial_mean=lambda mean: [mean],
        initial_cov=[[0.1]],
    )
    truth = {"a": 0.9, "mean": 1.5, "sigma": 0.1}
    steps = np.arange(200)
    made = psf.simulate(system, truth, steps=steps, random_seed=4)
    with pm.Model() as model:
        pm.Uniform("a", 0, 1)
        pm.Normal("mean", 0, 3)
        pm.HalfNormal("sigma", 1)
        psf.StateSpace("d", system, psf.EKF(), steps=steps, observed=made["observations"].values)
    return model


LINEAR = {"c": 0.2, "k": 3.0, "sigma": 0.05, "sensor": 0.01}
HARDENING = LINEAR | {"k3": 1.5, "gain": 1.2, "x0": 0.2}
COUPLED = {"c": 0.2, "k": 3.0, "c2": 0.1, "k2": 2.0, "gain": 1.2, "sigma": 0.05, "sensor": 0.01}

POSTERIORS: dict[str, Callable[[], pm.Model]] = {
    "double well, EKF": lambda: double_well_model(psf.EKF()),
    "double well, GridFilter": lambda: double_well_model(psf.GridFilter()),
    "double well, BootstrapPF(250)": lambda: double_well_model(psf.BootstrapPF(250)),
    "mass-spring-damper, 9": mass_spring_damper,
    "oscillator, 4": lambda: narrow(LINEAR),
    "oscillator, 7": lambda: narrow(HARDENING),
    "oscillator, 8": lambda: narrow(HARDENING | {"c3": 0.3}, seed=2),
    "two masses, 7": lambda: narrow(COUPLED, coupled, 4, seed=3),
    "two masses, 10": lambda: narrow(
        COUPLED | {"k3": 1.0, "x0": 0.2, "mass2": 1.3}, coupled, 4, seed=3
    ),
    "two signs, 3": two_modes,
}
