"""Rival models row by row: evidences of the rows so far, their differences, and probabilities."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from ..errors import DataMismatchError, ModelError
from ..smc.merging import merged_log_evidence
from .output import COURSE

N_SIMULATED, SEED = 2000, 0  # of evidences within their errors, for intervals of probabilities
INTERVAL = 0.025, 0.975


def compare_prequential(results: Mapping[str, xr.DataTree]) -> xr.Dataset:
    """Compare rival models row by row, with the errors of all numbers.

    Parameters
    ----------
    results : mapping of str to xarray.DataTree
        Results of `sample_smc` with ``data="sequential"``, or of `extend`, of at least two models
        of the same rows; the others are compared with the first.

    Returns
    -------
    xarray.Dataset
        Along ``model`` and ``row``: ``score_difference``, of log p(d_j | d_1 .. d_{j-1}) with the
        parameters integrated out, and its sum so far, ``log_bayes_factor``, each with its standard
        error ``_se``; ``probability`` of the models if they were equally likely before the data,
        with the ends ``probability_low`` and ``probability_high`` of a 95 % interval by the errors
        of the evidences.

    Raises
    ------
    ModelError
        If `results` are not sequential runs of at least two models.
    DataMismatchError
        If they are of different rows or data.

    See Also
    --------
    plot_prequential : The same as a plot.
    compare_evidence : Models by their evidence, from any sampler.

    Notes
    -----
    The errors of the scores of a model are correlated: where a row was hard, its error may take
    itself back in the next ones. The sum of scores has the error of the evidence, not that of a sum
    of independent numbers. For the sum over other rows see ``score_deviation`` of `sample_smc`.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> def run(centre):
    ...     with pm.Model():
    ...         pm.Normal("a", centre, 0.2)
    ...         psf.StateSpace("d", system, psf.EKF(), steps=[1, 2, 3], observed=[0.9, 1.4, 1.8])
    ...         return psf.sample_smc(50, data="sequential", random_seed=1, progressbar=False)
    >>> table = psf.compare_prequential({"persistent": run(0.9), "alternating": run(-0.9)})
    >>> (table["probability"].sel(model="persistent") > 0.6).values
    array([False,  True,  True])
    """
    courses = _courses(results)
    paths = [course["log_evidence_so_far"].values for course in courses.values()]
    value, error = (np.stack(parts) for parts in zip(*map(merged_log_evidence, paths), strict=True))
    scores, score_errors = (
        np.stack([course[name].values for course in courses.values()])
        for name in ("score", "score_se")
    )
    simulated = np.random.default_rng(SEED).standard_normal((N_SIMULATED, len(value), 1))
    low, high = np.quantile(_probabilities(value + error * simulated), INTERVAL, axis=0)
    found = {
        "score_difference": scores - scores[0],
        "score_difference_se": _against_first(score_errors),
        "log_bayes_factor": value - value[0],
        "log_bayes_factor_se": _against_first(error),
        "probability": _probabilities(value[np.newaxis])[0],
        "probability_low": low,
        "probability_high": high,
    }
    rows = next(iter(courses.values()))["row"]
    return xr.Dataset(
        {name: (("model", "row"), values) for name, values in found.items()},
        coords={"model": list(courses), "row": rows},
    )


def _against_first(errors: np.ndarray) -> np.ndarray:
    """Errors of differences to the first of independent numbers; none of its own."""
    found = np.hypot(errors, errors[0])
    found[0] = 0.0
    return found


def _probabilities(log_evidences: np.ndarray) -> np.ndarray:
    """Of equally likely models along the second axis."""
    weights = np.exp(log_evidences - log_evidences.max(axis=1, keepdims=True))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _courses(results: Mapping[str, Any]) -> dict[str, xr.Dataset]:
    """The course of each run, of the same rows."""
    is_named = isinstance(results, Mapping) and not isinstance(results, xr.DataTree | xr.Dataset)
    if not is_named or len(results) < 2:
        raise ModelError(
            "results must be a mapping from names of at least two models to what sample_smc "
            f"returned of them, got {type(results).__name__}"
            + (f" of {len(results)}" if is_named else "")
        )
    courses = {}
    for name, idata in results.items():
        known = isinstance(idata, xr.DataTree) and COURSE in idata.children
        course = idata[COURSE].to_dataset() if known else xr.Dataset()
        if "log_evidence_so_far" not in course:
            raise ModelError(
                f"results[{name!r}] must be of sample_smc(data='sequential') or of extend, got "
                f"{'a tempered run' if known else type(idata).__name__}"
            )
        courses[str(name)] = course
    _check_same_rows(courses, results)
    return courses


def _check_same_rows(courses: Mapping[str, xr.Dataset], results: Mapping[str, Any]) -> None:
    (first, course), *others = courses.items()
    fingerprints = {
        str(name): idata["evidence"]["data_fingerprint"].sel(estimator="smc").item()
        for name, idata in results.items()
    }
    for name, other in others:
        rows, own = course["row"].values, other["row"].values
        if len(rows) != len(own):
            raise DataMismatchError(
                f"results must be of the same rows, got {len(rows)} of {first!r} and {len(own)} of "
                f"{name!r}: extend the shorter one"
            )
        if not np.array_equal(rows, own) or fingerprints[first] != fingerprints[name]:
            raise DataMismatchError(
                f"results must be of the same data, got others of {name!r} than of {first!r}"
            )
