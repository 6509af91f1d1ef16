"""The numba flags of all handwritten compiled functions.

Division by zero gives inf or nan as in NumPy, the GIL is released, and multiplications may be fused
with additions. No flag lets the compiler assume finite numbers, because it would remove the checks
for NaN and infinity.
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
"""For a function that only compiled functions call: compiled without the wrappers for Python."""

inline_always = njit(error_model="numpy", nogil=True, fastmath={"contract"}, inline="always")
"""For a function with one caller, or of a few instructions inside a loop that must vectorise.

Numba inlines it before compilation. LLVM would otherwise optimise it again at every level of
callers, so this also halves the compilation time of a new model.
"""

njit_reassoc = njit(error_model="numpy", nogil=True, fastmath={"contract", "reassoc"})
"""For sums over members, which may be reordered in order to vectorise."""

njit_strict = njit(error_model="numpy", nogil=True, inline="always")
"""Inlined, without fused operations: for sums whose bits must not depend on the calling code."""


@njit_contract
def keep_alive(array):
    """Do nothing; called after the last use of an array's address, to keep the array until then."""
