"""One evidence for each model, of one estimator or several that agree; probabilities (Eq. 3.3)."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.special import log_softmax

from ...errors import DataMismatchError, ModelError
from ..agreement import assess_agreement, chosen_estimator
from ..evidence import Evidence, stored_evidences

N_NORMALS = 50_000

Array = NDArray[np.float64]

EvidenceLike = Evidence | Mapping[str, Evidence] | xr.DataTree
ByEstimator = Mapping[str, Evidence]


class Probabilities(NamedTuple):
    """Probabilities of m models and the ends of their central intervals, each of shape (m,)."""

    prob: Array
    low: Array
    high: Array


def probabilities(log_weight: Array, se: Array, ci_prob: float) -> Probabilities:
    """Normalise weights, with intervals under independent normal errors of their logarithms.

    The normal draws are fixed: equal evidences give equal intervals, and along a curve of weights
    the intervals are smooth. One unknown error makes all intervals unknown, because every
    probability depends on it.
    """
    prob = np.exp(log_softmax(log_weight))
    if not np.isfinite(log_weight + se).all():
        unknown = np.full_like(prob, np.nan)
        return Probabilities(prob, unknown, unknown)
    normals = np.random.default_rng(0).standard_normal((N_NORMALS, len(se)))
    probs = np.exp(log_softmax(log_weight + se * normals, axis=1))
    low, high = np.quantile(probs, [(1 - ci_prob) / 2, (1 + ci_prob) / 2], axis=0)
    return Probabilities(prob, np.minimum(low, prob), np.maximum(high, prob))


def prior_weights(model_prior: Mapping[str, float] | None, names: list[str]) -> Array:
    """Check and normalise prior weights of models; equal ones by default."""
    if model_prior is None:
        return np.full(len(names), 1 / len(names))
    if not isinstance(model_prior, Mapping) or set(model_prior) != set(names):
        raise ModelError(
            f"model_prior must give a weight to exactly the models {names}, got {model_prior!r}"
        )
    try:
        weights = np.array([model_prior[name] for name in names], dtype=np.float64)
    except (TypeError, ValueError):
        weights = np.array(np.nan)
    # Divide by the largest first: the sum may overflow. Ratios may still underflow to zero.
    ratios = np.clip(weights, 0, None) / (weights.max() if weights.max() > 0 else 1)
    if not (np.isfinite(weights).all() and (ratios > 0).all()):
        raise ModelError(
            f"model_prior must be positive and finite for every model, got {model_prior!r}"
        )
    return ratios / ratios.sum()


class Selection(NamedTuple):
    """One evidence for each model, and how it was chosen; empty without a choice."""

    evidences: dict[str, Evidence]
    sentence: str


def select_evidences(given: Mapping[str, EvidenceLike], estimator: str | None = None) -> Selection:
    """Select one evidence for each model, and check that all belong to the same data.

    Without the name of an estimator, it is that of `chosen_estimator`, with a doubt if other
    estimates of the model disagree. Estimates from the same draws have errors in common, so that a
    combination of them would be no more certain. Raises `ModelError` if an entry is of another
    type, the estimator is missing, or several estimates of a model have no standard error;
    `DataMismatchError` if the models belong to different data.
    """
    if not isinstance(given, Mapping) or not given:
        raise ModelError(
            "evidences must be a mapping of model names to Evidence or DataTree with at least one "
            f"entry, got {given!r}"
        )
    found = {name: _by_estimator(name, one) for name, one in given.items()}
    if estimator is None:
        selection = _selected(found)
    else:
        chosen = {name: _named(name, one, estimator) for name, one in found.items()}
        selection = Selection(chosen, "")
    by_data: dict[str, list[str]] = {}
    for name, evidence in selection.evidences.items():
        by_data.setdefault(evidence.data_fingerprint, []).append(name)
    if len(by_data) > 1:
        groups = " | ".join(", ".join(map(repr, names)) for names in by_data.values())
        raise DataMismatchError(
            f"evidences must belong to the same data, got models grouped by their data: {groups}"
        )
    return selection


def _by_estimator(name: str, given: EvidenceLike) -> ByEstimator:
    if isinstance(given, xr.DataTree):
        return stored_evidences(given, name)
    found: object = {given.estimator: given} if isinstance(given, Evidence) else given
    if (
        isinstance(found, Mapping)
        and found
        and all(isinstance(one, Evidence) for one in found.values())
    ):
        return found
    raise ModelError(f"evidences[{name!r}] must be an Evidence or a DataTree, got {given!r}")


def _named(name: str, found: ByEstimator, estimator: str) -> Evidence:
    if estimator not in found:
        raise ModelError(
            f"estimator must be one of {list(found)}, those of {name!r}, got {estimator!r}"
        )
    return found[estimator]


def _selected(found: Mapping[str, ByEstimator]) -> Selection:
    """One evidence for each model, with a doubt where its other estimates disagree."""
    evidences = {name: _trusted(name, by) for name, by in found.items()}
    several = [name for name, by in found.items() if len(by) > 1]
    estimators = dict.fromkeys(evidences[name].estimator for name in several)
    if len(estimators) > 1:
        each = ", ".join(f"of {name!r} by {evidences[name].estimator}" for name in several)
    else:
        whose = f"of {', '.join(map(repr, several))} " if len(several) < len(found) else ""
        each = f"{whose}by {next(iter(estimators), '')}"
    return Selection(evidences, f"Log-evidences {each}." if several else "")


def _trusted(name: str, by: ByEstimator) -> Evidence:
    taken = by[chosen_estimator(by)]
    if len(by) > 1 and math.isnan(taken.se):
        doubts = "; ".join(dict.fromkeys(one.doubts for one in by.values() if one.doubts))
        raise ModelError(
            f"{name!r} has estimates by several estimators, none of them with a standard error: "
            f"choose one of {list(by)} by estimator={f' ({doubts})' if doubts else ''}"
        )
    doubts_of_taken = taken.doubts, assess_agreement(by).diagnosis
    return replace(taken, doubts="; ".join(filter(None, doubts_of_taken)))
