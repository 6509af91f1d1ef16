"""Runs of a filter that go on with more rows: what an earlier run has stored, and its checks."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from ..errors import ModelError
from ..filters.protocol import Filter
from ..system.model import StateSpaceModel

STATE, _RECORD = "filter_state", "filter_state_record"


def resumes(filter: Filter) -> bool:
    """Whether a filter can go on from its state after earlier rows."""
    return getattr(filter, "resumes", False)


def attributes(
    system: StateSpaceModel, filter: Filter, thetas: Sequence[np.ndarray], seed: Any, t0: Any
) -> dict[str, Any]:
    """What two parts of a run have in common, as attributes of its Dataset."""
    return {
        "system": system.fingerprint,
        "filter": repr(filter),
        "parameters": np.concatenate(thetas).tolist(),
        "seed": str(int(seed)),
        "t0": float(t0),
    }


def states_before(
    state: Any, filter: Filter, common: dict[str, Any], labels: Sequence[Any] | None
) -> list[np.ndarray]:
    """The state from which each record goes on, by their labels; None is a single record.

    Raises
    ------
    ModelError
        If the filter cannot go on, or the earlier run is not one of the same filter, system,
        parameters, seed and records, or failed.
    """
    if not resumes(filter):
        raise ModelError(
            f"{type(filter).__name__} cannot go on from an earlier run: "
            + (
                "its guide needs the record ahead"
                if getattr(filter, "needs_record_ahead", False)
                else "it has no state that holds for the rows to come"
            )
            + "; run it over all rows"
        )
    if not isinstance(state, xr.Dataset) or STATE not in state:
        raise ModelError(f"state must be what run_filter returned, got {type(state).__name__}")
    known = None if _RECORD not in state else state[_RECORD].values.tolist()
    if known != (None if labels is None else list(labels)):
        raise ModelError(f"state must have the records {labels}, got those of {known}")
    for name, value in common.items():
        before = state.attrs.get(name)
        if not np.array_equal(np.atleast_1d(before), np.atleast_1d(value)):
            what = "another system" if name == "system" else f"{name} {before} instead of {value}"
            raise ModelError(f"state must be of the same run, got one with {what}")
    found = np.atleast_2d(state[STATE].values)
    if not np.isfinite(found[:, 0]).all():
        raise ModelError("state must be of a run that did not fail, got one that did")
    return [np.ascontiguousarray(one) for one in found]


def going_on(
    system: StateSpaceModel, arguments: tuple, before: np.ndarray, label: Any = None
) -> tuple:
    """The arguments of a run for the rows after an earlier one."""
    theta, steps, observed, inputs, *others = arguments
    last = int(before[0])
    if steps[0] <= last:
        of_record = "" if label is None else f" of the record {label!r}"
        raise ModelError(
            f"steps must come after the last row of the earlier run{of_record}, which is at step "
            f"{last}, got {steps[0]}"
        )
    if system.accumulators:
        inputs = inputs.copy()
        inputs[last, -1] = 1.0  # they start anew after the last old row
    return theta, steps, observed, inputs, *others


def stored(states: Sequence[np.ndarray], labels: Sequence[Any] | None) -> dict[str, Any]:
    """Variables of a run that goes on: its state, one for each record of a panel."""
    if labels is None:
        return {STATE: ((f"{STATE}_number",), states[0])}
    return {
        STATE: ((_RECORD, f"{STATE}_number"), np.stack(states)),
        _RECORD: ((_RECORD,), np.asarray(labels)),
    }
