"""GuidedPF where one guide is wrong: sensors that fold, thresholds, kinks and sparse counts.

Twenty records of each of ten systems, simulated at the parameters at which they are evaluated. The
error is the log of the mean of the likelihood over 20 seeds minus the exact log-likelihood, in
nats: of `GridFilter` for one state, else the log of the mean of 20 large bootstrap filters. Run it
with ``python -m benchmarks.two_explanations`` from the root of the repository; it takes ten
minutes. Numbers choose records: ``python -m benchmarks.two_explanations 3`` takes three of each.
"""

import sys
import time
import warnings
from collections.abc import Iterator

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy.special import logsumexp

import pymc_statespace_filters as psf

N_RECORDS, N_SEEDS, N_REFERENCES = 20, 20, 20
FILTERS = psf.BootstrapPF(300), psf.GuidedPF(300)
NEAR = 1.5
REFERENCE = psf.BootstrapPF(20_000)


def one_state(transition, observation, q, e, mean=0.0, var=1.0):
    """A system of one state with Gaussian noise of these standard deviations."""
    return psf.StateSpaceModel(
        transition=lambda x, q: [transition(x[0]) + q[0]],
        process_noise=[[q**2]],
        observation=lambda x: [observation(x[0])],
        observation_noise=[[e**2]],
        initial_mean=[mean],
        initial_cov=[[var]],
    )


def of_counts(transition, rate, q, mean=0.0, var=1.0):
    """A system of one state with Poisson counts."""
    return psf.StateSpaceModel(
        transition=lambda x, q: [transition(x[0]) + q[0]],
        process_noise=[[q**2]],
        observation_dist=lambda x: [pm.Poisson.dist(mu=rate(x[0]))],
        initial_mean=[mean],
        initial_cov=[[var]],
    )


def pendulum(x, t):
    """A driven pendulum that turns over."""
    return [x[1], -0.1 * x[1] - pt.sin(x[0]) + 0.9 * pt.cos(0.7 * t)]


FOLDED_PENDULUM = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(pendulum, [[0.0], [0.3]], dt=0.05),
    observation=lambda x: [pt.sin(x[0])],
    observation_noise=[[0.01]],
    initial_mean=[0.0, 0.0],
    initial_cov=np.diag([1.0, 1.0]),
)

BEARINGS = psf.StateSpaceModel(
    transition=lambda x, q: [
        x[0] + x[2] + 0.5 * q[0], x[1] + x[3] + 0.5 * q[1], x[2] + q[0], x[3] + q[1]
    ],
    process_noise=0.001**2 * np.eye(2),
    observation=lambda x: [pt.arctan2(x[1], x[0])],
    observation_noise=[[0.005**2]],
    initial_mean=[-0.05, 0.2, 0.002, -0.055],
    initial_cov=np.diag([0.5**2, 0.3**2, 0.005**2, 0.01**2]),
)  # fmt: skip

SQUARED_WELL = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(lambda x: [4.0 * (x[0] - x[0] ** 3)], [[0.9]], dt=0.02),
    observation=lambda x: [x[0] ** 2],
    observation_noise=[[0.04]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)

# name, system, steps between observations, number of observations
SYSTEMS = [
    ("walk seen through sin x", one_state(lambda x: x, pt.sin, 0.8, 0.1, var=4.0), 1, 60),
    ("walk seen through abs(x)", one_state(lambda x: x, abs, 1.0, 0.2), 1, 60),
    ("max(x, 0)", one_state(lambda x: 0.9 * x, lambda x: pt.maximum(x, 0.0), 1.0, 0.1), 1, 60),
    ("x^2 of a double well", SQUARED_WELL, 25, 40),
    ("tent map", one_state(lambda x: 1.0 - 1.8 * abs(x), lambda x: x, 0.05, 0.1, var=0.1), 1, 60),
    (
        "threshold autoregression",
        one_state(lambda x: 0.7 * x - 1.5 * pt.sign(x), lambda x: x, 0.5, 1.0),
        1,
        60,
    ),
    (
        "Ricker's map, counts of mean 4",
        of_counts(lambda x: x + 3.8 - pt.exp(x), lambda x: pt.exp(x), 0.3, mean=1.0),
        1,
        30,
    ),
    ("counts of rate 2 x^2", of_counts(lambda x: 0.95 * x, lambda x: 2.0 * x**2, 0.5), 1, 60),
    ("pendulum that turns over, sin of its angle", FOLDED_PENDULUM, 10, 60),
    ("bearings only", BEARINGS, 1, 24),
]  # fmt: skip


def log_likelihoods(filter, system, record, seeds) -> np.ndarray:
    """Return the log-likelihood for every seed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", psf.errors.FilterWarning)
        return psf.log_likelihood(system, filter, {}, **record, seed=seeds).sum(axis=-1)


def log_mean(values) -> float:
    """Return the log of the mean of exponentials."""
    return float(logsumexp(values) - np.log(len(values)))


def exact(system, record) -> float:
    """Return the reference."""
    if system.n == 1 and system.gaussian_observation:
        return float(log_likelihoods(psf.GridFilter(tolerance=1e-4), system, record, 0))
    return log_mean(log_likelihoods(REFERENCE, system, record, 1000 + np.arange(N_REFERENCES)))


def records(system, every, count, n) -> Iterator[dict]:
    """Simulate n records."""
    steps = every * (1 + np.arange(count))
    for seed in range(n):
        made = psf.simulate(system, {}, steps=steps, random_seed=seed)
        yield {"observed": made["observations"].values, "steps": steps}


def main(n_records: int) -> None:
    print("system | filter | median error | worst | within 1.5 | sd | ms")
    for name, system, every, count in SYSTEMS:
        made = list(records(system, every, count, n_records))
        truth = np.array([exact(system, record) for record in made])
        for filter in FILTERS:
            log_likelihoods(filter, system, made[0], np.arange(2))
            start = time.process_time()
            found = np.array([log_likelihoods(filter, system, r, np.arange(N_SEEDS)) for r in made])
            ms = 1e3 * (time.process_time() - start) / found.size
            error = np.array([log_mean(values) for values in found]) - truth
            worst, near = error[np.argmax(abs(error))], np.sum(abs(error) < NEAR)
            print(
                f"{name} | {filter} | {np.median(error):.2f} | {worst:.1f} | {near} of {n_records}"
                f" | {np.median(found.std(axis=1)):.2f} | {ms:.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else N_RECORDS)
