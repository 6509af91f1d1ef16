"""Random numbers as a pure function of (seed, purpose, step, component, member).

The generator is Philox4x32-10 (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3"):
ten rounds that mix a counter with a key. The key is the seed and the counter is where the number is
used, so there is no state: a number depends neither on the number of members, nor on the numbers
drawn before, nor on the rank that draws it. There are no branches and no rejection, so that loops
vectorise. Normals are made by the Box-Muller transform.
"""

import numpy as np
from numba import carray, types

from pymc_statespace_filters.compiler.native.cache_key import digest
from pymc_statespace_filters.compiler.native.entry_point import F64_PTR, EntryPoint
from pymc_statespace_filters.compiler.native.jit import inline_always, njit_contract
from pymc_statespace_filters.compiler.numerics.restricted_domain import (
    exp,
    float_of,
    log,
    sin_cos_quarter,
)

INITIAL, PROCESS, OBSERVATION, RESAMPLING, STATES = (np.uint64(purpose) for purpose in range(5))
"""Purposes: the independent streams of a step."""

BLOCK = 64
"""Rows of noise are padded to a multiple of this number of members."""

_PAIRS = BLOCK // 2

_LOW_WORD = np.uint64(0xFFFFFFFF)
_WORD_BITS = np.uint64(32)
_MULTIPLIER_0 = np.uint64(0xD2511F53)
_MULTIPLIER_1 = np.uint64(0xCD9E8D57)
_WEYL_0 = np.uint64(0x9E3779B9)
_WEYL_1 = np.uint64(0xBB67AE85)

_TWELVE = np.uint64(12)
_TWENTY = np.uint64(20)
_SWAP_BIT = np.uint64(1)
_SIGN_BIT = np.uint64(2)
_ONE = np.uint64(0x3FF0000000000000)  # the bits of 1.0
_TWO_MINUS_53 = 2.0**-53


@inline_always
def philox(c0, c1, c2, c3, k0, k1):
    """Philox4x32-10: four 32-bit words (held in uint64) from a counter of four and a key of two."""
    c0, c1, c2, c3 = c0 & _LOW_WORD, c1 & _LOW_WORD, c2 & _LOW_WORD, c3 & _LOW_WORD
    for _ in range(10):
        product_0 = _MULTIPLIER_0 * c0
        product_1 = _MULTIPLIER_1 * c2
        c0 = (product_1 >> _WORD_BITS) ^ c1 ^ k0
        c2 = (product_0 >> _WORD_BITS) ^ c3 ^ k1
        c1 = product_1 & _LOW_WORD
        c3 = product_0 & _LOW_WORD
        k0 = (k0 + _WEYL_0) & _LOW_WORD
        k1 = (k1 + _WEYL_1) & _LOW_WORD
    return c0, c1, c2, c3


@inline_always
def key_words(seed):
    """The two words of a key: the 64 bits of an integer seed, which may be negative."""
    bits = np.uint64(seed)
    return bits & _LOW_WORD, bits >> _WORD_BITS


@inline_always
def open_unit(low, high):
    """Uniform in the open interval (0, 1), symmetric about 1/2, from 52 bits of two words."""
    bits = (high << _TWENTY) | (low >> _TWELVE) | _ONE
    return (float_of(bits) - 1.0) + _TWO_MINUS_53


@inline_always
def box_muller(w0, w1, w2, w3):
    """Two independent standard normals from four 32-bit words.

    The angle is uniform in the quadrant around zero; two further bits reflect the point in the
    diagonal and in the origin, which covers the circle.
    """
    radius = np.sqrt(-2.0 * log(open_unit(w0, w1)))
    sine, cosine = sin_cos_quarter(open_unit(w2, w3) - 0.5)
    radius = radius if (w2 & _SIGN_BIT) == 0 else -radius
    swap = (w2 & _SWAP_BIT) == 0
    return radius * (cosine if swap else sine), radius * (sine if swap else cosine)


def padded(n_members: int) -> int:
    """Number of columns of a noise array for ``n_members`` members: the next multiple of 64."""
    return -(-n_members // BLOCK) * BLOCK


@njit_contract
def fill_normals(seed, purpose, step, Z, first_block=0):
    """Fill Z (components, padded members) with the standard normals of members, by blocks of 64.

    Column 0 is the first member of ``first_block``. One call of Philox makes two normals, for the
    members i and i + 32 of a block.
    """
    k0, k1 = key_words(seed)
    c2, c3 = np.uint64(step), purpose
    for component in range(Z.shape[0]):
        c1 = np.uint64(component)
        for block in range(Z.shape[1] // BLOCK):
            first = np.uint64((first_block + block) * _PAIRS)
            lower = Z[component, block * BLOCK : block * BLOCK + _PAIRS]
            upper = Z[component, block * BLOCK + _PAIRS : (block + 1) * BLOCK]
            for pair in range(_PAIRS):
                w0, w1, w2, w3 = philox(first + np.uint64(pair), c1, c2, c3, k0, k1)
                lower[pair], upper[pair] = box_muller(w0, w1, w2, w3)


@inline_always
def uniform_at(seed, purpose, step, component):
    """A single uniform number in (0, 1)."""
    k0, k1 = key_words(seed)
    zero = np.uint64(0)
    w0, w1, _, _ = philox(zero, np.uint64(component), np.uint64(step), purpose, k0, k1)
    return open_unit(w0, w1)


@inline_always
def exponential(z0, z1):
    """A standard exponential from two independent standard normals."""
    return 0.5 * (z0 * z0 + z1 * z1)


@inline_always
def uniform(z0, z1):
    """A uniform number in (0, 1] from two independent standard normals."""
    return exp(-exponential(z0, z1))


def _fill(seed, purpose, step, first_block, z, n_rows, width):
    fill_normals(seed, np.uint64(purpose), step, carray(z, (n_rows, width)), first_block)


_ARGUMENTS = {
    "seed": types.int64, "purpose": types.int64, "step": types.int64, "first_block": types.int64,
    "z": F64_PTR, "n_rows": types.intp, "width": types.intp,
}  # fmt: skip

FILL_NORMALS = EntryPoint(_fill, _ARGUMENTS, "fill_normals", digest("fill_normals"))
"""`fill_normals` of an array given by its address, compiled once for all filters."""
