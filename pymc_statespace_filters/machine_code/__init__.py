"""Machine code with a name or an address, called from other machine code; it knows no system."""

from pymc_statespace_filters.machine_code.cores import available_cores
from pymc_statespace_filters.machine_code.entries import (
    COUNTS,
    NUMBERS,
    Entry,
    address_of,
    call_address,
    kept,
)
from pymc_statespace_filters.machine_code.functions import Call, NativeFunction, make_call
from pymc_statespace_filters.machine_code.keys import FAST_MATH, digest, key_of

__all__ = [
    "COUNTS",
    "FAST_MATH",
    "NUMBERS",
    "Call",
    "Entry",
    "NativeFunction",
    "address_of",
    "available_cores",
    "call_address",
    "digest",
    "kept",
    "key_of",
    "make_call",
]
