"""The data of a model: how many there are, and a hash that tells whether two models share them."""

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from ..pymc_model.aligned_axes import records_of_rows
from ..pymc_model.inspection import scored_rows
from ..pymc_model.prior import Support
from ..pymc_model.random_variable import PanelRV


class Observed(NamedTuple):
    """Observed values of a variable, and whether an observation is a vector (the last axis).

    The first ``score_from`` rows, of each record in a panel, have no term in the log-density;
    ``is_scored`` are the others.
    """

    values: NDArray[np.float64]
    records: list[NDArray[np.float64]]  # the values, by record in a panel
    is_vector: bool
    score_from: int
    is_scored: Any

    @property
    def scored(self) -> NDArray[np.float64]:
        """The values that have a term."""
        return self.values[self.is_scored]


def observed_in(model: pm.Model) -> list[Observed]:
    """What every observed variable has for data."""
    found = []
    for rv in model.observed_RVs:
        values = np.asarray(model.rvs_to_values[rv].eval(mode="FAST_COMPILE"), dtype=np.float64)
        op = rv.owner.op
        is_vector, score_from = getattr(op, "ndim_supp", 0) > 0, getattr(op, "score_from", 0)
        records = _records(rv.owner, values)
        found.append(Observed(values, records, is_vector, score_from, scored_rows(rv.owner)))
    return found


def _records(node: Any, values: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """The values of each record of a panel; all together of any other variable."""
    if not isinstance(node.op, PanelRV):
        return [values]
    return np.split(values, np.flatnonzero(np.diff(records_of_rows(node.inputs[3]))) + 1)


def observation_count(observed: Sequence[Observed]) -> int:
    """Count the observations J of some variables that are scored and not entirely missing.

    A vector-valued observation (a row of a state-space or multivariate variable) counts once, like
    a scalar one.
    """
    return sum(
        int((~np.isnan(one.scored).all(axis=-1) if one.is_vector else ~np.isnan(one.scored)).sum())
        for one in observed
    )


def scalar_count(observed: Sequence[Observed]) -> int:
    """Count the observed scalars that are scored and not missing."""
    return sum(int((~np.isnan(one.scored)).sum()) for one in observed)


def data_fingerprint(observed: Sequence[Observed]) -> str:
    """Hash the observed values of some variables.

    It is a hexadecimal SHA-256 of shapes, values, positions of missing values and numbers of rows
    that are not scored: reproducible across processes, and independent of the structure of the
    model and the names of its variables. The records of a panel count like variables, so that
    neither their order nor their labels matter. Axes of length one are ignored, so that a vector of
    J values equals a table of one column.
    """
    hashes = []
    for one in observed:
        unscored = f" scored from {one.score_from}" if one.score_from else ""
        for values in map(np.squeeze, one.records):
            canonical = np.where(np.isnan(values), np.nan, values + 0.0)  # one NaN, one zero
            content = repr(values.shape).encode() + canonical.astype("<f8").tobytes()
            hashes.append(hashlib.sha256(content + unscored.encode()).digest())
    return hashlib.sha256(b"".join(sorted(hashes))).hexdigest()


def facts_of(observed: Sequence[Observed], support: Support) -> dict[str, Any]:
    """The fields of an `Evidence` that describe data and priors."""
    return {
        "n_observations": observation_count(observed),
        "data_fingerprint": data_fingerprint(observed),
        "log_volume": support.log_volume,
        "uniform": support.uniform,
        "improper": support.improper,
    }
