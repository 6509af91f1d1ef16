"""Standard normals of members: the Box-Muller transform of counter-based words.

A call of Philox has four words, which make four normals. Of each two words one becomes a radius,
the other a direction in the right half of the plane, whose lowest bit is the sign of both
coordinates. A uniform number of 32 bits has 2**-33 as its smallest value: radii end at 6.76, beyond
which one normal in 7e10 would lie. The polynomials err by less than 3e-8 of a radius and 4e-9 of a
coordinate, which no test of 1e10 numbers can see; longer ones would only cost time.

The transform takes three passes over a row, in place: words, radii, coordinates. A single pass has
a chain of dependent instructions too long for the processor to overlap, and takes 1.4 times as
long. Every multiplication followed by an addition is an explicit `fma`, so that the bits do not
depend on the width of the processor's vectors.
"""

import math

import numpy as np
from numba import carray, njit, types

from ..native.entry_point import F64_PTR, EntryPoint
from ..native.jit import inline_always, njit_strict
from .exponential import (
    EXPONENT_BITS,
    MANTISSA,
    ONE_OVER_SQRT_HALF,
    SQRT_HALF,
    TWO_52,
    TWO_52_BIASED,
)
from .intrinsics import bits_of, float_of, fma, polynomial
from .philox import LOW_WORD, key_words, philox
from .restricted_domain import exp

BLOCK = 64
"""Rows of noise are padded to a multiple of this number of members."""

_HALF, _QUARTER = BLOCK // 2, BLOCK // 4

_HALF_WORD = 0.5  # puts the uniform numbers into the middle of their intervals
_MIDDLE = 2.0**52 + 2.0**31
_RADIANS = math.pi * 2.0**-32
_WORD_BITS = 32.0
_SIGN_BITS = np.uint64(63)

# Minimax polynomials, computed with 50 digits.
# -2 log(1 + f) / f for sqrt(1/2) <= 1 + f <= sqrt(2): relative error 2.6e-8
_LOG = (
    -0.1744471146503259, 0.28733685435040807, -0.29904533059601884, 0.3312478634916841,
    -0.3991366715897723, 0.5000414812247297, -0.6666837124915674, 0.9999997592873947,
    -1.9999999483794695,
)  # fmt: skip
# sin(v) / v and cos(v) in v**2 for |v| <= pi / 2: absolute errors 3.3e-9 and 2.2e-10
_SIN = (
    2.590488346876866e-06, -0.00019800897669746632, 0.00833289982140275, -0.16666647634477946,
    0.9999999765894603,
)  # fmt: skip
_COS = (
    -2.605149514002653e-07, 2.4760161346665686e-05, -0.0013888361400112475, 0.04166663625805243,
    -0.49999999358471175, 0.9999999997806521,
)  # fmt: skip
_LN2 = -2.0 * math.log(2.0)


@njit_strict
def number_of(word):
    """A word as the float 2**52 + word, whose lowest bits are those of the word."""
    return float_of((word & LOW_WORD) | TWO_52)


@njit_strict
def radius_of(number):
    """sqrt(-2 log(u)) with u = (word + 1/2) / 2**32."""
    bits = bits_of(number - (2.0**52 - _HALF_WORD)) + ONE_OVER_SQRT_HALF
    k = float_of((bits >> EXPONENT_BITS) | TWO_52) - (TWO_52_BIASED + _WORD_BITS)
    f = float_of((bits & MANTISSA) + SQRT_HALF) - 1.0  # u = 2**k (1 + f)
    return np.sqrt(fma(f, polynomial(f, _LOG), k * _LN2))


@njit_strict
def point_at(radius, number):
    """The point at this radius; direction and sign are those of the word in ``number``."""
    v = (number - (_MIDDLE - _HALF_WORD)) * _RADIANS
    square = v * v
    radius = float_of(bits_of(radius) ^ (bits_of(number) << _SIGN_BITS))
    return radius * (v * polynomial(square, _SIN)), radius * polynomial(square, _COS)


def padded(n_members: int) -> int:
    """Number of columns of a noise array for ``n_members`` members: the next multiple of 64."""
    return -(-n_members // BLOCK) * BLOCK


@njit(error_model="numpy", nogil=True)
def fill_normals(seed, purpose, step, Z, first_block=0):
    """Fill Z (components, padded members) with the standard normals of members, by blocks of 64.

    Column 0 is the first member of ``first_block``. One call of Philox makes the normals of the
    members i, i + 16, i + 32 and i + 48 of a block; i and i + 32 have a radius in common, and so
    have i + 16 and i + 48.
    """
    k0, k1 = key_words(seed)
    c2, c3 = np.uint64(step), purpose
    for component in range(Z.shape[0]):
        c1 = np.uint64(component)
        row, n_blocks = Z[component], Z.shape[1] // BLOCK
        for block in range(n_blocks):
            first = np.uint64((first_block + block) * _QUARTER)
            z = row[block * BLOCK : (block + 1) * BLOCK]
            for i in range(_QUARTER):
                w0, w1, w2, w3 = philox(first + np.uint64(i), c1, c2, c3, k0, k1)
                z[i], z[i + _HALF] = number_of(w0), number_of(w1)
                z[i + _QUARTER], z[i + _QUARTER + _HALF] = number_of(w2), number_of(w3)
        for block in range(n_blocks):
            z = row[block * BLOCK : block * BLOCK + _HALF]
            for i in range(_HALF):
                z[i] = radius_of(z[i])
        for block in range(n_blocks):
            z = row[block * BLOCK : (block + 1) * BLOCK]
            for i in range(_HALF):
                z[i], z[i + _HALF] = point_at(z[i], z[i + _HALF])


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

FILL_NORMALS = EntryPoint(_fill, _ARGUMENTS, "fill_normals")
"""`fill_normals` of an array given by its address, compiled once for all filters."""
