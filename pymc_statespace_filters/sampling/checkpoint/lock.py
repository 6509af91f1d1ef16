"""A lock on a folder, so that one process at a time writes there.

It is the operating system's: it ends with its process, however that ends. If a computer fails, a
file server keeps its locks for a minute or two; so a newcomer on another computer waits. Where a
file system has no locks, nobody is refused: `RecordFile` notices that another process has written.
"""

import errno
import os
import platform
from pathlib import Path

from filelock import FileLock, Timeout

from ...errors import ModelError

_LOCK, _OWNER = "run.lock", "run.owner"
_PATIENCE = 120.0  # seconds, with an owner on another computer
_NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP}


def locked(folder: Path) -> FileLock:
    """Lock a folder until the lock is released, or the process ends.

    Raises `ModelError` if another process has the lock; `OSError` if the folder is not writable.
    """
    lock = FileLock(folder / _LOCK, thread_local=False, fallback_to_soft=False)
    note, here = folder / _OWNER, platform.node()
    owner = note.read_text(encoding="utf-8") if note.exists() else f"another process on {here}"
    try:
        lock.acquire(timeout=0.0 if owner.endswith(f" on {here}") else _PATIENCE, poll_interval=1.0)
    except Timeout:
        raise ModelError(
            f"{folder} is in use by {owner}: wait for its end or give another path"
        ) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
    note.write_text(f"process {os.getpid()} on {here}", encoding="utf-8")
    return lock
