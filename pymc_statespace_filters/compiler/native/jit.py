"""How every njit function of the filters is compiled.

Division by zero gives inf or nan as in NumPy, the interpreter lock is released, and multiplications
may be fused with additions. No flag that lets the compiler assume finite numbers: the guards
against NaN and infinity would be compiled away.
"""

from numba import njit

njit_contract = njit(error_model="numpy", nogil=True, fastmath={"contract"})

njit_internal = njit(
    error_model="numpy",
    nogil=True,
    fastmath={"contract"},
    no_cpython_wrapper=True,
    no_cfunc_wrapper=True,
)
"""For a function that only compiled functions call: what Python would need is not compiled."""

inline_always = njit(error_model="numpy", nogil=True, fastmath={"contract"}, inline="always")
"""For a function with one caller, or a few instructions inside a loop that must become vector code.

It becomes part of its caller before anything is compiled. Compilation optimises a function again at
every level that it is called from, so this also halves the time a new model waits.
"""

njit_reassoc = njit(error_model="numpy", nogil=True, fastmath={"contract", "reassoc"})
"""For sums over members, which may be added up in another order and so become vector code."""

njit_strict = njit(error_model="numpy", nogil=True, inline="always")
"""Pasted too, and computed to the letter: for sums that must not depend on what is around them."""


@njit_contract
def keep_alive(array):
    """Be the last reader of an array whose address was handed on; else it was freed before."""
