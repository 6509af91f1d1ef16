"""DAPPER: its ensemble Kalman filter with perturbed observations.

The loop is that of its class ``EnKF`` without the statistics, which cost more than the filter. We
add the likelihood, which it does not compute: the mean of the densities given the members.
"""

import numpy as np

from benchmarks.peers.serve import record, serve

from dapper.da_methods.ensemble import EnKF_analysis, add_noise  # isort: skip
from dapper.tools.randvars import GaussRV
from dapper.tools.seeding import set_seed

DT = 0.01
(ALPHA, BETA, SIGMA, GAMMA), STEPS, _, OBSERVED = record("double_well")


def enkf(n_members):
    start = GaussRV(mu=[1.0], C=[0.5])
    process, sensor = GaussRV(C=[0.36 + SIGMA**2], M=1), GaussRV(C=[GAMMA], M=1)

    def value(seed):
        set_seed(3000 + seed)
        E, total, k = start.sample(n_members), 0.0, 0
        for step, d in zip(STEPS, OBSERVED, strict=True):
            while k < step:
                E = E + DT * (ALPHA * E + BETA * E**3)
                E = add_noise(E, DT, process, "Stoch")
                k += 1
            r = d - E[:, 0]
            total += np.log(np.exp(-0.5 * r * r / GAMMA).mean() / np.sqrt(2.0 * np.pi * GAMMA))
            E = EnKF_analysis(E, E, sensor, d, "PertObs")
        return total

    return lambda: value


serve({"double_well/enkf/1250": enkf(1250)}, "dapper", "numpy")
