"""Observations that were not made."""

import numpy as np

from pymc_statespace_filters.compiler.native.jit import inline_always


@inline_always
def is_missing(observed, j):
    """Whether nothing was seen at observation j."""
    for i in range(observed.shape[1]):
        if not np.isnan(observed[j, i]):
            return False
    return True
