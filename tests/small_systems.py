"""Small linear systems for tests of the machinery: quick to compile, exact by Kalman's formulas."""

import numpy as np

import pymc_statespace_filters as psf
from pymc_statespace_filters.testing import kalman_log_likelihood

STEPS = np.array([0, 2, 3, 6])
# A missing component, and a row wholly missing.
PAIR_DATA = np.array([[0.1, 0.2], [np.nan, 0.3], [np.nan, np.nan], [0.5, -0.1]])
FORCED_DATA = np.array([0.1, -0.4, np.nan, 0.9])
FORCE = np.array([0.5, -0.2, 0.1, 0.3, 0.0, -0.4])


def pair(**changes):
    """Two coupled states, two observables; `b` has the default 0.2."""
    settings = {
        "transition": lambda x, q, a, b=0.2: [a * x[0] + b * x[1] + q[0], 0.8 * x[1] + q[1]],
        "process_noise": [[1.0, 0.0], [0.0, 0.5]],
        "observation": lambda x: [x[0], x[1]],
        "observation_noise": [[0.5, 0.1], [0.1, 0.4]],
        "initial_mean": [0.0, 0.3],
        "initial_cov": [[1.0, 0.0], [0.0, 2.0]],
        "observables": ["position", "speed"],
    }
    return psf.StateSpaceModel(**settings | changes)


def forced(**changes):
    """One state, pushed by an input."""
    settings = {
        "transition": lambda x, q, u, a: [a * x[0] + u[0] + q[0]],
        "process_noise": [[1.0]],
        "observation": lambda x: [x[0]],
        "observation_noise": [[0.5]],
        "initial_mean": [0.0],
        "initial_cov": [[1.0]],
        "inputs": ["force"],
    }
    return psf.StateSpaceModel(**settings | changes)


PAIR = pair()
FORCED = forced()
FREE = forced(transition=lambda x, q, a: [a * x[0] + q[0]], inputs=())


def pair_terms(a, b=0.2, observed=PAIR_DATA, steps=STEPS):
    """The exact terms log p(d_j | d_1 .. d_{j-1}) of PAIR."""
    return kalman_log_likelihood(
        np.array([[a, b], [0.0, 0.8]]),
        np.diag([1.0, 0.5]),
        np.eye(2),
        np.array([[0.5, 0.1], [0.1, 0.4]]),
        np.array([0.0, 0.3]),
        np.diag([1.0, 2.0]),
        observed=observed,
        steps=steps,
    )


def forced_terms(
    a, observed=FORCED_DATA, steps=STEPS, force=FORCE, observation_noise=0.5, initial_cov=1.0
):
    """The exact terms of FORCED, or of one with other constants."""
    return kalman_log_likelihood(
        [[a]],
        [[1.0]],
        [[1.0]],
        [[observation_noise]],
        [0.0],
        [[initial_cov]],
        observed=observed,
        steps=steps,
        forcing=np.reshape(force, (-1, 1)),
    )
