"""The normals of one evaluation: made from a seed where they are used, or stored beforehand.

Stored normals are those that the seed would give: first those of the initial state, then those of
every step, then for every observation those of its simulated noise and of a resampling. Their
places do not depend on the data or the parameters, so that noise can be held, or changed a little,
while these change.
"""

from typing import NamedTuple

import numpy as np
from numba import carray

from ...compiler.native.entry_point import pointer
from ...compiler.native.jit import inline_always, njit_internal
from ...compiler.native.plan import (
    DAMAGED,
    N_RECORD,
    N_REQUEST,
    N_RESULTS,
    RECORD,
    REQUEST,
    RESULTS,
    plan_entry,
    plan_words,
)
from ...compiler.numerics.normals import FILL_NORMALS
from ...compiler.numerics.philox import INITIAL, OBSERVATION, PROCESS, RESAMPLING
from ..plan import VERSION, settings_of

_fill = FILL_NORMALS.external
_NUMBER_BYTES = 8


class NoiseSizes(NamedTuple):
    """Rows of ``width`` normals at the start, a step and an observation; normals of a resampling.

    A row has one normal for each member and is padded to whole blocks.
    """

    width: int
    initial: int
    process: int
    observation: int
    resampling: int


NO_NOISE = NoiseSizes(0, 0, 0, 0, 0)


class Noise(NamedTuple):
    """Source of one evaluation's normals: ``stored``, or ``seed`` where nothing is stored.

    Rows are those of our own members, which begin with ``first_block``. What is stored is of all
    members: there, all must be our own. Purposes count from ``first_purpose`` on, so that streams
    of one seed that begin elsewhere are independent.
    """

    seed: int
    first_purpose: int
    stored: np.ndarray
    buffer: np.ndarray
    sizes: NoiseSizes
    n_steps: int
    first_block: int


@njit_internal
def noise_of(seed, stored, sizes, n_steps, first_block, first_purpose=0):
    """The source of normals for a record whose last observation is at step ``n_steps``."""
    rows = max(sizes.initial, sizes.process, sizes.observation)
    buffer = np.empty(0 if stored.size else max(rows * sizes.width, sizes.resampling))
    return Noise(seed, first_purpose, stored, buffer, sizes, n_steps, first_block)


@inline_always
def n_stored(sizes, n_steps, n_observations):
    """How many normals an evaluation stores; those of one more observation begin there."""
    of_states = (sizes.initial + n_steps * sizes.process) * sizes.width
    return of_states + n_observations * (sizes.observation * sizes.width + sizes.resampling)


@njit_internal
def _normals(noise, purpose, step, place, n_rows, width):
    # Signed: an unsigned address plus a signed number would be a float64.
    if noise.stored.size > 0:
        return np.int64(noise.stored.ctypes.data) + _NUMBER_BYTES * place
    address = np.int64(noise.buffer.ctypes.data)
    purpose += noise.first_purpose
    _fill(noise.seed, purpose, step, noise.first_block, address, n_rows, width)
    return address


@njit_internal
def initial_normals(noise):
    """Address of the normals of the start."""
    sizes = noise.sizes
    return _normals(noise, np.int64(INITIAL), np.int64(0), np.int64(0), sizes.initial, sizes.width)


@njit_internal
def initial_rows(noise):
    """The normals of the start, a matrix (n, width)."""
    initial_normals(noise)
    rows, width = noise.sizes.initial, noise.sizes.width
    given = noise.stored if noise.stored.size > 0 else noise.buffer
    return given[: rows * width].reshape(rows, width)


@njit_internal
def process_normals(noise, k):
    """Address of the normals of step k."""
    sizes = noise.sizes
    place = (sizes.initial + k * sizes.process) * sizes.width
    return _normals(noise, np.int64(PROCESS), k, place, sizes.process, sizes.width)


@njit_internal
def process_rows(noise, k):
    """The normals of step k, a matrix (m, width), after `process_normals`."""
    rows, width = noise.sizes.process, noise.sizes.width
    first = (noise.sizes.initial + k * rows) * width if noise.stored.size > 0 else 0
    given = noise.stored if noise.stored.size > 0 else noise.buffer
    return given[first : first + rows * width].reshape(rows, width)


@njit_internal
def observation_normals(noise, j, k):
    """Address of the normals of the simulated observation j, at step k."""
    sizes = noise.sizes
    place = n_stored(sizes, noise.n_steps, j)
    return _normals(noise, np.int64(OBSERVATION), k, place, sizes.observation, sizes.width)


@njit_internal
def resampling_normals(noise, j, k):
    """Normals of a resampling after observation j, at step k, a vector; on every rank the same."""
    sizes = noise.sizes
    if noise.stored.size > 0:
        place = n_stored(sizes, noise.n_steps, j) + sizes.observation * sizes.width
        return noise.stored[place : place + sizes.resampling]
    one, first, address = np.int64(1), np.int64(0), noise.buffer.ctypes.data
    purpose = np.int64(RESAMPLING) + noise.first_purpose
    _fill(noise.seed, purpose, k, first, address, one, sizes.resampling)
    return noise.buffer[: sizes.resampling]


@inline_always
def sizes_of(settings):
    """The sizes that follow the number of members in the settings of a filter."""
    return NoiseSizes(
        int(settings[1]), int(settings[2]), int(settings[3]), int(settings[4]), int(settings[5])
    )


def _store(plan, record, request, results):
    words = plan_words(plan, VERSION)
    if words.size == 0:
        return np.int64(DAMAGED)
    given, sizes = carray(record, (N_RECORD,)), sizes_of(settings_of(words))
    to, asked = carray(results, (N_RESULTS,)), carray(request, (N_REQUEST,))
    steps = carray(pointer(given[RECORD.rows]), (given[RECORD.n_rows],), np.int64)
    n_steps = steps[-1] if steps.size else np.int64(0)
    to[RESULTS.n_normals] = n_stored(sizes, n_steps, steps.size)
    if asked[REQUEST.sizes_only]:
        return np.int64(0)
    seed, width, one, first = asked[REQUEST.seed], sizes.width, np.int64(1), np.int64(0)
    at = to[RESULTS.normals]
    _fill(seed, np.int64(INITIAL), first, first, at, sizes.initial, width)
    at += _NUMBER_BYTES * sizes.initial * width
    for k in range(n_steps):
        _fill(seed, np.int64(PROCESS), np.int64(k), first, at, sizes.process, width)
        at += _NUMBER_BYTES * sizes.process * width
    for k in steps:
        _fill(seed, np.int64(OBSERVATION), k, first, at, sizes.observation, width)
        at += _NUMBER_BYTES * sizes.observation * width
        _fill(seed, np.int64(RESAMPLING), k, first, at, one, sizes.resampling)
        at += _NUMBER_BYTES * sizes.resampling
    return np.int64(0)


STORE_NORMALS = plan_entry(_store, "store_normals", needs=(FILL_NORMALS,))
"""Write the normals of a whole evaluation, `n_stored` of them."""
