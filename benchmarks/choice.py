"""What does the race of `psf.sample` cost? Both samplers on each posterior, and the race.

``python -m benchmarks.choice`` prints a row for each posterior: CPU seconds until ``until_ess=400``
is reached, compilation and starts included, effective draws per CPU second, and the outcome. Names
on the command line choose posteriors by their beginnings. Each run has a process of its own, so
that none finds machine code that another one has loaded.
"""

import json
import logging
import subprocess
import sys
import time

import numpy as np
from arviz_stats.base import array_stats

import pymc_statespace_filters as psf
from benchmarks.hard_posteriors import HARD
from benchmarks.posteriors import POSTERIORS
from pymc_statespace_filters.sampling.choice import why_no_nuts

ALL = POSTERIORS | HARD
MOST_SECONDS = 600


def least_ess(posterior) -> float:
    """The smallest effective sample size of a parameter, of bulk and tails."""
    values = []
    for variable in posterior.data_vars.values():
        for element in np.moveaxis(variable.values.reshape(*variable.shape[:2], -1), -1, 0):
            for method, prob in (("bulk", None), ("tail", (0.05, 0.95))):
                values.append(
                    array_stats.ess(element, chain_axis=0, draw_axis=1, method=method, prob=prob)
                )
    return float(min(values))


def run(name: str, sampler: str) -> dict:
    """One run in this process."""
    logging.getLogger("pymc").setLevel(logging.ERROR)
    model, began = ALL[name](), time.process_time()
    idata = psf.sample(model=model, sampler=sampler, random_seed=1, progressbar=False)
    seconds = time.process_time() - began
    ess = least_ess(idata["posterior"])
    thin, reason = idata.attrs["iterations_per_draw"], idata.attrs["sampler_reason"]
    return {"seconds": seconds, "ess": ess, "thin": thin, "reason": reason}


def row(name: str) -> str:
    """A row of the table."""
    model, found = ALL[name](), {}
    for sampler in ("dram",) if why_no_nuts(model) else ("dram", "nuts", "auto"):
        command = [sys.executable, "-m", "benchmarks.choice", "--run", name, sampler]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=MOST_SECONDS)
            found[sampler] = json.loads(done.stdout.splitlines()[-1])
        except (subprocess.TimeoutExpired, IndexError, ValueError):
            found[sampler] = None
    cells = [
        "-" if (one := found.get(sampler)) is None
        else f"{one['seconds']:.1f} s, {one['ess'] / one['seconds']:.1f}, k = {one['thin']}"
        for sampler in ("dram", "nuts", "auto")
    ]  # fmt: skip
    raced = found.get("auto")
    return f"| {name} | {' | '.join(cells)} | {'-' if raced is None else raced['reason']} |"


def main() -> None:
    if sys.argv[1:2] == ["--run"]:
        print(json.dumps(run(*sys.argv[2:4])))
        return
    print("| posterior | DRAM: CPU, ESS per CPU second | NUTS | race | how it went |")
    print("| --- " * 5 + "|")
    for name in ALL:
        if not sys.argv[1:] or any(name.startswith(begin) for begin in sys.argv[1:]):
            print(row(name), flush=True)


if __name__ == "__main__":
    main()
