"""How far the Gaussian filters are from the exact log-likelihood, and what one evaluation costs.

Four records: the double well of the README, a Duffing oscillator with noise on the velocity alone,
sixty counts, and an exponential sensor. One state is compared with the point-mass filter, two with
the log of the mean of many bootstrap estimates. Numbers are nats over the record, filter minus
exact. Run it with ``python -m benchmarks.gaussian_bias`` from the root of the repository; it takes
two minutes.
"""

import time

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy.special import logsumexp

import pymc_statespace_filters as psf
from benchmarks.systems import DOUBLE_WELL, DOUBLE_WELL_TRUTH

DUFFING = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(
        lambda x, k, k3, c: [x[1], -k * x[0] - k3 * x[0] ** 3 - c * x[1]], [[0.0], [0.8]], dt=0.02
    ),
    observation=lambda x: [x[0]],
    observation_noise=[[0.02]],
    initial_mean=[1.0, 0.0],
    initial_cov=[[0.1, 0.0], [0.0, 0.0]],
)


def walk(dt=0.1, **observation):
    return psf.StateSpaceModel(
        transition=psf.EulerMaruyama(lambda x, a: [-a * x[0]], [[0.7]], dt=dt),
        initial_mean=[0.0],
        initial_cov=[[0.5]],
        **observation,
    )


COUNTS = walk(observation_dist=lambda x, c: [pm.Poisson.dist(mu=pt.exp(c + x[0]))])
SENSOR = walk(observation=lambda x, c: [c * pt.exp(x[0])], observation_noise=[[0.02]])

CASES = {
    "double well": (DOUBLE_WELL, DOUBLE_WELL_TRUTH, np.arange(0, 2001, 20), 2),
    "Duffing oscillator": (DUFFING, {"k": 1.0, "k3": 3.0, "c": 0.4}, np.arange(0, 2000, 20), 1),
    "counts of mean 3": (COUNTS, {"a": 0.5, "c": 1.0}, np.arange(0, 300, 5), 1),
    "counts of mean 0.4": (COUNTS, {"a": 0.5, "c": -1.0}, np.arange(0, 300, 5), 1),
    "exponential sensor": (SENSOR, {"a": 0.5, "c": 1.0}, np.arange(0, 300, 5), 1),
}
FILTERS = (psf.EKF(), psf.UKF(), psf.IPLF())


def exact(system, record) -> tuple[float, float]:
    """Return the log-likelihood and its standard error."""
    if system.n == 1:
        return psf.log_likelihood(system, psf.GridFilter(), **record).sum(), 0.0
    seeds = np.arange(40)
    totals = psf.log_likelihood(system, psf.BootstrapPF(20_000), seed=seeds, **record).sum(axis=-1)
    weights = np.exp(totals - totals.max())
    return logsumexp(totals) - np.log(40), weights.std() / weights.mean() / np.sqrt(40)


def main() -> None:
    for name, (system, truth, steps, seed) in CASES.items():
        data = psf.simulate(system, truth, steps=steps, random_seed=seed)["observations"].values
        record = {"params": truth, "observed": data, "steps": steps}
        total, error = exact(system, record)
        print(f"{name}: {total:.2f} +- {error:.2f}, {len(steps)} observations")
        for filter in FILTERS:
            if not system.gaussian_observation and not isinstance(filter, psf.IPLF):
                continue
            found = psf.log_likelihood(system, filter, **record).sum()
            start = time.process_time()
            for _ in range(20):
                psf.log_likelihood(system, filter, **record)
            took = (time.process_time() - start) / 20
            print(f"    {filter}: {found - total:+.2f}, {1e3 * took:.2f} ms", flush=True)


if __name__ == "__main__":
    main()
