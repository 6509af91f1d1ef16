"""The evidences of rival models, from whatever an estimator left of them."""

from collections.abc import Mapping

import xarray as xr

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.evidence.evidence import Evidence, stored_evidences

Given = Evidence | Mapping[str, Evidence] | xr.DataTree


def evidences_of_rivals(
    given: Mapping[str, Given], estimator: str | None = None
) -> dict[str, Evidence]:
    """Find one evidence for each model, and see that all saw the same data.

    Parameters
    ----------
    given : mapping of str to Evidence, mapping of estimators to Evidence, or xarray.DataTree
        By model.
    estimator : str, optional
        Whose evidence to take; may be left out where there is only one.

    Returns
    -------
    dict of str to Evidence

    Raises
    ------
    ModelError
        If something else was given, or an estimator is ambiguous or missing.
    DataMismatchError
        If the models were given different data.
    """
    if not isinstance(given, Mapping) or not given:
        raise ModelError(
            "evidences must be a mapping of model names to Evidence or DataTree with at least one "
            f"entry, got {given!r}"
        )
    found = {
        name: _chosen(name, _by_estimator(name, one), estimator) for name, one in given.items()
    }
    by_data: dict[str, list[str]] = {}
    for name, evidence in found.items():
        by_data.setdefault(evidence.data_fingerprint, []).append(name)
    if len(by_data) > 1:
        groups = " | ".join(", ".join(map(repr, names)) for names in by_data.values())
        raise DataMismatchError(
            f"evidences of different data cannot be compared; models that share data: {groups}"
        )
    return found


def _by_estimator(name: str, given: Given) -> Mapping[str, Evidence]:
    if isinstance(given, xr.DataTree):
        return stored_evidences(given, name)
    found: object = {given.estimator: given} if isinstance(given, Evidence) else given
    if isinstance(found, Mapping) and all(isinstance(one, Evidence) for one in found.values()):
        return found
    raise ModelError(f"evidences[{name!r}] must be an Evidence or a DataTree, got {given!r}")


def _chosen(name: str, found: Mapping[str, Evidence], estimator: str | None) -> Evidence:
    if estimator is None and len(found) == 1:
        return next(iter(found.values()))
    if estimator is None:
        raise ModelError(
            f"{name!r} holds the evidence of several estimators: choose one, as "
            f"estimator={next(iter(found), '')!r}, of {list(found)}"
        )
    if estimator not in found:
        raise ModelError(f"{name!r} has no evidence by {estimator!r}, only by {list(found)}")
    return found[estimator]
