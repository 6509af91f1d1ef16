"""Are chains that have missed the neck of a funnel marked? Eight schools, centred, of exact tails.

``python -m benchmarks.missed_necks 60`` runs ``sample_dram(until_ess=400)`` with so many seeds (a
second number is the first one), and counts the runs in which one of three lower tails of ``tau``
holds more or less of the draws than of the posterior by over three standard errors; and of these
the ones that a warning marks: that a part of the posterior was missed, or that the effective size
was not reached. 60 seeds: 44 were wrong, of which 32 were marked by the first warning and 10 by
the second alone; of 16 right ones the first warning marked one.
"""

import logging
import sys
import warnings
from collections import Counter

import numpy as np
from arviz_stats.base import array_stats

import pymc_statespace_filters as psf
from benchmarks.choice import least_ess
from benchmarks.hard_posteriors import ERRORS_OF_SCHOOLS, SCHOOLS, eight_schools

SHARES = 0.05, 0.1, 0.2  # of the posterior, in the tails


def quantiles() -> np.ndarray:
    """Of log tau, exact: given it, all else is normal."""
    log_tau = np.linspace(-16, 7, 20_001)
    variances = np.square(ERRORS_OF_SCHOOLS) + np.exp(2 * log_tau)[:, np.newaxis]
    precision = 1 / 25 + (1 / variances).sum(axis=1)  # of mu
    mean = (SCHOOLS / variances).sum(axis=1) / precision
    log_density = (
        log_tau - np.log1p(np.exp(2 * log_tau) / 25)
        - 0.5 * (np.log(variances) + np.square(SCHOOLS) / variances).sum(axis=1)
        + 0.5 * (precision * mean**2 - np.log(precision))
    )  # fmt: skip
    cumulated = np.exp(log_density - log_density.max()).cumsum()
    return np.interp(SHARES, cumulated / cumulated[-1], log_tau)


def worst_z(log_tau: np.ndarray, edges: np.ndarray) -> float:
    """The largest deviation of a tail's share of the draws (chain, draw), in errors."""
    worst = 0.0
    for share, edge in zip(SHARES, edges, strict=True):
        inside = (log_tau < edge).astype(float)
        n = array_stats.ess(inside, chain_axis=0, draw_axis=1, method="mean")
        n = max(float(n), 1.0)  # without a draw in the tail that of independent draws
        worst = max(worst, abs(inside.mean() - share) / np.sqrt(share * (1 - share) / n))
    return worst


def main(count: int, first: int = 0) -> None:
    """Print what each run was, and the counts."""
    logging.getLogger("pymc").setLevel(logging.CRITICAL)
    warnings.simplefilter("ignore")
    model, edges, found = eight_schools(), quantiles(), Counter()
    for seed in range(first, first + count):
        idata = psf.sample_dram(until_ess=400, model=model, random_seed=seed, progressbar=False)
        z = worst_z(np.log(idata["posterior"]["tau"].values), edges)
        mark = "short" if least_ess(idata["posterior"]) < 400 else "none"
        if idata.attrs["unvisited"] != "[]":
            mark = "missed"
        outcome = "wrong" if z > 3 else "right", mark
        found[outcome] += 1
        print(seed, f"{z:.1f}", *outcome, flush=True)
    print(dict(found))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
