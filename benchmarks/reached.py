"""CPU seconds in which ``sample_dram(until_ess=400)`` ends by itself, if it does.

``python -m benchmarks.reached [--seeds 3] [--only NAMES]`` prints a row for each posterior: CPU
seconds with warm-up and starts, compilation apart; draws of a chain; smallest bulk and tail
effective sample sizes; largest R-hat.
"""

import argparse
import logging
import os
import time
import warnings

os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "agg"}

import numpy as np
from arviz_stats.base import array_stats

import pymc_statespace_filters as psf
from benchmarks.efficiency_samplers import Clock, elements
from benchmarks.hard_posteriors import HARD
from benchmarks.posteriors import POSTERIORS


def tail_ess(draws: np.ndarray) -> float:
    """The smaller of the effective sample sizes of the 5 % and 95 % quantiles."""
    beyond = [draws <= np.quantile(draws, level) for level in (0.05, 0.95)]
    return min(array_stats.ess(b.astype(float), method="mean") for b in beyond)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reached", description=__doc__)
    parser.add_argument("--only", nargs="+", default=list(HARD), help="beginnings of names")
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    logging.disable(logging.ERROR)
    for name, make in (HARD | POSTERIORS).items():
        if not any(name.startswith(beginning) for beginning in options.only):
            continue
        model = make()
        psf.sample_dram(2, 2, chains=1, initvals={}, model=model, progressbar=False)  # compiles
        for seed in range(options.seeds):
            clock, began = Clock(), time.process_time()
            with clock.running():
                idata = psf.sample_dram(
                    model=model, until_ess=400, random_seed=seed, cores=1, progressbar=False,
                    compute_convergence_checks=False,
                )  # fmt: skip
            seconds = time.process_time() - began - clock.compilation
            columns = np.moveaxis(elements(model, idata["posterior"]), 2, 0)
            bulk = min(array_stats.ess(c) for c in columns)
            tail = min(tail_ess(c) for c in columns)
            rhat = max(array_stats.rhat(c) for c in columns)
            print(
                f"{name:30} {seed} {seconds:6.1f} s (starts {clock.starts:5.1f}) "
                f"{columns.shape[2]:6d} draws, ess {bulk:5.0f} {tail:5.0f}, rhat {rhat:.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
