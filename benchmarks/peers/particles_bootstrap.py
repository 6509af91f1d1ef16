"""particles: its bootstrap filter, with a Feynman-Kac model written for this system.

A move takes all 20 steps between two observations on whole arrays. This is faster than its classes
of state-space models, in which every step is a time step of the filter.
"""

import numpy as np

from benchmarks.peers.serve import record, serve

import particles  # isort: skip

DT = 0.01
(ALPHA, BETA, SIGMA, GAMMA), STEPS, _, OBSERVED = record("double_well")
GAPS = int(np.diff(STEPS)[0])
SCALE = np.sqrt(DT * (0.36 + SIGMA**2))


class DoubleWell(particles.FeynmanKac):
    def __init__(self, seed: int) -> None:
        super().__init__(len(STEPS))
        self.random = np.random.default_rng(seed)

    def M0(self, N):
        return 1.0 + np.sqrt(0.5) * self.random.standard_normal(N)

    def M(self, t, xp):
        x = xp.copy()
        for noise in self.random.standard_normal((GAPS, len(x))):
            x += DT * x * (ALPHA + BETA * x * x) + SCALE * noise
        return x

    def logG(self, t, xp, x):
        r = OBSERVED[t, 0] - x
        return -0.5 * (np.log(2.0 * np.pi * GAMMA) + r * r / GAMMA)


def bootstrap(n_particles):
    def value(seed):
        np.random.seed(seed)  # noqa: NPY002 - its resampling draws from the global generator
        smc = particles.SMC(DoubleWell(seed), N=n_particles, ESSrmin=1 / 3, resampling="systematic")
        smc.run()
        return smc.logLt

    return lambda: value


serve({f"double_well/bootstrap/{n}": bootstrap(n) for n in (1000, 1250)}, "particles", "numpy")
