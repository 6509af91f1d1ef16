"""Noise and time of the guided and the bootstrap particle filter, on five records.

Numbers are of the log-likelihood at fixed parameters, in nats: its mean over seeds minus the exact
one, its standard deviation, the mean of the likelihood over the exact one with its standard error,
and CPU milliseconds of an evaluation. Exact is a point-mass filter; for the oscillator, which has
two states, the log of the mean likelihood of a guided filter with many particles. Run it with
``python -m benchmarks.guided`` from the root of the repository; it takes five minutes.
"""

import time
import warnings
from typing import Any, NamedTuple

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy.special import logsumexp

import pymc_statespace_filters as psf
from benchmarks.systems import DOUBLE_WELL, DOUBLE_WELL_TRUTH
from tests.references.records import (
    DOUBLE_WELL as WELL,
)
from tests.references.records import (
    PRECISE_DOUBLE_WELL,
    double_well,
    double_well_with_surprises,
)
from tests.systems import DOUBLE_WELL_SYSTEM, double_well_parameters

N_SEEDS = 200
FILTERS = psf.BootstrapPF(1000), psf.GuidedPF(100), psf.GuidedPF(1000)
COUNTS = (psf.BootstrapPF(5529), psf.GuidedPF(128))  # the first costs about what the second does


class Case(NamedTuple):
    """A record of a system at fixed parameters."""

    name: str
    system: psf.StateSpaceModel
    given: dict[str, float]
    observed: Any
    steps: Any

    def log_likelihoods(self, filter, seeds) -> np.ndarray:
        """Return the log-likelihood for every seed."""
        record = {"observed": self.observed, "steps": self.steps}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", psf.errors.FilterWarning)
            terms = psf.log_likelihood(self.system, filter, self.given, **record, seed=seeds)
        return terms.sum(axis=-1)

    def exact(self) -> float:
        """Return the exact log-likelihood."""
        if self.system.n == 1:
            return float(self.log_likelihoods(psf.GridFilter(), 0))
        many = self.log_likelihoods(psf.GuidedPF(20_000), np.arange(50))
        return float(logsumexp(many) - np.log(50))


def sparse() -> Case:
    """The double well with an observation a second: the state crosses between two of them."""
    steps = np.arange(0, 2001, 100)
    made = psf.simulate(DOUBLE_WELL, DOUBLE_WELL_TRUTH, steps=steps, random_seed=20)
    values = made["observations"].values
    return Case("double well, sparse", DOUBLE_WELL, DOUBLE_WELL_TRUTH, values, steps)


def duffing(x, t):
    position, velocity = x
    return [velocity, -0.2 * velocity + position - position**3 + 0.3 * pt.cos(1.2 * t)]


DUFFING = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(duffing, [[0.0], [0.2]], dt=0.02),
    observation=lambda x: [x[0]],
    observation_noise=[[0.01]],
    initial_mean=[1.0, 0.0],
    initial_cov=np.diag([0.1, 0.1]),
)


def knocked_oscillator() -> Case:
    """A Duffing oscillator whose velocity is knocked three times, which the model does not know."""
    rng, x, steps, seen = np.random.default_rng(5), np.array([1.0, 0.0]), [], []
    for k in range(2500):
        force = -0.2 * x[1] + x[0] - x[0] ** 3 + 0.3 * np.cos(1.2 * 0.02 * k)
        x = x + 0.02 * np.array([x[1], force]) + [0.0, 0.2 * np.sqrt(0.02) * rng.normal()]
        x[1] += 1.5 * (k in (600, 1210, 1900))
        if (k + 1) % 25 == 0:
            steps.append(k + 1)
            seen.append(x[0] + 0.1 * rng.normal())
    return Case("Duffing oscillator with knocks", DUFFING, {}, np.array(seen), np.array(steps))


SPIKES = psf.StateSpaceModel(
    transition=lambda x, q: [0.99 * x[0] + q[0]],
    process_noise=[[0.11]],
    observation_dist=lambda x: [pm.Binomial.dist(50, pm.math.sigmoid(x[0]))],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)


def spikes() -> Case:
    """Three thousand counts, most of them small."""
    rng, x, seen = np.random.default_rng(1), -2.5, []
    for _ in range(3000):
        seen.append(rng.binomial(50, 1.0 / (1.0 + np.exp(-x))))
        x = 0.99 * (x + 2.5) - 2.5 + np.sqrt(0.11) * rng.normal()
    return Case("counts", SPIKES, {}, np.array(seen, dtype=float), np.arange(3000))


def main() -> None:
    well = Case(
        "double well", DOUBLE_WELL_SYSTEM, double_well_parameters(WELL), *reversed(double_well())
    )
    precise = double_well_parameters(PRECISE_DOUBLE_WELL)
    surprises = Case(
        "surprises", DOUBLE_WELL_SYSTEM, precise, *reversed(double_well_with_surprises())
    )
    print("case | filter | mean - exact | sd | mean of L / exact | ms | sd^2 ms")
    for case in (well, sparse(), surprises, knocked_oscillator(), spikes()):
        exact = case.exact()
        for filter in COUNTS if case.name == "counts" else FILTERS:
            case.log_likelihoods(filter, np.arange(2))
            start = time.process_time()
            error = case.log_likelihoods(filter, np.arange(N_SEEDS)) - exact
            ms = 1e3 * (time.process_time() - start) / N_SEEDS
            ratio, sd = np.exp(error), error.std(ddof=1)
            print(
                f"{case.name} | {filter} | {error.mean():.2f} | {sd:.2f} | {ratio.mean():.3f} +- "
                f"{ratio.std() / np.sqrt(N_SEEDS):.3f} | {ms:.1f} | {sd**2 * ms:.3g}",
                flush=True,
            )


if __name__ == "__main__":
    main()
