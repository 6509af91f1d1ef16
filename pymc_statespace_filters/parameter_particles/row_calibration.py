"""Rows against their predictions from the rows before, with the parameters integrated out.

Particles are drawn by their weights, a state is drawn from the filter of each, led to the row, and
an observation of that state is simulated. The rank of what was observed among these is its
probability integral transform: uniform and independent from row to row if the data are from the
model, prior included, and if the filter is exact (Dawid 1984, "Statistical theory: the prequential
approach", J. R. Stat. Soc. A 147, 278-292).
"""

import numpy as np
from numpy.typing import NDArray

from ..compiler.native.python_call import call_machine_code
from ..evaluation.simulate import observer
from ..smc.merging import merged_index
from ..smc.particles import Populations
from ..statistics.pit import pit_of
from ..system.input_columns import flags_at
from .observed_rows import ObservedRows

N_PREDICTED = 1000  # draws of the prediction of a row, at most

Array = NDArray[np.float64]


def transform_of_row(
    rows: ObservedRows,
    others: Populations,
    log_evidences: Array,
    row: int,
    rng: np.random.Generator,
) -> Array:
    """The transform (p,) of each component of a row that the particles have not seen.

    NaN where it is missing or does not count, and of a system that simulates no observation.
    """
    observed, equations = rows.record.observed[row], rows.variable.system.equations
    simulates = equations.observation is not None or equations.observation_draw is not None
    if not simulates or row < rows.variable.score_from or np.isnan(observed).all():
        return np.full(observed.shape, np.nan)
    count = min(N_PREDICTED, len(others.particles.x))
    particles = others.particles.at(merged_index(others, log_evidences, count, rng))
    theta = rows.parameters(particles.x)
    states = rows.drawn_before(particles, row, rng)
    known = np.isfinite(states).all(axis=1)
    predicted = np.full((count, observed.size), np.nan)
    step = np.full(known.sum(), rows.record.steps[row])
    record = rows.record
    predicted[known] = call_machine_code(
        observer(rows.variable.system).function, rng, theta[known], states[known], step,
        record.inputs, float(record.t0),
    )  # fmt: skip
    (flags,) = flags_at(rows.variable.system, record.inputs, record.steps[[row]])
    return pit_of(observed, predicted, rng, flags)
