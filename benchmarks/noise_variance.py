"""Change of an estimated log-likelihood when an autoregression moves its normals.

The double well at the parameters of its record. Normals u are those of one seed, v those of
another. The numbers are variances of log L(rho u + sqrt(1 - rho^2) v) - log L(u) over pairs of
seeds, accurate to a sixth of their size. Run it with ``python -m benchmarks.noise_variance`` from
the root of the repository; it takes a few minutes. ``docs/explanation/noisy-likelihoods.md`` shows
some of the rows.
"""

import warnings
from itertools import product

import numpy as np

import pymc_statespace_filters as psf
from benchmarks.systems import DOUBLE_WELL, DOUBLE_WELL_TRUTH, simulated, theta_of
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihoodOfNoise, StoredNoise

CORRELATIONS = (0.0, 0.9, 0.99, 0.999)
RECORD_LENGTHS = (25, 100, 400)
SIZES = (50, 200, 1000)
STEPS_BETWEEN = 20
N_PAIRS = 80

# Filters of one family read the same normals.
FAMILIES = (
    {
        "`BootstrapPF`, systematic": lambda n: psf.BootstrapPF(n),
        "`BootstrapPF`, sorted": lambda n: psf.BootstrapPF(n, resampling="sorted"),
        "sorted at every observation": lambda n: psf.BootstrapPF(
            n, resampling="sorted", resample_below=1
        ),
    },
    {"`EnKF`": psf.EnKF},
)


def variances(filters, n_observations) -> np.ndarray:
    """Return variances of the differences, (filters, correlations); the filters share normals."""
    steps = STEPS_BETWEEN * np.arange(n_observations)
    inputs, observed = simulated(DOUBLE_WELL, DOUBLE_WELL_TRUTH, steps)
    theta = theta_of(DOUBLE_WELL, DOUBLE_WELL_TRUTH)
    evaluators = [evaluator(LogLikelihoodOfNoise(DOUBLE_WELL, f)) for f in filters]
    normals = evaluator(StoredNoise(DOUBLE_WELL, filters[0]))

    def estimates(z):
        return np.array([f(theta, steps, observed, inputs, 0.0, z)[0].sum() for f in evaluators])

    differences = np.empty((N_PAIRS, len(CORRELATIONS), len(filters)))
    for pair in range(N_PAIRS):
        (u,), (v,) = normals(steps, 2 * pair), normals(steps, 2 * pair + 1)
        here = estimates(u)
        for i, rho in enumerate(CORRELATIONS):
            there = estimates(rho * u + np.sqrt(1.0 - rho**2) * v)
            differences[pair, i] = there - here
    return differences.var(axis=0).T


def main() -> None:
    heads = " | ".join(f"ρ = {rho:g}" for rho in CORRELATIONS)
    print(f"| filter | observations | members | {heads} |")
    print("| --- " * (3 + len(CORRELATIONS)) + "|")
    for family, length, size in product(FAMILIES, RECORD_LENGTHS, SIZES):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", psf.errors.FilterWarning)
            rows = variances([make(size) for make in family.values()], length)
        for name, row in zip(family, rows, strict=True):
            numbers = " | ".join(f"{value:.2g}" for value in row)
            print(f"| {name} | {length} | {size} | {numbers} |", flush=True)


if __name__ == "__main__":
    main()
