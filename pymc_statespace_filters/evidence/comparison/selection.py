"""Select one evidence for each model, of one estimator or of several that agree."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import xarray as xr

from ...errors import DataMismatchError, ModelError
from ..agreement import assess_agreement
from ..evidence import Evidence, stored_evidences

EvidenceLike = Evidence | Mapping[str, Evidence] | xr.DataTree
ByEstimator = Mapping[str, Evidence]


class Selection(NamedTuple):
    """One evidence for each model, and how it was chosen; empty without a choice."""

    evidences: dict[str, Evidence]
    sentence: str


def select_evidences(given: Mapping[str, EvidenceLike], estimator: str | None = None) -> Selection:
    """Select one evidence for each model, and check that all belong to the same data.

    Without the name of an estimator, the estimates of a model must agree. Taken is then that of the
    estimator with the smallest standard errors, of those that all models with several estimates
    have, and of those without doubts if there are any. Estimates from the same draws have errors in
    common, so that a combination of them would be no more certain.

    Raises
    ------
    ModelError
        If an entry is of another type, or the estimator is ambiguous or missing.
    DataMismatchError
        If the models belong to different data.
    """
    if not isinstance(given, Mapping) or not given:
        raise ModelError(
            "evidences must be a mapping of model names to Evidence or DataTree with at least one "
            f"entry, got {given!r}"
        )
    found = {name: _by_estimator(name, one) for name, one in given.items()}
    if estimator is None:
        selection = _agreeing(found)
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


def _agreeing(found: Mapping[str, ByEstimator]) -> Selection:
    """One evidence for each model, from estimates that agree."""
    several = {name: _tested(name, one) for name, one in found.items() if len(one) > 1}
    single = {name: one for name, by in found.items() if len(by) == 1 for one in by.values()}
    if not several:
        return Selection(single, "")
    estimators = list(dict.fromkeys(one for by in several.values() for one in by))
    common = [one for one in estimators if all(one in by for by in several.values())]
    if common:
        best = _most_certain(common, list(several.values()))
        chosen = {name: by[best] for name, by in several.items()}
        whose = f" of {', '.join(map(repr, several))}" if single else ""
        sentence = f"Log-evidences{whose} by {best}"
    else:
        chosen = {name: by[_most_certain(list(by), [by])] for name, by in several.items()}
        each = ", ".join(f"of {name!r} by {one.estimator}" for name, one in chosen.items())
        sentence = f"Log-evidences {each}"
    reason = "the only estimates with a standard error"
    if len(estimators) > 1:
        reason = f"the most certain of estimates that agree ({', '.join(estimators)})"
    return Selection({name: (single | chosen)[name] for name in found}, f"{sentence}, {reason}.")


def _tested(name: str, found: ByEstimator) -> ByEstimator:
    """The estimates with a standard error; a `ModelError` if there are none or they disagree."""
    choose = f"choose one of {list(found)} by estimator="
    tested = {one: evidence for one, evidence in found.items() if not math.isnan(evidence.se)}
    if not tested:
        raise ModelError(
            f"{name!r} has estimates by several estimators, none of them with a standard error, so "
            f"that their agreement is unknown: {choose}"
        )
    agreement = assess_agreement(tested)
    if not agreement:
        raise ModelError(
            f"{name!r} has estimates by several estimators that disagree: {agreement.diagnosis}. "
            f"Remove the cause, or {choose}"
        )
    return tested


def _most_certain(estimators: list[str], of_models: list[ByEstimator]) -> str:
    """The estimator with the fewest doubts about its estimates, and then the smallest errors."""

    def uncertainty(estimator: str) -> tuple[int, float]:
        estimates = [by[estimator] for by in of_models]
        doubtful = sum(bool(one.doubts) for one in estimates)
        return doubtful, math.hypot(*(one.se for one in estimates))

    return min(estimators, key=uncertainty)
