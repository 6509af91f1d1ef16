"""One evaluation of the log-density of a panel, by record."""

from typing import NamedTuple

import numpy as np

from ....compiler.native.entry_point import njit_cached
from ....compiler.native.jit import linked
from ....compiler.native.pytensor_function import make_call
from ..state import HEALTH_SIZE, NOT_A_NUMBER, RAISED

_internal = linked()


class RecordEvaluation(NamedTuple):
    """What went wrong in one evaluation of all records."""

    failure: int  # 0, or the first failure code
    n_failed: int  # likelihoods that are minus infinity


@_internal
def _take_numbers(target, out):
    """Results of a call, with minus infinity for NaN and plus infinity; the number of these."""
    n_failed = 0
    for i in range(target.size):
        value = out[1 + i]
        target[i] = value if value < np.inf else -np.inf
        n_failed += 0 if target[i] > -np.inf else 1
    return n_failed


@njit_cached
def evaluate_likelihoods(density, estimates):
    """Estimate the likelihoods of all records at the position and seeds in the arrays.

    An estimate is never NaN or plus infinity: where the evaluation of a record failed it is minus
    infinity, and the others keep theirs.
    """
    if not make_call(density.likelihood):
        return RecordEvaluation(RAISED, 0)
    out = density.likelihood.out
    n_failed = _take_numbers(estimates, out)
    if n_failed == 0:
        return RecordEvaluation(0, 0)
    for i in range(density.n_healths):
        code = out[1 + estimates.size + HEALTH_SIZE * i + 1]
        if code != 0.0:
            return RecordEvaluation(int(code), n_failed)
    return RecordEvaluation(NOT_A_NUMBER, n_failed)


@njit_cached
def evaluate_priors(density, priors):
    """All other terms at the position in the arrays; whether the model did not raise."""
    if not make_call(density.prior):
        return False
    _take_numbers(priors, density.prior.out)
    return True
