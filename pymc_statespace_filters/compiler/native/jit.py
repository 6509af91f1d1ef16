"""The numba flags of all handwritten compiled functions.

Division by zero gives inf or nan as in NumPy, the GIL is released, and multiplications may be fused
with additions. No flag lets the compiler assume finite numbers, because it would remove the checks
for NaN and infinity.

Most functions are called by compiled functions only, see `code_library`. Each of these is optimised
alone, so a loop vectorises only if what it calls is inlined.
"""

from functools import partial

from numba import njit

from .code_library import LinkedCompiler

# No "nnan" or "ninf": filters detect failures by NaN and infinity. No "reassoc": with "nsz" it
# folds x - x to 0 for every x, and numba's isfinite, which uses x - x, would always be true.
FAST_MATH = {"contract", "nsz", "arcp"}
"""The flags of generated code."""

linked = partial(
    njit,
    error_model="numpy",
    nogil=True,
    no_cpython_wrapper=True,
    no_cfunc_wrapper=True,
    pipeline_class=LinkedCompiler,
)
"""The decorator, with arguments, of a function that only compiled functions call."""

njit_internal = linked(fastmath={"contract"})
"""For all functions without a reason for another decorator."""

njit_callable = njit(error_model="numpy", nogil=True, fastmath={"contract"})
"""For a function that Python calls, too."""

njit_generated = njit(error_model="numpy", nogil=True, fastmath=FAST_MATH)
"""For a function with the flags of generated code."""

njit_reassoc = linked(fastmath={"contract", "reassoc"})
"""For sums over members, which may be reordered in order to vectorise."""

inlined = linked(forceinline=True)
"""For functions inside vector loops, without fused operations: LLVM inlines them."""

inlined_fused = linked(forceinline=True, fastmath={"contract"})
"""For a few instructions inside a loop that LLVM inlines, with fused operations."""

inline_always = njit(error_model="numpy", nogil=True, fastmath={"contract"}, inline="always")
"""For a few instructions inside a loop that must vectorise, fused with those of the loop.

Numba inlines them before compilation, which takes time in proportion to the caller's size.
"""

njit_strict = njit(error_model="numpy", nogil=True, inline="always")
"""As `inline_always` without fused operations: for bits that must not depend on the caller."""


@njit_internal
def keep_alive(array):
    """Do nothing; called after the last use of an array's address, to keep the array until then."""


@njit_internal
def copy_into(target, source):
    """Set a vector to another one of its length.

    Assigning a slice would take a second of compilation more, for messages about shapes.
    """
    for i in range(target.size):
        target[i] = source[i]
