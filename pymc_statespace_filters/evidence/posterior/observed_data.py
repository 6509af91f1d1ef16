"""The observed data of a model: number of observations and fingerprint."""

import hashlib

import numpy as np
import pymc as pm
from numpy.typing import NDArray


def _observed(model: pm.Model) -> list[tuple[NDArray[np.float64], bool]]:
    """Observed values of each variable, and whether an observation is a vector (the last axis)."""
    return [
        (
            np.asarray(model.rvs_to_values[rv].eval(mode="FAST_COMPILE"), dtype=np.float64),
            getattr(rv.owner.op, "ndim_supp", 0) > 0,
        )
        for rv in model.observed_RVs
    ]


def observation_count(model: pm.Model) -> int:
    """Count the observations J of a model that are not entirely missing.

    A vector-valued observation (a row of a state-space or multivariate variable) counts once, like
    a scalar one; the counts of several observed variables are added.
    """
    return sum(
        int((~np.isnan(values).all(axis=-1)).sum() if is_vector else (~np.isnan(values)).sum())
        for values, is_vector in _observed(model)
    )


def scalar_count(model: pm.Model) -> int:
    """Count the observed scalars of a model that are not missing."""
    return sum(int((~np.isnan(values)).sum()) for values, _ in _observed(model))


def data_fingerprint(model: pm.Model) -> str:
    """Hash the observed values of a model.

    Returns
    -------
    str
        Hexadecimal SHA-256 of shapes, values and positions of missing values: reproducible across
        processes, and independent of the structure of the model and the names of its variables.
        Axes of length one are ignored, so that a vector of J values equals a table of one column.
    """
    hashes = []
    for values, _ in _observed(model):
        values = np.squeeze(values)
        canonical = np.where(np.isnan(values), np.nan, values + 0.0)  # one kind of NaN and of zero
        content = repr(values.shape).encode() + canonical.astype("<f8").tobytes()
        hashes.append(hashlib.sha256(content).digest())
    return hashlib.sha256(b"".join(sorted(hashes))).hexdigest()
