"""A deterministic filter at many parameter points for one record, side by side in lanes."""

import numpy as np

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction, jit
from pymc_statespace_filters.compiler.codegen.scalarize import NotUnrollableError
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.filters.gaussian import one_by_one
from pymc_statespace_filters.filters.gaussian.lanes.forward import forward_pass
from pymc_statespace_filters.filters.gaussian.lanes.group import (
    BEGIN,
    N_OF_RECORD,
    N_ROWS,
    POINT,
    SHIFT,
)
from pymc_statespace_filters.filters.gaussian.recursion import GaussianFilterFunctions
from pymc_statespace_filters.system.panel import FIRST_INPUT, N_COLUMNS, RECORD, STEP


def compile_batch(recursion: GaussianFilterFunctions) -> CompiledFunction:
    """The function (theta (B, k), steps, observed, inputs, t0, seed) -> terms, health."""
    try:
        forward = forward_pass(recursion)
    except NotUnrollableError:
        return one_by_one.compile_batch(recursion)
    run = forward.function

    def batch(theta, steps, observed, inputs, t0, seed):
        n_points, n_rows = theta.shape[0], steps.size
        rows = np.empty((n_rows, N_COLUMNS), np.int64)
        for j in range(n_rows):
            rows[j, RECORD], rows[j, STEP], rows[j, FIRST_INPUT] = 0, steps[j], 0
        records = np.empty((n_points, N_OF_RECORD), np.int64)
        for i in range(n_points):
            records[i, POINT], records[i, BEGIN], records[i, N_ROWS] = i, 0, n_rows
            records[i, SHIFT] = i * n_rows
        terms, health, _ = run(theta, records, rows, observed, inputs, t0, n_points * n_rows, 0)
        return terms.reshape((n_points, n_rows)), health

    return CompiledFunction(jit(batch), key_of(__name__, "batch", forward.key))
