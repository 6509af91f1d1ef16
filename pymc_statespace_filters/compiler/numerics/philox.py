"""Random words as a pure function of (seed, purpose, step, component, member).

The generator is Philox4x32-7 (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3"):
seven rounds that mix a counter with a key, the number with which it passes BigCrush. The key is the
seed and the counter is where the number is used, so there is no state: a number depends neither on
the number of members, nor on the numbers drawn before, nor on the rank that draws it. There are no
branches and no rejection, so that loops vectorise. The noise of a record of a panel depends on a
seed and on the record's code alone.
"""

from typing import Any

import numpy as np

from ..native.jit import inline_always, njit_callable
from .intrinsics import float_of

INITIAL, PROCESS, OBSERVATION, RESAMPLING, STATES = (np.uint64(purpose) for purpose in range(5))
"""Purposes: the independent streams of a step."""

PILOT = 8
"""The first purpose of a filter's pilot; its others follow in the same order."""

LOW_WORD = np.uint64(0xFFFFFFFF)
_WORD_BITS = np.uint64(32)
_ROUNDS = 7
_MULTIPLIER_0 = np.uint64(0xD2511F53)
_MULTIPLIER_1 = np.uint64(0xCD9E8D57)
_WEYL_0 = np.uint64(0x9E3779B9)
_WEYL_1 = np.uint64(0xBB67AE85)

_TWELVE = np.uint64(12)
_TWENTY = np.uint64(20)
_ONE = np.uint64(0x3FF0000000000000)  # the bits of 1.0
_TWO_MINUS_53 = 2.0**-53


@inline_always
def philox(c0, c1, c2, c3, k0, k1):
    """Philox4x32-7: four words from a counter of four and a key of two.

    Words are the lower 32 bits of the arguments and the results, which are uint64.
    """
    for _ in range(_ROUNDS):
        product_0 = _MULTIPLIER_0 * (c0 & LOW_WORD)
        product_1 = _MULTIPLIER_1 * (c2 & LOW_WORD)
        c0 = (product_1 >> _WORD_BITS) ^ c1 ^ k0
        c2 = (product_0 >> _WORD_BITS) ^ c3 ^ k1
        c1, c3 = product_1, product_0
        k0, k1 = k0 + _WEYL_0, k1 + _WEYL_1
    return c0, c1, c2, c3


@inline_always
def key_words(seed):
    """The two words of a key: the 64 bits of an integer seed, which may be negative."""
    bits = np.uint64(seed)
    return bits & LOW_WORD, bits >> _WORD_BITS


@inline_always
def open_unit(low, high):
    """Uniform in the open interval (0, 1), symmetric about 1/2, from 52 bits of two words."""
    bits = ((high & LOW_WORD) << _TWENTY) | ((low & LOW_WORD) >> _TWELVE) | _ONE
    return (float_of(bits) - 1.0) + _TWO_MINUS_53


@inline_always
def uniform_at(seed, purpose, step, component):
    """A single uniform number in (0, 1)."""
    k0, k1 = key_words(seed)
    zero = np.uint64(0)
    w0, w1, _, _ = philox(zero, np.uint64(component), np.uint64(step), purpose, k0, k1)
    return open_unit(w0, w1)


@njit_callable
def seed_of_record(seed, code):
    """The seed of a record's noise; that of the record with the code 0 is ``seed`` itself.

    The finaliser of MurmurHash3 (A. Appleby) maps 0 to 0 and neighbouring codes far apart.
    """
    bits = np.uint64(code)
    bits ^= bits >> np.uint64(33)
    bits *= np.uint64(0xFF51AFD7ED558CCD)
    bits ^= bits >> np.uint64(33)
    bits *= np.uint64(0xC4CEB9FE1A85EC53)
    bits ^= bits >> np.uint64(33)
    return np.int64((np.uint64(seed) + bits) & np.uint64(0x7FFFFFFFFFFFFFFF))


def seeds_of_records(seed: Any, codes: np.ndarray) -> list[np.ndarray]:
    """The seed of each record, from that of their panel."""
    return [np.asarray(seed_of_record(np.int64(seed), code)) for code in codes]


def generators_of_records(rng: np.random.Generator, codes: np.ndarray) -> list[np.random.Generator]:
    """A generator for each record, which depends on ``rng`` and on the code of the record alone."""
    seed = rng.integers(np.iinfo(np.int64).max)
    return [np.random.default_rng(seed_of_record(seed, code)) for code in codes]
