"""A run of a filter at fixed parameters, without PyMC: likelihood terms and filtered states.

A run that goes on with more rows begins with what an earlier one has stored.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from ..compiler.lowering.compiled_system import compile_system
from ..compiler.numerics.philox import seeds_of_records
from ..errors import ModelError
from ..filters.checks import check_choice
from ..filters.protocol import Filter, properties
from ..ops.base import evaluator
from ..ops.states import FilterRun, States
from ..system.clock import Clock
from ..system.given_record import GivenRecord
from ..system.input_columns import resets_at, with_resets
from ..system.model import StateSpaceModel
from ..system.own_units import run_in_own_units
from ..system.parameters import panel_parameters
from ..system.placement import Earlier
from ..system.record import check_seed, read_record
from ..system.steps import check_at, rows_at
from .exact_rows import check_rows
from .health import Health

STATE, _RECORD, _RESETS = "filter_state", "filter_state_record", "accumulators_reset"


def run_filter(
    system: StateSpaceModel,
    filter: Filter,
    params: Mapping[str, Any],
    observed: Any,
    *,
    steps: Any = None,
    times: Any = None,
    panel: Any = None,
    inputs: Any = None,
    t0: Any = 0.0,
    unit: Any = None,
    input_times: Any = None,
    inputs_at: str = "hold",
    events: Any = None,
    censored: Any = None,
    seed: int = 0,
    at: str = "observations",
    state: xr.Dataset | None = None,
) -> xr.Dataset:
    """Run a filter along a record at one value of each parameter, and return terms and states.

    Parameters
    ----------
    system : StateSpaceModel
    filter : a filter of the package, such as EKF, GuidedPF, IMM or FiniteStateFilter
    params : mapping
        A value for every parameter; in a panel of G records, one for all or one for each.
    observed, steps, times, panel, inputs, t0, unit, input_times, inputs_at, events, censored
        The record, or the records of a panel, as in `log_likelihood`.
    seed : int
        Seed of the noise inside the filter, if it has any. The run is that of `log_likelihood` with
        this seed.
    at : {"observations", "steps"}
        When the states are kept: at the observations, or at every step from 0 to the last of them.
    state : xarray.Dataset, optional
        An earlier run, of the same system, filter, parameters, seed and t0, that goes on with these
        rows. Steps and times count from the old step 0 and come after the last old row; ``inputs``
        cover old and new steps; of a panel, every record goes on. Terms and states are those of one
        run over all rows, bit for bit (`FiniteStateFilter`: to rounding; `GridFilter`: to its
        tolerance). `GuidedPF` looks ahead at the rows that it is given: its terms are those of a
        run in the same parts, and its estimate is unbiased in any parts.

    Returns
    -------
    xarray.Dataset
        For the state given the observations up to its time: ``mean`` and ``sd`` (time, state), and
        the covariance ``cov`` (time, state, state_bis). With EnKF and the particle filters also
        ``particles`` (time, particle, state) and ``weights`` (time, particle) before resampling;
        the weights sum to one; a particle that is not finite has weight zero, and where none is
        finite mean and covariance are NaN. With `FiniteStateFilter` the particles are all values of
        the states, and ``most_probable_path`` (time, state) is the path of most probability given
        all observations (Viterbi); not of a run that goes on. ``log_likelihood`` (obs_time) holds
        the terms log p(d_j | d_1 .. d_{j-1}). From an observation at which the filter fails on,
        terms are -inf and states NaN. Of a panel, the dimension of the states is ``row`` instead of
        ``time``, with the coordinates ``record``, ``step`` and ``time`` of each row, the records
        one below the other; that of ``log_likelihood`` is ``obs``, with ``obs_record``,
        ``obs_step`` and ``obs_time``. ``filter_state`` is what the filter goes on from with
        ``state``, a vector, or one for each record of a panel.

    Raises
    ------
    ModelError
        If an argument does not fit the system, or ``state`` is of a run that failed or differs in
        more than its rows.

    Warns
    -----
    FilterWarning
        If the filter failed or its particles collapsed, if it linearises an equation that jumps
        as the state moves, or if its members are all the same.

    See Also
    --------
    log_likelihood : The terms alone, at many parameters.
    filtered_states : The states at draws of a posterior.

    Notes
    -----
    The particles of every time are stored: (states + 1) x particles x times x 8 bytes.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> run = psf.run_filter(system, psf.BootstrapPF(500), {"a": 0.9}, [0.3, 1.2], steps=[0, 3])
    >>> run["particles"].sizes
    Frozen({'time': 2, 'particle': 500, 'state': 1})
    """
    check_choice(system, filter)
    check_at(at)
    noise = check_seed("seed", seed)
    if noise.ndim:
        raise ModelError(f"run_filter takes one seed, got an array of {noise.shape}")
    given = GivenRecord(
        observed, panel, steps, times, inputs, t0, unit, input_times, inputs_at, events, censored
    )
    earlier = None
    if state is not None:
        system, earlier = _earlier(system, state)
    record = read_record(system, given, earlier)
    # Censored or not, the rows of a run are of one system.
    written = system.at_any_times if record.system.is_at_any_times else system
    system, axes, labels = record.system, record.axes, record.labels
    of_each = list(panel_parameters(system, params, record.records))
    seeds = seeds_of_records(noise, record.records.codes) if record.is_panel else [noise]
    arguments: list[Any] = [
        (theta, *alone, seed)
        for theta, alone, seed in zip(of_each, record.each(), seeds, strict=True)
    ]
    common = attributes(written, filter, of_each, noise, record.t0)
    check_rows(record, filter, goes_on=state is not None)
    ends = [float(axis.times(axis.steps[-1])) for axis in axes]
    clock = record.clock.stored() | {"ends": ends}
    if system.accumulators:
        clock[_RESETS] = np.concatenate([resets_at(system, each[2][-1]) for each in arguments])
    first = [np.int64(0)] * len(arguments)
    before = [np.empty(0)] * len(arguments)
    if state is not None:
        before = states_before(state, filter, common, labels)
        names = labels or [None]
        resets = np.reshape(state.attrs.get(_RESETS, ()), (len(names), -1))
        each_one = zip(arguments, before, resets, names, strict=True)
        arguments = [going_on(system, *one) for one in each_one]
        first = [np.int64(one[0]) + 1 for one in before]
    at_steps = [each[1] for each in arguments]
    rows = [own[own >= k] for own, k in zip((rows_at(at, s) for s in at_steps), first, strict=True)]
    evaluate = evaluator(FilterRun(system, filter))
    parts = zip(arguments, rows, before, strict=True)
    runs = [evaluate(*each, own, start) for each, own, start in parts]
    terms, health, *states, left = (list(results) for results in zip(*runs, strict=True))
    Health(system, filter, np.array(health), lambda i: arguments[i], labels).tell()
    row_dim, term_dim = ("time", "obs_time") if panel is None else ("row", "obs")
    are_points = (
        bool(system.drifting)
        and filter.law_of_state(compile_system(system), left[0][np.newaxis]).are_points
    )
    dataset = _dataset(system, row_dim, *map(np.concatenate, states), are_points=are_points)
    dataset = dataset.assign(log_likelihood=(term_dim, np.concatenate(terms)))
    dataset = dataset.assign(stored(left, labels))
    if properties(filter).finds_path and state is None:
        evaluate = evaluator(States(system, filter, "most probable"))
        paths = [evaluate(*each, own, 0)[0] for each, own in zip(arguments, rows, strict=True)]
        dataset["most_probable_path"] = (row_dim, "state"), np.concatenate(paths)
    if record.is_panel:
        coords: Any = record.coords(row_dim, rows) | record.coords(term_dim, at_steps, "obs_")
    else:
        coords = {row_dim: record.times(rows), term_dim: record.times(at_steps)}
    return dataset.assign_coords(coords).assign_attrs(common, at=at, **clock)


def _earlier(system: StateSpaceModel, state: Any) -> tuple[StateSpaceModel, Earlier | None]:
    """The system of an earlier run, on a grid or not, and where its records go on."""
    if not isinstance(state, xr.Dataset) or STATE not in state:
        return system, None  # refused later, with the reason
    attrs = Clock().stored() | {"ends": [], "t0": 0.0} | state.attrs
    clock = Clock.restored(attrs)
    steps = [int(one[0]) if np.isfinite(one[0]) else 0 for one in np.atleast_2d(state[STATE])]
    ends = list(map(float, np.atleast_1d(attrs["ends"])))
    is_same = attrs["system"] == system.fingerprint
    if not is_same and system.why_one_length is None:
        any_times = system.at_any_times
        if attrs["system"] == any_times.fingerprint:
            return any_times, Earlier(clock, float(attrs["t0"]), steps, ends)
    return system, Earlier(clock, float(attrs["t0"]), steps, None)


def _dataset(
    system: StateSpaceModel,
    dim: str,
    mean: np.ndarray,
    cov: np.ndarray,
    members: np.ndarray,
    weights: np.ndarray,
    *,
    are_points: bool,
) -> xr.Dataset:
    """States along ``dim``, with members if the filter has any."""
    law = mean, cov
    mean, cov, members = run_in_own_units(system, law, members, weights, are_points=are_points)
    variances = np.diagonal(cov, axis1=1, axis2=2)
    found: dict[str, tuple] = {
        "mean": ((dim, "state"), mean),
        "sd": ((dim, "state"), np.sqrt(np.maximum(variances, 0.0))),
        "cov": ((dim, "state", "state_bis"), cov),
    }
    if weights.shape[1]:
        found["particles"] = ((dim, "particle", "state"), members)
        found["weights"] = ((dim, "particle"), weights)
    names = list(system.states)
    return xr.Dataset(found, coords={"state": names, "state_bis": names})


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

    Raises `ModelError` if the earlier run is not one of the same filter, system, parameters, seed
    and records, or failed.
    """
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
    system: StateSpaceModel,
    arguments: tuple,
    before: np.ndarray,
    resets: np.ndarray,
    label: Any = None,
) -> tuple:
    """The arguments of a run for the rows after an earlier one.

    ``resets`` tells which accumulators start anew after its last row.
    """
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
        inputs[last] = with_resets(system, inputs[last], resets)
    return theta, steps, observed, inputs, *others


def stored(states: Sequence[np.ndarray], labels: Sequence[Any] | None) -> dict[str, Any]:
    """Variables of a run that goes on: its state, one for each record of a panel."""
    if labels is None:
        return {STATE: ((f"{STATE}_number",), states[0])}
    return {
        STATE: ((_RECORD, f"{STATE}_number"), np.stack(states)),
        _RECORD: ((_RECORD,), np.asarray(labels)),
    }
