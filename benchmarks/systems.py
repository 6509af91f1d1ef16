"""The systems and records of all comparisons, written as a user would write them."""

from pathlib import Path

import numpy as np
import pytensor.tensor as pt

import pymc_statespace_filters as psf
from benchmarks import epidemic, lynx_hare

DT = 0.01
STEPS = np.arange(0, 2001, 20)


def drift(x, alpha, beta):
    return [alpha * x[0] + beta * x[0] ** 3]


def diffusion(sigma):
    return [[0.6, sigma]]


DOUBLE_WELL = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(drift, diffusion, dt=DT),
    observation=lambda x: [x[0]],
    observation_noise=lambda gamma: [[gamma]],
    initial_mean=[1.0],
    initial_cov=[[0.5]],
)
DOUBLE_WELL_TRUTH = {"alpha": 4.0, "beta": -4.0, "sigma": 0.1, "gamma": 0.08}


def oscillator(x, u, c, c3, k, k2, k3, gain):
    displacement, velocity = x
    force = gain * u[0] - c * velocity - c3 * velocity**3
    spring = k * displacement + k2 * displacement**2 + k3 * displacement**3
    return [velocity, force - spring]


MASS_SPRING_DAMPER = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(oscillator, lambda sigma: [[0.0], [sigma]], dt=DT),
    observation=lambda x: [x[0]],
    observation_noise=lambda gamma: [[gamma]],
    initial_mean=lambda x0: [x0, 0.0],
    initial_cov=np.diag([0.1, 0.1]),
    inputs=["force"],
)
MASS_SPRING_DAMPER_TRUTH = {
    "c": 0.4,
    "c3": 0.1,
    "k": 4.0,
    "k2": 0.3,
    "k3": 2.0,
    "gain": 1.5,
    "sigma": 0.3,
    "gamma": 0.02,
    "x0": 0.5,
}


def linear_oscillator(x, c, k):
    displacement, velocity = x
    return [velocity, -c * velocity - k * displacement]


LINEAR = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(linear_oscillator, lambda sigma: [[0.0], [sigma]], dt=DT),
    observation=lambda x: [x[0]],
    observation_noise=lambda gamma: [[gamma]],
    initial_mean=[0.5, 0.0],
    initial_cov=np.diag([0.1, 0.1]),
)
LINEAR_TRUTH = {"c": 0.4, "k": 4.0, "sigma": 0.3, "gamma": 0.02}


def ring(n_states: int) -> psf.StateSpaceModel:
    """Return double wells in a ring, each coupled to its neighbours; the first one is observed."""

    def drift(x, alpha, beta, coupling):
        return alpha * x + beta * x**3 + coupling * (pt.roll(x, 1) + pt.roll(x, -1) - 2.0 * x)

    return psf.StateSpaceModel(
        transition=psf.EulerMaruyama(drift, lambda sigma: sigma * pt.eye(n_states), dt=DT),
        observation=lambda x: [x[0]],
        observation_noise=[[0.08]],
        initial_mean=np.ones(n_states),
        initial_cov=0.5 * np.eye(n_states),
    )


RING_TRUTH = {"alpha": 4.0, "beta": -4.0, "coupling": 0.5, "sigma": 0.6}

SYSTEMS = {
    "double_well": (DOUBLE_WELL, DOUBLE_WELL_TRUTH),
    "mass_spring_damper": (MASS_SPRING_DAMPER, MASS_SPRING_DAMPER_TRUTH),
    "linear": (LINEAR, LINEAR_TRUTH),
}


def theta_of(system: psf.StateSpaceModel, truth: dict[str, float]) -> np.ndarray:
    return np.array([truth[name] for name in system.parameters])


def simulated(system, truth, steps=STEPS, seed=1):
    """Return inputs (steps, n_inputs) and observations (J, 1) of one record."""
    u = np.sin(np.arange(steps[-1] + 1) * DT)[:, None] if system.n_inputs else None
    data = psf.simulate(system, truth, steps=steps, inputs=u, random_seed=seed)
    return (np.zeros((0, 0)) if u is None else u), data["observations"].values


def write_records(path: Path) -> None:
    """Write the contenders' input: parameters, steps, inputs, observations of the systems."""
    arrays = {"dt": np.float64(DT), "steps": STEPS}
    for name, (system, truth) in SYSTEMS.items():
        inputs, observed = simulated(system, truth)
        arrays[f"{name}_theta"] = np.array(list(truth.values()))
        arrays[f"{name}_observed"] = observed
        arrays[f"{name}_inputs"] = inputs[:, 0] if inputs.size else np.zeros(STEPS[-1] + 1)
    arrays["lynx_hare_theta"], arrays["lynx_hare_times"] = lynx_hare.AT, lynx_hare.TIMES
    arrays["lynx_hare_observed"] = lynx_hare.LOGS
    arrays["epidemic_theta"] = np.array(list(epidemic.TRUTH.values()))
    arrays["epidemic_steps"], arrays["epidemic_observed"] = epidemic.STEPS, epidemic.record()
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **arrays)
