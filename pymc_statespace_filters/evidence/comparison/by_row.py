"""Rival models row by row: evidences of the rows so far, their differences, and probabilities."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from ...errors import DataMismatchError, ModelError
from ...pymc_model.posterior_draws import COURSE
from ...smc.merging import merged_log_evidence
from .selection import prior_weights, probabilities


def compare_rows(
    results: Mapping[str, Any], model_prior: Mapping[str, float] | None, ci_prob: float
) -> xr.Dataset:
    """Compare sequential runs row by row, as `compare_evidence` describes it.

    The errors of the scores of a model are correlated: where a row was hard, its error may take
    itself back in the next ones. The sum of scores has the error of the evidence, not that of a sum
    of independent numbers.
    """
    courses = _courses(results)
    paths = [course["log_evidence_so_far"].values for course in courses.values()]
    value, error = (np.stack(parts) for parts in zip(*map(merged_log_evidence, paths), strict=True))
    scores, score_errors = (
        np.stack([course[name].values for course in courses.values()])
        for name in ("score", "score_se")
    )
    log_weight = value + np.log(prior_weights(model_prior, list(courses)))[:, np.newaxis]
    of_rows = [probabilities(*at, ci_prob) for at in zip(log_weight.T, error.T, strict=True)]
    probability, low, high = np.moveaxis(np.array(of_rows), 0, -1)
    found = {
        "score_difference": scores - scores[0],
        "score_difference_se": _against_first(score_errors),
        "log_bayes_factor": value - value[0],
        "log_bayes_factor_se": _against_first(error),
        "probability": probability,
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


def _courses(results: Mapping[str, Any]) -> dict[str, xr.Dataset]:
    """The course of each run, of the same rows."""
    is_named = isinstance(results, Mapping) and not isinstance(results, xr.DataTree | xr.Dataset)
    if not is_named or len(results) < 2:
        raise ModelError(
            "what is compared by row must be a mapping from names of at least two models to what "
            f"sample_smc returned of them, got {type(results).__name__}"
            + (f" of {len(results)}" if is_named else "")
        )
    courses = {}
    for name, idata in results.items():
        known = isinstance(idata, xr.DataTree) and COURSE in idata.children
        course = idata[COURSE].to_dataset() if known else xr.Dataset()
        if "log_evidence_so_far" not in course:
            raise ModelError(
                f"what is compared by row must be of sample_smc(data='sequential') or of extend, "
                f"got for {name!r} {'a tempered run' if known else type(idata).__name__}"
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
                f"what is compared by row must have the same rows, got {len(rows)} of {first!r} "
                f"and {len(own)} of {name!r}: extend the shorter one"
            )
        if not np.array_equal(rows, own) or fingerprints[first] != fingerprints[name]:
            raise DataMismatchError(
                f"what is compared by row must have the same data, got others of {name!r} than of "
                f"{first!r}"
            )
