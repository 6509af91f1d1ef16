"""Keys of compiled code on disk, and the fast-math flags of generated code."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import llvmlite
import numba
import pytensor
from pytensor.link.numba.cache import NUMBA_CACHE_PATH

from .sources import Sources

# No "nnan" or "ninf": filters detect failures by NaN and infinity. No "reassoc": with "nsz" it
# folds x - x to 0 for every x, and numba's isfinite, which uses x - x, would always be true.
FAST_MATH = {"contract", "nsz", "arcp"}

# Numba's own index on disk tells processors and versions of Python apart.
_COMPILERS = (numba.__version__, llvmlite.__version__, pytensor.__version__)
_SOURCES = Sources(Path(__file__).parents[2], NUMBA_CACHE_PATH)


def key_of(module: str, *parts: str | Callable | None) -> str | None:
    """The key of machine code that a module makes; None if it cannot be cached on disk.

    It covers the compilers and the sources of all modules of this package that the module reaches
    by its imports. Modules outside this package are not covered and have no key.

    Parameters
    ----------
    module : str
        The ``__name__`` of the module.
    *parts : str, callable or None
        What else identifies the code: texts, the keys of code that it calls (None where that
        cannot be cached), and functions, which are covered as the module is.
    """
    if module not in _SOURCES:
        return None
    keys = [key_of(p.__module__, p.__qualname__) if callable(p) else p for p in parts]
    if None in keys:
        return None
    return hashlib.sha256(repr((_COMPILERS, _SOURCES.digest_of(module), keys)).encode()).hexdigest()
