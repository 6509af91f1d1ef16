"""Rows that fix more numbers exactly than are random: a record without a density."""

import numpy as np
from pytensor.compile.sharedvalue import SharedVariable

from ..compiler.lowering.compiled_system import compile_system
from ..compiler.lowering.directions import Directions
from ..errors import ModelError
from ..filters.checks import check_system_and_filter
from ..filters.protocol import Filter
from ..system.record import Record


def check_rows(record: Record, filter: Filter, *, goes_on: bool = False) -> None:
    """Raise if a filter cannot treat the steps and values of a record, or rows have no density.

    The latter is not asked of rows that go on from others.
    """
    if record.system.has_instant_steps or record.system.is_censored:
        check_system_and_filter(record.system, filter)
    if not goes_on:
        check_exact_rows(record)


def check_exact_rows(record: Record) -> None:
    """Raise if sensors without noise see more numbers than are random: stochastic singularity.

    The predicted covariance of such a row is singular, and the likelihood that a filter computes is
    rounding, which may be finite.
    """
    observed, system = record.observed, record.system
    if isinstance(observed, SharedVariable):
        observed = observed.get_value()
    compiled = compile_system(system)
    if not (isinstance(observed, np.ndarray) and compiled.has_exact_sensor):
        return
    directions = compiled.directions
    for label, axis, own in zip(
        record.records.labels, record.axes, record.records.slices(), strict=True
    ):
        rows = observed[own]
        if (found := _singular_row(directions, axis.steps, rows)) is not None:
            row, n_random = found
            seen = np.flatnonzero(directions.exact & ~np.isnan(rows[row]))
            names = ", ".join(system.observables[i] for i in seen)
            of_record = f" of the record {label!r}" if record.is_panel else ""
            raise ModelError(
                f"observed has a stochastic singularity in row {own.start + row}{of_record}, at "
                f"step {axis.steps[row]}: the sensors without noise, {names}, fix {len(seen)} "
                f"number{'s' * (len(seen) > 1)}, and at most {n_random} can vary given the rows "
                "before, so that the record has no density. Give sensors noise "
                "(observation_noise), leave one out (NaN in its column), or let more independent "
                "noises reach the state"
            )


def _singular_row(
    directions: Directions, steps: np.ndarray, observed: np.ndarray
) -> tuple[int, int] | None:
    """The first row that fixes more numbers than are random, and how many are; None if none does.

    Each step adds the numbers of its noises, up to those of the state; a row takes away those that
    it fixes.
    """
    n_random, before = directions.at_start, 0
    n_fixed = np.count_nonzero(directions.exact & ~np.isnan(observed), axis=1)
    for row, (step, fixed) in enumerate(zip(steps.tolist(), n_fixed.tolist(), strict=True)):
        n_random = min(directions.n, n_random + directions.per_step * (step - before))
        if fixed > n_random:
            return row, n_random
        n_random, before = n_random - fixed, step
    return None
