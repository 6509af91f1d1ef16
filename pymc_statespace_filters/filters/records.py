"""The records of a panel one after the other in compiled loops; rows as in `system.panel`."""

from typing import Any

import numpy as np

from ..compiler.codegen.function_types import jit
from ..compiler.numerics.record_noise import seed_of_record
from ..system.panel import FIRST_INPUT, RECORD, STEP, CheckedPanel
from .outcomes import NONE


@jit
def end_of_record(rows, first):
    """The row behind the record that begins in row ``first``."""
    last = first + 1
    while last < rows.shape[0] and rows[last, RECORD] == rows[first, RECORD]:
        last += 1
    return last


@jit
def single_record(theta, rows, observed, inputs, record, first, last):
    """Parameters, steps, data and inputs of the record in these rows, as a single one has them."""
    return (
        theta[record].copy(),
        rows[first:last, STEP].copy(),
        observed[first:last],
        inputs[rows[first, FIRST_INPUT] :],
    )


@jit
def include_health(health, of_record, first):
    """Include the health of a record whose first row is ``first`` in that of its panel."""
    health[0] = min(health[0], of_record[0])
    if health[1] == NONE and of_record[1] != NONE:
        health[1], health[2] = of_record[1], first + of_record[2]


def single_records(table: CheckedPanel, seed: Any) -> list[tuple[Any, ...]]:
    """Steps, observed, inputs, t0 and seed of every record, as a single one takes them."""
    records = table.records
    return [
        (
            table.rows[rows, STEP].copy(),
            table.observed[rows],
            table.inputs[table.rows[rows.start, FIRST_INPUT] :],
            table.t0,
            np.asarray(seed_of_record(np.int64(seed), code)),
        )
        for rows, code in zip(records.slices(), records.codes, strict=True)
    ]
