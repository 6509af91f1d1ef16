"""Where a sequential run stands, as a Dataset from which it goes on, also after netCDF.

It holds the particles with their weights, before any resampling for the posterior, the states of
their filters, what the pilot has learnt, the record so far, and the key of the random numbers. The
numbers of a row are a function of this key and the row, so that a run that goes on has the bits of
one run over all rows.
"""

import json
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.traversal import graph_inputs

from ..errors import DataMismatchError, ModelError
from ..filters.written import filter_from
from ..pymc_model.filter_rows import Record
from ..pymc_model.inspection import log_density_graph
from ..pymc_model.other_filter import model_with
from ..pymc_model.posterior_draws import COURSE
from ..smc.bridge import Cloud
from ..smc.moves import Size
from ..smc.particles import Particles, Populations
from ..system.clock import Clock
from ..system.graph_digest import described, digest, graph_digest
from .observed_rows import ObservedRows
from .particle_request import Request, columns_of, steps_of
from .sequential_run import Progress, RowCourse, n_members

GROUP = "smc_state"
_POPULATIONS = ("pilot", "others")
_PATHS = {"log_evidence": "log_evidence_so_far"}  # fields of `RowCourse` by other names


def stored(progress: Progress, request: Request) -> xr.Dataset | None:
    """The state of a run; None of a model that no text identifies in another process."""
    identity = None
    with suppress(ModelError):
        identity = _identity(progress.rows)
    if identity is None:
        return None
    arrays = {f"record_{name}": values for name, values in progress.rows.record._asdict().items()}
    arrays |= arrays_of_cloud(progress.cloud)
    found = {
        name: ([f"{name}_dim_{i}" for i in range(np.ndim(values))], values)
        for name, values in arrays.items()
        if np.size(values)
    }
    attrs = {
        "model": identity,
        **progress.rows.variable.clock.stored(),
        "entropy": json.dumps(request.entropy),
        "draws": request.draws,
        "waste_free": int(request.size.waste_free),
        "populations": request.n_populations,
        "n_members": n_members(progress.rows),
        "inner": request.inner,
        "screen": request.screen,
    }
    return xr.Dataset(found, attrs=attrs)


def restored(idata: xr.DataTree, model: pm.Model) -> tuple[Progress, Request]:
    """The run of a result of a model, with the record that it has seen.

    Raises `ModelError` if the result is not of a sequential run that can go on; `DataMismatchError`
    if it is of another model.
    """
    if not isinstance(idata, xr.DataTree) or GROUP not in idata.children:
        raise ModelError(
            f"idata must have the group {GROUP!r}, as sample_smc(data='sequential') returns it, "
            f"got {sorted(idata.children) if isinstance(idata, xr.DataTree) else type(idata)}"
        )
    state = idata[GROUP].to_dataset()
    attrs = state.attrs
    inner = filter_from(str(attrs["inner"]))
    model = model if inner is None else model_with(model, "inner", inner)
    rows = ObservedRows.of(model, filter_from(str(attrs["screen"])))
    if _identity(rows) != attrs["model"]:
        raise DataMismatchError(
            "model must be that of idata: its priors, parameters, system, filter or values of "
            "pm.Data are others"
        )
    draws, populations = int(attrs["draws"]), int(attrs["populations"])
    size = Size.of(draws, bool(attrs["waste_free"]))
    filters = str(attrs["inner"]), str(attrs["screen"])
    request = Request(draws, size, populations, tuple(json.loads(attrs["entropy"])), *filters)
    if attrs["n_members"] != n_members(rows):
        rows = rows.of_size(int(attrs["n_members"]))
    cloud = cloud_of_arrays({str(name): array.values for name, array in state.items()})
    # The dates of a run count from its own origin, whatever the record of a later model.
    rows = rows.with_clock(Clock.restored(attrs)).with_record(_record(state, rows))
    return Progress(rows, cloud, _courses(idata[COURSE].to_dataset())), request


def arrays_of_cloud(cloud: Cloud) -> dict[str, np.ndarray]:
    """Particles with their weights, and what the pilot has learnt, by name."""
    found = {"scale": np.array(cloud.scale)}
    for prefix, one in zip(_POPULATIONS, (cloud.pilot, cloud.others), strict=True):
        found |= {f"{prefix}_{name}": values for name, values in one.particles._asdict().items()}
        found[f"{prefix}_log_weights"] = one.log_weights
    return found


def cloud_of_arrays(arrays: Mapping[str, np.ndarray]) -> Cloud:
    """The same from these arrays, of which empty ones may be missing."""
    pilot, others = (_populations(arrays, prefix) for prefix in _POPULATIONS)
    return Cloud(pilot, others, float(arrays["scale"]))


def _populations(arrays: Mapping[str, np.ndarray], prefix: str) -> Populations:
    n = len(arrays[f"{prefix}_x"])
    empty = {"seeds": np.empty((n, 0), np.int64), "states": np.empty((n, 0))}
    fields: dict[str, Any] = {
        name: arrays.get(f"{prefix}_{name}", empty.get(name)) for name in Particles._fields
    }
    return Populations(Particles(**fields), arrays[f"{prefix}_log_weights"])


def arrays_of_progress(progress: Progress) -> dict[str, np.ndarray]:
    """Where a run stands, on its way through a record that is known."""
    courses = {f"row_{name}": values for name, values in columns_of(progress.courses).items()}
    members = {"n_members": np.array(n_members(progress.rows))}
    return arrays_of_cloud(progress.cloud) | courses | members


def progress_of_arrays(arrays: Mapping[str, np.ndarray], rows: ObservedRows) -> Progress:
    """The same from these arrays and the record."""
    if (size := int(arrays["n_members"])) != n_members(rows):
        rows = rows.of_size(size)
    return Progress(rows, cloud_of_arrays(arrays), steps_of(RowCourse, arrays, "row_"))


def _record(state: xr.Dataset, rows: ObservedRows) -> Record:
    inputs = np.zeros((0, rows.variable.system.n_input_columns))
    if "record_inputs" in state:
        inputs = state["record_inputs"].values
    steps, observed = state["record_steps"].values, state["record_observed"].values
    return Record(steps, observed, inputs, np.asarray(state["record_t0"].values))


def _courses(course: xr.Dataset) -> list[RowCourse]:
    by_row = {name: course[_PATHS.get(name, name)] for name in RowCourse._fields}
    arrays = {name: one.transpose("row", ...).values for name, one in by_row.items()}
    return steps_of(RowCourse, arrays)


def _identity(rows: ObservedRows) -> str:
    """A text that is the same for models that differ in their record alone."""
    model, variable = rows.model, rows.variable
    free = [model.rvs_to_values[rv] for rv in model.free_RVs]
    graphs = [
        log_density_graph(model, model.free_RVs),
        *model.replace_rvs_by_values([variable.theta]),
    ]
    known = {value: digest("value of", str(value.name)) for value in free}
    for own in graph_inputs(graphs):
        if isinstance(own, SharedVariable):
            value = own.get_value(borrow=True)
            known[own] = digest(described(f"the value of {own.name}", value))
    facts = [variable.name, variable.system.fingerprint, repr(variable.filter)]
    facts += [str(variable.score_from), repr(variable.clock.unit)]
    return digest(*facts, graph_digest(graphs, known))
