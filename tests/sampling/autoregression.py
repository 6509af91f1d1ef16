"""One state that decays, seen with noise: the likelihood by the EKF is exact."""

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
