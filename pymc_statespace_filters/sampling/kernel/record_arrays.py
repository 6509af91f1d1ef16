"""Arrays and evaluations of a chain that moves the records of a panel one by one: `record_moves`.

A position has three blocks: the own parameters of every record, the shared ones, and those of the
population. In a state some own parameters have centred coordinates, in draws those of the model.
`ChainState` and `Draws` have the same arrays as for other chains, with more columns:
the numbers of a state have the kept estimates behind the others, the counts of a draw have what
each block has accepted.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ...compiler.native.entry_point import njit_cached
from ...compiler.native.jit import copy_into, linked
from ...compiler.native.pytensor_function import Call, make_call
from ...filters.outcomes import NOT_A_NUMBER, RAISED
from .adaptation_state import pack, packed_size, start_adaptation, unpack
from .state import (
    BLOCK,
    HEALTH_SIZE,
    N_COUNTS,
    draw_seeds,
    generator_of_block,
)

# Of a chain's numbers, the first estimate: G of the records, then that of other data.
FIRST_ESTIMATE = 3
# Of the counts of a draw, the first of G: whether the record has accepted. The N_COMMON_BLOCKS
# behind them are whether the shared block has accepted, and how many moves the population has.
FIRST_ACCEPTED = N_COUNTS
# Moves of the population in an iteration: without a likelihood they cost next to nothing.
N_POPULATION_MOVES = 10
# Evaluations of an iteration, each with noise of its own: of the records, of the shared block, and
# of the interwoven one if there is any.
N_NOISES = 2


class NativeRecordDensities(NamedTuple):
    """The log-density by record as machine code calls it, and the arrays that the calls read."""

    # G likelihoods of the records, that of other data, and the health of each filter.
    likelihood: Call
    # G terms of the records, all other terms, and locations and scales of the centred places.
    prior: Call
    position: np.ndarray  # (d,)
    seeds: np.ndarray  # int64 (noisy,), of an evaluation
    n_healths: int


class RecordLayout(NamedTuple):
    """Where the blocks are in a position, and the seeds in a state."""

    own: np.ndarray  # int64 (G, k): places of a record's own parameters
    shared: np.ndarray  # int64 (s,)
    population: np.ndarray  # int64 (p,)
    # int64 (c,): places where a state has location + scale * value. The first n_standard are of
    # variables that are that value in the model, the others of variables that are as in the state.
    centred: np.ndarray
    n_standard: int
    interwoven: np.ndarray  # int64 (i,): of what locations and scales are made; of other blocks too
    # int64 (G, panels): places of the seeds of a record's estimate in those of a state
    seeds: np.ndarray
    # int64: for every seed of a state, the column of the seeds of an evaluation
    columns: np.ndarray

    @property
    def n_records(self) -> int:
        """The number of records."""
        return len(self.own)

    def blocks(self) -> list[np.ndarray]:
        """Places of each block: those of every record, then the shared one and the population.

        The last is the interwoven one, if there is any.
        """
        interwoven = [self.interwoven] if self.interwoven.size else []
        return [*self.own, self.shared, self.population, *interwoven]

    def first_adaptation(self, cov: np.ndarray) -> np.ndarray:
        """Packed states of the adaptation of every block, one after the other.

        ``cov`` is the covariance of the first proposals (d, d), or its diagonal (d,).
        """
        packed = np.zeros(sum(packed_size(len(block)) for block in self.blocks()))
        for block, part in self._adaptations(packed):
            mine = np.diag(cov[block]) if cov.ndim == 1 else cov[np.ix_(block, block)]
            pack(start_adaptation(mine), part)
        return packed

    def proposal_variances(self, packed: np.ndarray) -> np.ndarray:
        """Variances of the proposals of every parameter, (d,), from the packed states."""
        variances = np.empty(len(np.unique(np.concatenate(self.blocks()))))
        for block, part in self._adaptations(packed):
            variances[block] = np.diag(unpack(part, len(block)).cov)
        return variances

    def _adaptations(self, packed: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Each block that is not empty, and the part of the packed states that belongs to it."""
        first = 0
        for block in self.blocks():
            last = first + packed_size(len(block))
            if len(block):
                yield block, packed[first:last]
            first = last


class RecordRandomBlock(NamedTuple):
    """Random numbers of consecutive iterations, along the first axis."""

    own: np.ndarray  # (iterations, G, k), normals for the proposals
    shared: np.ndarray  # (iterations, s)
    population: np.ndarray  # (iterations, N_POPULATION_MOVES, p)
    interwoven: np.ndarray  # (iterations, i)
    # (iterations, G + 1 + N_POPULATION_MOVES), to accept; one more for the interwoven block
    log_uniforms: np.ndarray
    seeds: np.ndarray  # int64 (iterations, N_NOISES, noisy); one more for the interwoven block


def record_random_block(
    key: np.ndarray, index: int, layout: RecordLayout, n_noisy: int
) -> RecordRandomBlock:
    """Draw a chain's random numbers for iterations ``index * BLOCK`` to ``(index + 1) * BLOCK``."""
    rng = generator_of_block(key, index)
    n_more = 1 if layout.interwoven.size else 0
    n_uniforms = layout.n_records + 1 + N_POPULATION_MOVES + n_more
    return RecordRandomBlock(
        rng.standard_normal((BLOCK, *layout.own.shape)),
        rng.standard_normal((BLOCK, len(layout.shared))),
        rng.standard_normal((BLOCK, N_POPULATION_MOVES, len(layout.population))),
        rng.standard_normal((BLOCK, len(layout.interwoven))),
        -rng.standard_exponential((BLOCK, n_uniforms)),
        draw_seeds(rng, (BLOCK, N_NOISES + n_more, n_noisy)),
    )


_internal = linked()


class RecordEvaluation(NamedTuple):
    """What went wrong in one evaluation of all records."""

    failure: int  # 0, or the first failure code
    n_failed: int  # likelihoods that are minus infinity


@_internal
def _take_numbers(target, out):
    """Results of a call, with minus infinity for NaN and plus infinity; the number of these."""
    n_failed = 0
    for i in range(target.size):
        value = out[1 + i]
        target[i] = value if value < np.inf else -np.inf
        n_failed += 0 if target[i] > -np.inf else 1
    return n_failed


@njit_cached
def evaluate_likelihoods(density, estimates):
    """Estimate the likelihoods of all records at the position and seeds in the arrays.

    An estimate is never NaN or plus infinity: where the evaluation of a record failed it is minus
    infinity, and the others keep theirs.
    """
    if not make_call(density.likelihood):
        return RecordEvaluation(RAISED, 0)
    out = density.likelihood.out
    n_failed = _take_numbers(estimates, out)
    if n_failed == 0:
        return RecordEvaluation(0, 0)
    for i in range(density.n_healths):
        code = out[1 + estimates.size + HEALTH_SIZE * i + 1]
        if code != 0.0:
            return RecordEvaluation(int(code), n_failed)
    return RecordEvaluation(NOT_A_NUMBER, n_failed)


@njit_cached
def evaluate_priors(density, priors):
    """All other terms at the position in the arrays; whether the model did not raise."""
    if not make_call(density.prior):
        return False
    _take_numbers(priors, density.prior.out)
    return True


@njit_cached
def write_standard(density, layout, state, position, n_standard):
    """Write the position of a state with so many of the centred places as the values behind them.

    With ``layout.n_standard`` the coordinates are those of the model. Returns the log-Jacobian of
    those of the state; NaN if the model raised.
    """
    copy_into(position, state.position)
    if n_standard == 0:
        return 0.0
    copy_into(density.position, state.position)
    if not make_call(density.prior):
        return np.nan
    n = layout.centred.size
    first, log_jacobian = 1 + layout.own.shape[0] + 1, 0.0
    for i in range(n_standard):
        place, scale = layout.centred[i], density.prior.out[first + n + i]
        position[place] = (state.position[place] - density.prior.out[first + i]) / scale
        log_jacobian -= np.log(np.abs(scale))
    return log_jacobian


@njit_cached
def centre(density, layout, n_standard):
    """Give the position in the arrays, of `write_standard`, the coordinates of a state.

    Returns as `write_standard`. Locations and scales depend on no centred place.
    """
    if n_standard == 0:
        return 0.0
    if not make_call(density.prior):
        return np.nan
    n = layout.centred.size
    first, log_jacobian = 1 + layout.own.shape[0] + 1, 0.0
    for i in range(n_standard):
        place, scale = layout.centred[i], density.prior.out[first + n + i]
        density.position[place] = density.prior.out[first + i] + scale * density.position[place]
        log_jacobian -= np.log(np.abs(scale))
    return log_jacobian
