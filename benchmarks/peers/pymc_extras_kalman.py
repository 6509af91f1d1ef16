"""pymc-extras: its Kalman filter on the linear oscillator, compiled by JAX and by numba.

Every step is a time step of the filter, with NaN at the steps without an observation.
"""

import numpy as np

from benchmarks.peers.serve import every_step, record, serve

import pytensor  # isort: skip  # after serve, which sets the options of JAX
import pytensor.tensor as pt
from pymc_extras.statespace.filters import StandardFilter

DT = 0.01
THETA, STEPS, _, OBSERVED = record("linear")


def kalman(theta):
    c, k, sigma, gamma = (theta[i] for i in range(4))
    transition = pt.stack([[1.0, DT], [-DT * k, 1.0 - DT * c]])
    return StandardFilter(cov_jitter=0.0).build_graph(
        pt.as_tensor(every_step(STEPS, OBSERVED)),
        pt.constant(np.array([0.5, 0.0])),
        pt.constant(0.1 * np.eye(2)),
        pt.zeros(2),
        pt.zeros(1),
        transition,
        pt.constant(np.array([[1.0, 0.0]])),
        pt.constant(np.array([[0.0], [1.0]])),
        gamma * pt.eye(1),
        DT * sigma**2 * pt.eye(1),
    )


def compiled(mode):
    def make():
        theta = pt.dvector("theta")
        total = kalman(theta)[-1].sum()
        function = pytensor.function([theta], total, mode=mode, trust_input=True)
        return lambda seed: float(function(THETA))

    return make


serve(
    {"linear/value/jax": compiled("JAX"), "linear/value/numba": compiled("NUMBA")},
    "pymc-extras",
    "pymc",
    "pytensor",
    "jax",
    "numba",
)
