"""The posterior row by row: one update of every filter, and moves where particles run short.

Where the effective size of the pilot falls to half of its particles, all populations are moved, by
proposals whose filters pass over all rows so far (Chopin 2002, "A sequential particle filter method
for static models", Biometrika 89, 539-551). With a noisy filter this is SMC^2 (Chopin, Jacob and
Papaspiliopoulos 2013, "SMC^2", J. R. Stat. Soc. B 75, 397-426).

After moves the variance of the log-likelihood at fixed parameters is measured at particles of the
pilot. If it is large, the filters get twice as many members: the ratio of the new estimates to the
old ones is a further factor, whose powers lead the populations across (`smc.bridge`) and whose
weights enter the evidence.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Self

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..errors import ModelError
from ..parallel.signals import interrupts_are_noted, unless_interrupted
from ..smc.bridge import Cloud, Crossed, Stage, cross, sizes_of_evidence
from ..smc.merging import merged_scores
from ..smc.particles import Populations
from ..statistics.importance import systematic
from .observed_rows import ObservedRows, exchanged, exchanging
from .particle_request import Request, Run, check_alive, columns_of, least_alive
from .row_calibration import transform_of_row

MAX_VARIANCE = 2.0  # of the log-likelihood at fixed parameters; beyond it members are doubled
N_POINTS, N_REPEATS = 8, 8  # at and by which it is measured
_PRIOR, _ROW, _PREDICTED = 0, 1, 2  # keys of random numbers

Array = NDArray[np.float64]


class RowCourse(NamedTuple):
    """What happened at one row; of the populations (R,), log-evidences are those so far."""

    log_evidence: Array
    pit: Array  # of each observable, before the row was seen
    effective_size: Array
    n_alive: NDArray[np.int64]  # particles of positive likelihood, before any move
    n_stages: int
    acceptance: float
    n_members: int
    variance: float
    n_updates: int  # of filters, by one row


class Progress(NamedTuple):
    """A run after some rows: where it stands, what it has led through, and what goes on."""

    rows: ObservedRows
    cloud: Cloud
    courses: list[RowCourse]

    @classmethod
    def before_any_row(cls, rows: ObservedRows, request: Request) -> Self:
        """Draws of the prior."""
        particles = rows.drawn(request.n_particles, request.generator(_PRIOR))
        return cls(rows, request.cloud(particles), [])

    @property
    def n_rows(self) -> int:
        """Rows so far."""
        return len(self.courses)

    @property
    def log_evidences(self) -> Array:
        """Of each population, (R,)."""
        if not self.courses:
            return np.zeros(len(self.cloud.others.log_weights))
        return self.courses[-1].log_evidence

    def as_run(self) -> Run:
        """For the output."""
        return Run(self.cloud, self.log_evidences, course_dataset(self.courses))


def advance(progress: Progress, request: Request, on_row: Callable[[Progress], None]) -> Progress:
    """Lead a run through all rows of its record that it has not seen, or until an interrupt.

    After one the record is that of the rows seen, of which there is at least one.
    """
    while progress.n_rows < len(progress.rows.record.steps):
        if progress.n_rows > 0:
            interrupts_are_noted()
        following = unless_interrupted(partial(_next_row, progress, request), None)
        if following is None:
            seen = progress.rows.record.first(progress.n_rows)
            return progress._replace(rows=progress.rows.with_record(seen))
        progress = following
        on_row(progress)
    interrupts_are_noted()
    return progress


def _next_row(progress: Progress, request: Request) -> Progress:
    rows, cloud, row = progress.rows, progress.cloud, progress.n_rows
    rng = request.generator(_ROW, row)
    before = progress.log_evidences
    pit = transform_of_row(rows, cloud.others, before, row, request.generator(_PREDICTED, row))
    pilot, others = (
        one._replace(particles=rows.with_row(one.particles, row))
        for one in (cloud.pilot, cloud.others)
    )
    cloud = cloud._replace(pilot=pilot, others=others)
    _check_row(rows, cloud, row)
    n_alive = cloud.others.n_alive
    screen = rows.screen_at_row(row)
    found = cross(cloud, rows.at_row(row), request.size, rng, screen=screen)
    log_evidence, stages = before + found.log_ratio, found.stages
    n_updates = request.n_particles + (row + 1) * _n_evaluated(stages)
    variance = np.nan
    if stages and rows.filter.noisy:
        variance = _variance(rows, found.cloud.pilot, row + 1, rng)
        n_updates += N_POINTS * N_REPEATS * (row + 1)
        if variance > MAX_VARIANCE:
            rows, found = _doubled(rows, found.cloud, row + 1, request, rng)
            log_evidence = log_evidence + found.log_ratio
            stages = stages + found.stages
            n_updates += (row + 1) * (request.n_particles + 2 * _n_evaluated(found.stages))
    course = RowCourse(
        log_evidence,
        pit,
        sizes_of_evidence(found.cloud.others, log_evidence),
        n_alive,
        len(stages),
        float(np.mean([one.acceptance for one in stages])) if stages else np.nan,
        n_members(rows),
        variance,
        n_updates,
    )
    return Progress(rows, found.cloud, [*progress.courses, course])


def _check_row(rows: ObservedRows, cloud: Cloud, row: int) -> None:
    """Raise if too few particles of the pilot, or none of the others, can have given a row."""
    if row == 0:
        check_alive(rows.model, cloud)
    n_alive, least = int(cloud.pilot.n_alive[0]), least_alive(cloud)
    if n_alive >= least and cloud.others.n_alive.any():
        return
    shown = rows.shown_times[row]
    values = rows.record.observed[row].tolist()
    raise ModelError(
        f"observed[{row}] = {values} at {shown} has a likelihood above zero at {n_alive} of "
        f"{len(cloud.pilot.particles.x)} particles of the pilot population, where {least} are "
        f"needed, and at {cloud.others.n_alive.sum()} of {len(cloud.others.particles.x)} of the "
        "other populations: correct the row (counts are whole numbers from 0), widen the "
        "noise of the system, or raise draws"
    )


def _n_evaluated(stages: list[Stage]) -> int:
    return sum(one.n_evaluated for one in stages)


def _variance(
    rows: ObservedRows, pilot: Populations, n_rows: int, rng: np.random.Generator
) -> float:
    """The mean variance of the log-likelihood at fixed parameters, at particles of the pilot."""
    index = systematic(np.exp(pilot.log_weights[0]), N_POINTS, rng)
    x = np.repeat(pilot.particles.x[index], N_REPEATS, axis=0)
    values = rows.estimated(x, n_rows, rng)[0].reshape(N_POINTS, N_REPEATS)
    known = values[np.isfinite(values).all(axis=1)]
    return float(known.var(axis=1, ddof=1).mean()) if len(known) else np.inf


def _doubled(
    rows: ObservedRows, cloud: Cloud, n_rows: int, request: Request, rng: np.random.Generator
) -> tuple[ObservedRows, Crossed]:
    """The populations with filters of twice as many members."""
    larger = rows.of_size(2 * n_members(rows))
    pilot, others = (
        one._replace(particles=exchanged(larger, one.particles, n_rows, rng))
        for one in (cloud.pilot, cloud.others)
    )
    evaluate = exchanging(rows, larger, n_rows)
    cloud = cloud._replace(pilot=pilot, others=others)
    return larger, cross(cloud, evaluate, request.size, rng)


def n_members(rows: ObservedRows) -> int:
    """Members of the filter; 0 of one without."""
    size = getattr(rows.filter, "size", None)
    return size() if size is not None and rows.filter.noisy else 0


def course_dataset(courses: list[RowCourse]) -> xr.Dataset:
    """What happened row by row: scores and their errors, sizes, moves."""
    columns = columns_of(courses)
    paths, sizes, alive = (
        columns.pop(name).T.copy() for name in ("log_evidence", "effective_size", "n_alive")
    )
    pit = columns.pop("pit")
    scores, deviations = merged_scores(paths)
    of_populations = ("population", "row")
    return xr.Dataset(
        {
            **{name: ("row", values) for name, values in columns.items()},
            "score": ("row", scores),
            "score_se": ("row", np.sqrt((deviations**2).sum(axis=0))),
            "score_deviation": (of_populations, deviations),
            "pit": (("row", "observable"), pit),
            "effective_size": (of_populations, sizes),
            "n_alive": (of_populations, alive),
            "log_evidence_so_far": (of_populations, paths),
        }
    )
