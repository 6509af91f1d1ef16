"""Great earthquakes: maximum and evidence of a Poisson hidden Markov model's likelihood.

The annual counts of earthquakes of magnitude 7 and more from 1900 to 2006 are printed, with the
maxima for two and three states, by Zucchini, MacDonald and Langrock, "Hidden Markov Models for Time
Series" (2nd ed., 2016), and shipped by several packages. The chain starts from its stationary
distribution.

The evidence of two, three and four regimes, which they do not print, is estimated twice: by bridge
sampling from draws that keep the means in order, with `exchangeable`, which counts the others, and
by sequential Monte Carlo from a prior in which the regimes have any order. That of two regimes is
also an integral over four parameters, by quadrature.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
from comparison import Comparison, Study, cpu_seconds, table
from scipy.optimize import minimize
from scipy.special import roots_legendre
from scipy.stats import beta, gamma, poisson

import pymc_statespace_filters as psf

RECORD = pd.read_csv(Path(__file__).parent / "data" / "earthquakes.csv")
STEPS = (RECORD.year - RECORD.year[0]).to_numpy()

# With starts of the search: means, and the probability to stay.
PUBLISHED = {2: -342.3183, 3: -329.4603}
STARTS = {2: [15.0, 25.0], 3: [12.0, 20.0, 30.0]}
PARTICLES = {2: 500, 3: 1000, 4: 4000}  # of a population of sequential Monte Carlo


def chain(n: int) -> psf.StateSpaceModel:
    """A regime of n values, from which the counts have their mean."""
    return psf.StateSpaceModel(
        transition=lambda x, q: [q[0]],
        process_dist=lambda x, P: [pm.Categorical.dist(P[pt.cast(x[0], "int64")])],
        observation_dist=lambda x, means: [pm.Poisson.dist(means[pt.cast(x[0], "int64")])],
        initial_dist=lambda P: [pm.Categorical.dist(psf.system.stationary(P))],
        states=["regime"],
        observables=["count"],
        shapes={"P": (n, n), "means": (n,)},
    )


def maximum(n: int) -> float:
    """The largest log-likelihood, along its gradient from one start."""
    with pm.Model() as model:
        rows = pm.Flat("rows", shape=(n, n - 1))
        logs = pm.Flat("logs", shape=n)
        # Relative to staying: a softmax of numbers below zero beside the diagonal.
        places = [(i, j) for i in range(n) for j in range(n) if i != j]
        logits = pt.zeros((n, n))
        for number, (i, j) in enumerate(places):
            logits = pt.set_subtensor(logits[i, j], rows.ravel()[number])
        psf.StateSpace(
            "counts", chain(n), psf.FiniteStateFilter(),
            params={"P": pt.special.softmax(logits, axis=1), "means": pt.exp(logs)},
            observed=RECORD[["count"]].to_numpy(float), steps=STEPS,
        )  # fmt: skip
    value, gradient = model.compile_logp(), model.compile_dlogp()

    def at(x: np.ndarray) -> dict[str, np.ndarray]:
        return {"rows": x[: n * (n - 1)].reshape(n, n - 1), "logs": x[n * (n - 1) :]}

    first = np.concatenate([np.full(n * (n - 1), -2.0), np.log(STARTS[n])])
    found = minimize(lambda x: -value(at(x)), first, jac=lambda x: -gradient(at(x)), tol=1e-10)
    return -found.fun


def with_priors(n: int, *, is_ordered: bool) -> pm.Model:
    """The chain with priors that are the same for all regimes."""
    order = {"transform": pm.distributions.transforms.ordered, "initval": np.linspace(12, 30, n)}
    with pm.Model() as model:
        P = pm.Dirichlet("P", 1.0 + 8.0 * np.eye(n))
        means = pm.Gamma("means", mu=20, sigma=10, shape=n, **(order if is_ordered else {}))
        psf.StateSpace(
            "counts", chain(n), psf.FiniteStateFilter(), params={"P": P, "means": means},
            observed=RECORD[["count"]].to_numpy(float), steps=STEPS,
        )  # fmt: skip
    return model


def evidences(n: int) -> list[Comparison]:
    """Bridge sampling from ordered draws and sequential Monte Carlo; of two regimes, quadrature."""
    quiet = {"progressbar": False}
    with with_priors(n, is_ordered=True):
        idata = psf.sample(1000, random_seed=1, **quiet)
        found = psf.estimate_evidence(
            idata, estimators=("bridge",), exchangeable=["means", "P"], random_seed=2, **quiet
        )
    bridge = found["bridge"].log_evidence, found["bridge"].se
    with with_priors(n, is_ordered=False):
        attrs = psf.sample_smc(PARTICLES[n], random_seed=3, **quiet).attrs
    smc = attrs["log_evidence"], attrs["log_evidence_se"]
    name = f"log-evidence, {n} regimes"
    if n > 2:
        return [
            Comparison(f"{name}, by bridge sampling and by sequential Monte Carlo", *bridge, *smc)
        ]
    exact = by_quadrature()
    return [
        Comparison(f"{name}, by quadrature and by bridge sampling", exact, 5e-4, *bridge),
        Comparison(f"{name}, by quadrature and by sequential Monte Carlo", exact, 5e-4, *smc),
    ]


def by_quadrature(n_moves: int = 24, n_means: int = 80) -> float:
    """The log-evidence of two regimes in any order, without the package.

    Nodes of Gauss and Legendre: so many along each probability to move, and along each mean.
    """
    u, w = roots_legendre(n_moves)
    moves = ((1 + u) / 2) ** 2  # denser near 0
    w = w * (1 + u) / 2 * beta.pdf(moves, 1, 9)
    up, down = (p.reshape(-1, 1) for p in np.meshgrid(moves, moves))
    v, width = roots_legendre(n_means)
    means = 0.5 + 69.5 * (1 + v) / 2
    width = width * 69.5 / 2 * gamma.pdf(means, 4, scale=5)
    density = poisson.pmf(RECORD["count"].to_numpy(int)[:, None], means)
    unit = density.max(axis=1, keepdims=True)
    density /= unit
    total = 0.0
    for i in range(n_means):  # of the first regime; of the second from the same on, by symmetry
        first, second = down / (up + down), up / (up + down)
        for row in density:
            first, second = first * row[i], second * row[i:]
            first, second = first * (1 - up) + second * down, first * up + second * (1 - down)
        of_means = np.outer(w, w).ravel() @ (first + second)
        of_means[1:] *= 2
        total += width[i] * width[i:] @ of_means
    return float(np.log(total) + np.log(unit).sum())


def study() -> Study:
    with cpu_seconds() as seconds:
        found = {n: maximum(n) for n in PUBLISHED}
        of_evidence = [c for n in PARTICLES for c in evidences(n)]
    comparisons = [
        Comparison(
            f"largest log-likelihood, {n} regimes", published, 5e-5, found[n], by_chance=False
        )
        for n, published in PUBLISHED.items()
    ]
    return Study(
        "great earthquakes, 107 annual counts",
        "counts and maxima of Zucchini, MacDonald and Langrock, Hidden Markov Models for Time "
        "Series (2016)",
        comparisons + of_evidence,
        seconds[0],
        "Their maxima are printed to four decimals. Both numbers of an evidence are ours, "
        "that by quadrature without the package.",
    )


if __name__ == "__main__":
    print(table([study()]))
