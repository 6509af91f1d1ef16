"""The stationary distribution of a Markov chain."""

from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .equations import as_symbol, static_shape

_LEAST = 1e-300  # added to the probability of leaving a value, which may be zero


def stationary(probabilities: Any) -> TensorVariable:
    """Return the stationary distribution of a Markov chain.

    For a start in ``initial_dist``, ``pm.Categorical.dist(psf.system.stationary(P))``: the chain
    has run for a long time before the record begins.

    Parameters
    ----------
    probabilities : array_like or TensorVariable, shape (K, K)
        P[i, j] is the probability of a move from value i to value j in one step, so that rows add
        up to one. With two or more groups of values that no move leaves there is no single result,
        and this one is not finite or arbitrary.

    Returns
    -------
    TensorVariable, shape (K,)
        The solution of ``pi @ P == pi`` whose elements add up to one.

    Raises
    ------
    ModelError
        If this is no square matrix.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.system.stationary([[0.9, 0.1], [0.3, 0.7]]).eval().round(3)
    array([0.75, 0.25])
    """
    matrix = as_symbol("probabilities", probabilities)
    shape = static_shape(matrix)
    if len(shape) != 2 or shape[0] != shape[1] or shape[0] is None:
        raise ModelError(
            f"probabilities must be a square matrix of static shape, got the shape {shape}"
        )
    return pt.specify_shape(_solved(matrix, shape[0]), (shape[0],))


def _solved(matrix: TensorVariable, size: int) -> TensorVariable:
    """The solution by elimination of one value after the other, without pivots or differences.

    W. K. Grassmann, M. I. Taksar and D. P. Heyman, "Regenerative analysis and steady state
    distributions for Markov chains", Operations Research 33 (1985). Their divisions of the result
    are left out: it may be zero.
    """
    eliminated = []
    for _ in range(size - 1):
        leaving, reaching = matrix[-1, :-1], matrix[:-1, -1]
        total = leaving.sum() + _LEAST
        matrix = matrix[:-1, :-1] + reaching[:, np.newaxis] * (leaving / total)
        eliminated.append((reaching, total))
    found = pt.ones(1)
    for reaching, total in reversed(eliminated):
        found = pt.concatenate([found * total, pt.sum(found * reaching, keepdims=True)])
        found = found / found.sum()
    return found
