"""The side of the communication that runs in the other package's process. It needs only numpy."""

import json
import os
import sys
import time
from collections.abc import Callable
from importlib.metadata import version

import numpy as np

from benchmarks.timing import Timed

# JAX reads these when it is imported; one thread for all.
os.environ["JAX_ENABLE_X64"] = "1"
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"

# Output that a package prints must not be mistaken for an answer.
ANSWERS, sys.stdout = sys.stdout, sys.stderr

RECORDS = dict(np.load(sys.argv[1]))


def record(name: str) -> tuple[np.ndarray, ...]:
    """Return parameters, steps (J,), inputs (steps,) and observations (J, 1) of one system."""
    return (
        RECORDS[f"{name}_theta"],
        RECORDS["steps"],
        RECORDS[f"{name}_inputs"],
        RECORDS[f"{name}_observed"],
    )


def every_step(steps: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Return observations (steps[-1] + 1, p) with NaN at the steps without one."""
    rows = np.full((steps[-1] + 1, observed.shape[1]), np.nan)
    rows[steps] = observed
    return rows


def serve(tasks: dict[str, Callable[[], Callable[[int], float]]], *packages: str) -> None:
    """Answer ``prepare TASK``, ``values TASK N_SEEDS`` and ``time TASK`` until the input ends.

    A task is a function that makes (and may compile) the function of a seed to be timed.
    """
    timed: dict[str, Timed] = {}

    def answer(**what) -> None:
        print(json.dumps(what), file=ANSWERS, flush=True)

    answer(versions={name: version(name) for name in packages})
    for line in sys.stdin:
        verb, task, *rest = line.split()
        try:
            if verb == "prepare":
                start = time.process_time()
                timed[task] = Timed(tasks[task]())
                timed[task].function(0)
                first = time.process_time() - start
                timed[task].warm_up()
                answer(first=first)
            elif verb == "values":
                answer(values=timed[task].values(int(rest[0])))
            else:
                answer(seconds=timed[task].seconds())
        except Exception as error:
            answer(error=f"{type(error).__name__}: {error}".split("\n")[0][:200])
