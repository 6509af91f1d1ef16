"""Masses by `sample_smc`, within their errors or not, of modes apart, a banana and a funnel.

The targets are distributions of known masses and evidence 1: the likelihood of each is its density
over that of a wide prior. A run that is off by more than 3 of its errors should be marked by an
`EvidenceWarning`; each run that is off or marked has a line with the reasons, "unvisited" (the
particles have missed a part), "spread" (of the populations) or "other". Run it with ``python -m
benchmarks.smc 20`` from the root of the repository, for 20 seeds, or with names of targets before
the number.

With 32 seeds of each target but the funnel, and 200 draws, the mass of the needle was off in 14
runs, of which 11 were marked as lacking a part; on the wells 1 was off, and marked so; on labels
and banana none. Of the 113 other runs 2 were marked so, one on the labels and one on the banana,
and 17 as their populations differed, 9 of them on the needle. With 1000 draws the needle was off in
6 runs, all marked as lacking a part; the wells were in 2 and the labels in 1, not marked. Of the
119 others none was marked so, and 8 as their populations differed, all on the needle. With 16 seeds
the neck of the funnel was off in all runs, of which 12 were marked, 4 of them as lacking a part.
"""

import sys
import time
import warnings
from itertools import permutations
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy.stats import norm

import pymc_statespace_filters as psf

DRAWS = 200, 1000
MARKS = {"unvisited": "have missed a part of the posterior", "spread": "a few of them decide"}
PRIOR_SD = 10.0


def with_target(dim, log_density, parts, prior_sd=PRIOR_SD) -> pm.Model:
    """A model whose posterior has this density, with the indicator of each part."""
    with pm.Model() as model:
        x = pm.Normal("x", 0.0, prior_sd, shape=dim)
        prior = pm.logp(pm.Normal.dist(0.0, prior_sd), x).sum()
        pm.Potential("likelihood", log_density(x) - prior)
        for name, is_inside in parts.items():
            pm.Deterministic(name, pt.cast(is_inside(x), "float64"))
    return model


def normal(x, mean, sd):
    return pm.logp(pm.Normal.dist(mean, sd), x).sum()


def wells() -> tuple[pm.Model, dict[str, float]]:
    """Two wells in two dimensions, 8 of the wider one's standard deviations apart."""

    def log_density(x):
        wide, narrow = normal(x, [-4.0, 0.0], 1.0), normal(x, [4.0, 0.0], 0.3)
        return pt.logaddexp(np.log(0.7) + wide, np.log(0.3) + narrow)

    return with_target(2, log_density, {"narrow": lambda x: x[0] > 0.0}), {"narrow": 0.3}


def needle() -> tuple[pm.Model, dict[str, float]]:
    """A wide well and one so narrow that populations miss it, 8 standard deviations apart."""

    def log_density(x):
        wide, narrow = normal(x, [-4.0, 0.0], 1.0), normal(x, [4.0, 0.0], 0.08)
        return pt.logaddexp(np.log(0.7) + wide, np.log(0.3) + narrow)

    return with_target(2, log_density, {"narrow": lambda x: x[0] > 0.0}), {"narrow": 0.3}


def pin() -> tuple[pm.Model, dict[str, float]]:
    """Half of the mass in a mode a thirtieth as wide as the prior in each of four dimensions.

    Of 40 runs with 1000 draws it was off in 36, of which 17 were marked as lacking a part.
    """

    def log_density(x):
        wide, narrow = normal(x, [-3.0, 0.0, 0.0, 0.0], 1.0), normal(x, [3.0, 0.0, 0.0, 0.0], 0.1)
        return pt.logaddexp(wide, narrow) - np.log(2)

    parts = {"narrow": lambda x: ((x - np.array([3.0, 0.0, 0.0, 0.0])) ** 2).sum() < 0.5}
    return with_target(4, log_density, parts, 3.0), {"narrow": 0.5}


def labels() -> tuple[pm.Model, dict[str, float]]:
    """Three means, of which any two may be exchanged: six modes of equal masses."""

    def log_density(x):
        orders = permutations([-4.0, 0.0, 4.0])
        return pt.logsumexp(pt.stack([normal(x, list(one), 0.5) for one in orders])) - np.log(6)

    parts = {"rising": lambda x: (x[0] < x[1]) & (x[1] < x[2]), "middle": lambda x: abs(x[0]) < 2}
    return with_target(3, log_density, parts), {"rising": 1 / 6, "middle": 1 / 3}


def banana() -> tuple[pm.Model, dict[str, float]]:
    """A ridge along a parabola, a hundredth as wide as long."""

    def log_density(x):
        return normal(x[0], 0.0, 2.0) + normal(x[1], 0.5 * x[0] ** 2, 0.04)

    parts = {"left": lambda x: x[0] < 0.0, "ends": lambda x: abs(x[0]) > 3.0}
    return with_target(2, log_density, parts), {"left": 0.5, "ends": 2 * norm.sf(1.5)}


def funnel() -> tuple[pm.Model, dict[str, float]]:
    """Neal's, with five variables whose scale is the exponential of half of the first."""

    def log_density(x):
        return normal(x[0], 0.0, 3.0) + normal(x[1:], 0.0, pt.exp(x[0] / 2))

    parts = {"neck": lambda x: x[0] < -3.0, "mouth": lambda x: x[0] > 3.0}
    return with_target(6, log_density, parts), {"neck": norm.sf(1.0), "mouth": norm.sf(1.0)}


def run(model: pm.Model, exact: dict[str, float], draws: int, seed: int) -> dict[str, Any]:
    """Errors of masses and log-evidence in units of their standard errors; how it is marked."""
    began = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        idata = psf.sample_smc(draws, model=model, random_seed=seed, progressbar=False)
    warned = [one.message for one in caught if isinstance(one.message, psf.errors.EvidenceWarning)]
    marks = marks_of("; ".join(map(str, warned)))
    z = {"evidence": idata.attrs["log_evidence"] / idata.attrs["log_evidence_se"]}
    for name, mass in exact.items():
        difference = idata["posterior"][name].mean().item() - mass
        z[name] = difference / max(idata["mcse"][name].item(), 1e-300)
    return {**z, "marks": marks, "seconds": time.process_time() - began}


def marks_of(warned: str) -> list[str]:
    """The kinds of reasons in the text of a warning, which may be empty."""
    found = [mark for mark, words in MARKS.items() if words in warned]
    return found or ["other"] * bool(warned)


TARGETS = {build.__name__: build for build in (wells, needle, pin, labels, banana, funnel)}


def main(targets: list[str], n_seeds: int) -> None:
    for target in targets:
        model, exact = TARGETS[target]()
        for draws in DRAWS:
            runs = [run(model, exact, draws, seed) for seed in range(n_seeds)]
            names = ["evidence", *exact]
            z = np.abs([[one[name] for name in names] for one in runs])
            marked = np.array([bool(one["marks"]) for one in runs])
            off = (z > 3).any(axis=1)
            for seed, one in enumerate(runs):
                if off[seed] or marked[seed]:
                    state, marks = "off" if off[seed] else "right", ", ".join(one["marks"])
                    print(f"{target}, {draws} draws, seed {seed}: {state}, marked: {marks or 'no'}")
            beyond = dict(zip(names, (z > 3).sum(axis=0).tolist(), strict=True))
            seconds = np.median([one["seconds"] for one in runs])
            print(
                f"{target}, {draws} draws: beyond 3 errors {beyond} of {n_seeds}, "
                f"{(off & ~marked).sum()} of them not marked; marked in all {marked.sum()}; "
                f"{seconds:.1f} CPU s",
                flush=True,
            )


if __name__ == "__main__":
    *targets, n_seeds = sys.argv[1:]
    main(targets or list(TARGETS), int(n_seeds))
