"""A sequential run led to the end of its record, and its DataTree."""

import json
from time import perf_counter

import numpy as np
import xarray as xr
from pymc.stats.convergence import SamplerWarning, WarningType, log_warnings

from ..evidence.observed_data import Observed
from ..filters.written import short_form
from ..progress import stage_progress
from ..pymc_model.posterior_draws import COURSE, SEQUENTIAL
from .observed_rows import ObservedRows
from .output import DoubtsOf, as_datatree
from .particle_request import Request
from .sequential_run import Progress, advance
from .stored_run import GROUP, arrays_of_progress, stored
from .stored_steps import StoredSteps


def finished(
    progress: Progress,
    request: Request,
    doubts_of: DoubtsOf,
    steps: StoredSteps,
    *,
    progressbar: bool,
) -> xr.DataTree:
    """The result of a run that is led through all rows of its record, or until an interrupt."""

    def on_row(now: Progress) -> None:
        is_last = now.n_rows == n_rows
        steps.save(lambda: arrays_of_progress(now) | request.arrays, is_last=is_last)
        sizes = f"effective size {now.courses[-1].effective_size.mean():.0f}"
        show(now.n_rows, f"observation {now.n_rows}, {sizes}")

    began, n_rows = perf_counter(), len(progress.rows.record.steps)
    with stage_progress(n_rows, enabled=progressbar) as show:
        progress = advance(progress, request, on_row)
    rows, run = progress.rows, progress.as_run()
    if progress.n_rows < n_rows:
        log_warnings([_interrupted_warning(progress.n_rows, n_rows)])
    likelihood = run.cloud.others.particles.log_likelihood
    tree = as_datatree(
        rows.model,
        run,
        request,
        [_observed(rows)],
        data=SEQUENTIAL,
        seconds=perf_counter() - began,
        # With noise the largest of many estimates says nothing of the maximum.
        maximum=np.nan if rows.filter.noisy else float(likelihood.max()),
        doubts_of=doubts_of,
        filter=rows.filter,
    )
    name, dims = rows.variable.name, rows.variable.dims
    # The filter may have more members than that of the model, and the record more rows.
    tree.attrs["filter"] = json.dumps({name: short_form(rows.filter)})
    data = tree["observed_data"].to_dataset().drop_dims(dims[0], errors="ignore")
    coords = {dims[0]: rows.shown_times, dims[1]: list(rows.variable.system.observables)}
    array = xr.DataArray(rows.record.observed, coords, dims)
    tree["observed_data"] = xr.DataTree(data.assign({name: array}))
    course = (
        tree[COURSE].to_dataset().assign_coords(row=rows.shown_times, observable=coords[dims[1]])
    )
    tree[COURSE] = xr.DataTree(course)
    if (state := stored(progress, request)) is not None:
        tree[GROUP] = xr.DataTree(state)
    return tree


def _interrupted_warning(n_seen: int, n_rows: int) -> SamplerWarning:
    text = (
        f"The run was interrupted: the result knows {n_seen} of {n_rows} observations. "
        "psf.extend goes on from there."
    )
    return SamplerWarning(WarningType.CONVERGENCE, text, "warn")


def _observed(rows: ObservedRows) -> Observed:
    values, score_from = rows.record.observed, rows.variable.score_from
    return Observed(values, [values], True, score_from, slice(score_from, None))
