"""Functions of a kernel that Python calls: compiled once, and cached on disk for all processes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit

from pymc_statespace_filters.compiler.native.cache_key import digest
from pymc_statespace_filters.compiler.native.entry_point import cached_on_disk


def cached_with(*names: str) -> Callable[[Callable], Any]:
    """A decorator; the machine code depends on the files of this folder with these names."""
    files = [Path(__file__).parent / name for name in names]
    source = "".join(file.read_text(encoding="utf-8") for file in files)

    def decorate(function: Callable) -> Any:
        key = digest(function.__name__, source)
        return cached_on_disk(njit(function, error_model="numpy", nogil=True), key)

    return decorate
