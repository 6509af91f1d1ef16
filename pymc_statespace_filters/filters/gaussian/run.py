"""One run of a Gaussian filter with all that it knew: means and covariances, read off its tape."""

import numpy as np

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.filters.gaussian.recursion import (
    GaussianFilterFunctions,
    compile_taped_to_the_end,
    compiled_of,
)


def compile_run(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta, steps, observed, inputs, t0, seed, rows) -> a run.

    See `filters`, the room, for what it returns.
    """
    forward = compile_taped_to_the_end(recursion)
    pass_forward, n = forward.function, recursion.system.n

    def run(theta, steps, observed, inputs, t0, seed, rows):
        terms, health, tape = pass_forward(theta, steps, observed, inputs, t0, seed)
        R, j = rows.size, 0
        mean, cov = np.empty((R, n)), np.empty((R, n, n))
        for r in range(R):
            while j < steps.size and steps[j] <= rows[r]:
                j += 1
            s = tape[rows[r] + j]  # behind a row for each step and each observation so far
            place = n
            for a in range(n):
                mean[r, a] = s[a]
                for b in range(a + 1):
                    cov[r, a, b] = cov[r, b, a] = s[place]
                    place += 1
        return terms, health, mean, cov, np.empty((R, 0, n)), np.empty((R, 0))

    return compiled_of(run, "run", {"forward": forward}, recursion)
