"""Compilation by PyTensor: its lock, a warning, and its files on disk.

PyTensor changes its global flags while it compiles, and sets them back afterwards. Of two threads
that compile at once, one sets back what the other has changed: the mode of the process is then one
without numba, for good.
"""

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import RLock
from typing import Any
from uuid import uuid4

from numba.core.caching import FunctionCache
from pytensor import config
from pytensor.link.numba.cache import CACHED_SRC_FUNCTIONS

COMPILATION = RLock()
"""Held by sampling and evidence, except while chains run, and where `log_likelihood` compiles."""


@contextmanager
def without_traces() -> Iterator[None]:
    """Keep no lines of source with nodes of graphs that are made meanwhile; also a decorator.

    They would be lines of this package, and to find them takes a third of the time in which a
    system is lowered. The flag is global, so one thread at a time changes it.
    """
    with COMPILATION, config.change_flags(traceback__limit=0):
        yield


@contextmanager
def warning_filter(action: str, message: str) -> Iterator[None]:
    """Filter the `UserWarning` that begins with ``message``, and no other, meanwhile.

    `warnings.catch_warnings` would set back the filters of all threads to what they were before.
    """
    message = f"{message}(?#{uuid4()})"  # the comment makes the filter unlike all others
    before = warnings.filters
    warnings.filterwarnings(action, message, UserWarning)  # type: ignore[arg-type]
    try:
        yield
    finally:
        own = action, re.compile(message, re.IGNORECASE), UserWarning, None, 0
        # Another thread's `catch_warnings` may have put a copy in place, and may set this one back.
        filters: Any
        for filters in (before, warnings.filters):
            with suppress(ValueError):
                filters.remove(own)


@contextmanager
def undamaged_files() -> Iterator[None]:
    """Have PyTensor functions that are made meanwhile compiled anew where their files are damaged.

    Numba, which loads the files at the first call, would raise, and at every start again.
    """
    before = set(CACHED_SRC_FUNCTIONS.keyrefs())
    yield
    made = set(CACHED_SRC_FUNCTIONS.keyrefs()) - before if config.numba__cache else ()
    for function in filter(None, (reference() for reference in made)):
        cache = FunctionCache(function)
        try:
            for name in cache._cache_file._load_index().values():
                with suppress(OSError):  # without a file numba compiles
                    cache._cache_file._load_data(name)
        except Exception:  # whatever unpickling half a file raises
            cache.flush()
