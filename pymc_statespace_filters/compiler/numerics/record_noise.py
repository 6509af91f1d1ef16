"""The noise of the records of a panel: each depends on a seed and on the record's code alone."""

import numpy as np

from ..native.jit import njit_callable


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


def generators_of_records(rng: np.random.Generator, codes: np.ndarray) -> list[np.random.Generator]:
    """A generator for each record, which depends on ``rng`` and on the code of the record alone."""
    seed = rng.integers(np.iinfo(np.int64).max)
    return [np.random.default_rng(seed_of_record(seed, code)) for code in codes]
