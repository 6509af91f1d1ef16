"""One state that decays, seen with noise: the likelihood by the EKF is exact."""

import numpy as np

import pymc_statespace_filters as psf


def decay(x, q, phi):
    return [phi * x[0] + q[0]]


def level(x):
    return [x[0]]


def spread_squared(spread):
    return [[spread**2]]


def autoregression(**changes):
    """The system; by default with the parameters phi and spread."""
    settings = {
        "transition": decay,
        "observation": level,
        "process_noise": spread_squared,
        "observation_noise": [[0.4]],
        "initial_mean": [0.0],
        "initial_cov": [[1.0]],
    }
    return psf.StateSpaceModel(**settings | changes)


def simulated(steps, random_seed, phi, spread, observation_noise=0.4):
    """A record (J,), by NumPy: importing a test file must not compile anything."""
    rng = np.random.default_rng(random_seed)
    x, observed = rng.standard_normal(), []
    for k in range(steps[-1] + 1):
        if k in steps:
            observed.append(x + np.sqrt(observation_noise) * rng.standard_normal())
        x = phi * x + spread * rng.standard_normal()
    return np.array(observed)
