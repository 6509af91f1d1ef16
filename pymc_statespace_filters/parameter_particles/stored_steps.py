"""A run on its way, in a folder from which it goes on after its process has ended.

The folder is a checkpoint, as that of chains; only the first rank reads and writes it. What is
stored does not depend on the number of ranks.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np

from ..parallel.shared_rows import by_first_rank
from ..sampling.checkpoint.checkpoint import checked_folder, open_checkpoint
from ..sampling.checkpoint.record_file import RecordFile

SECONDS = 5.0  # between two records
_KEY = "particles"

type Arrays = dict[str, np.ndarray]


class StoredSteps:
    """The last step that was stored, and a place for those to come; without a folder neither.

    ``found`` is the last step, on all ranks; empty at the beginning.
    """

    def __init__(self, found: Arrays | None = None, checkpoint: RecordFile | None = None) -> None:
        self.found = found or {}
        self._checkpoint, self._saved_at = checkpoint, time.monotonic()

    def save(self, arrays: Callable[[], Arrays], *, is_last: bool = False) -> None:
        """Store a step if some seconds have passed, or if it is the last."""
        if self._checkpoint is None:
            return
        if is_last or time.monotonic() - self._saved_at >= SECONDS:
            self._checkpoint.append(_KEY, {}, arrays())
            self._saved_at = time.monotonic()


@contextmanager
def steps_stored_in(
    folder: Any, settings: Callable[[], Mapping[str, Any]]
) -> Iterator[StoredSteps]:
    """Open the folder of a checkpoint, or none; ``settings`` are all that the run depends on.

    Raises as `open_checkpoint` and `RecordFile.read`.
    """
    if folder is None:
        yield StoredSteps()
        return
    opened: list[RecordFile] = []
    with ExitStack() as stack:

        def begin() -> Arrays:
            checkpoint = open_checkpoint(checked_folder(folder), settings())
            opened.append(stack.enter_context(checkpoint))
            stored = opened[0].read(_KEY)
            return {} if stored is None else stored.state

        found = by_first_rank(begin)
        yield StoredSteps(found, *opened)
