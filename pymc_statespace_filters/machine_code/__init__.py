"""Machine code with a name or an address, called from other machine code; it knows no system."""

from pymc_statespace_filters.machine_code.closed_library import closed
from pymc_statespace_filters.machine_code.cores import (
    available_cores,
    core_numbers,
    share_of_cores,
)
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
from pymc_statespace_filters.machine_code.many_calls import ManyCalls

__all__ = [
    "COUNTS",
    "FAST_MATH",
    "NUMBERS",
    "Call",
    "Entry",
    "ManyCalls",
    "NativeFunction",
    "address_of",
    "available_cores",
    "call_address",
    "closed",
    "core_numbers",
    "digest",
    "kept",
    "key_of",
    "make_call",
    "share_of_cores",
]
