"""A folder for one process at a time, without a lock that outlives a killed one.

Whoever wants the folder puts a file into it whose name says who it is, and then looks for others:
of two processes at least the later one sees the other. As the name says everything, there is no
moment at which a lock exists and its owner is unknown, and no lock is ever removed but by its owner
or after its owner's death.
"""

import os
import platform
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from pymc_statespace_filters.errors import ModelError

PREFIX = "lock."


class _Owner(NamedTuple):
    """A process: its computer, its number, and when it began (0: unknown), for numbers recur."""

    host: str
    pid: int
    began: int


class FolderLock:
    """Hold a folder until `release`.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    ModelError
        If a living process, or one on another computer, holds it.
    OSError
        If nothing can be written into the folder.
    """

    def __init__(self, folder: Path):
        self._me = _owner(os.getpid())
        self._path = folder / _name(self._me)
        try:
            # It stays open: Windows refuses to delete the open file of a living process.
            self._file: int | None = os.open(self._path, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
        except FileExistsError:
            raise ModelError(f"{folder} is in use by this process already: {self._path}") from None
        try:
            for path in folder.glob(PREFIX + "*"):
                if path != self._path:
                    _clear(folder, path)
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        """Give the folder free; a fork of the owner's process leaves it alone."""
        if os.getpid() == self._me.pid and self._file is not None:
            os.close(self._file)
            self._file = None
            self._path.unlink(missing_ok=True)


def _clear(folder: Path, path: Path) -> None:
    """Remove the lock of a dead process; raise for any other."""
    owner = _parse(path.name)
    if owner is not None and owner.host == _host() and not _lives(owner):
        with suppress(PermissionError):
            path.unlink(missing_ok=True)
            return
    who = "an unknown process" if owner is None else f"process {owner.pid} on {owner.host}"
    raise ModelError(
        f"{folder} is in use by {who}: wait for its end or give another path; if it is not running "
        f"any more, delete {path}"
    )


def _lives(owner: _Owner) -> bool:
    """Whether a process of this computer is running; on Windows the attempt to delete decides."""
    if os.name == "nt":
        return False
    began = _began(owner.pid)
    if began and owner.began:
        return began == owner.began
    try:
        os.kill(owner.pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True  # somebody else's
    return began != _OVER


_OVER = -1


def _began(pid: int) -> int:
    """When a process began, in ticks since the computer did.

    ``_OVER`` for one that has ended and waits to be noticed by its parent, 0 where the system does
    not say.
    """
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return 0
    # The second field, the program's name in brackets, may hold blanks and brackets itself.
    state, *fields = stat.rpartition(")")[2].split()
    return _OVER if state in "ZX" else int(fields[18])


def _host() -> str:
    return quote(platform.node(), safe="")


def _owner(pid: int) -> _Owner:
    return _Owner(_host(), pid, _began(pid))


def _name(owner: _Owner) -> str:
    return f"{PREFIX}{owner.host}.{owner.pid}.{owner.began}"


def _parse(name: str) -> _Owner | None:
    host, *numbers = name.removeprefix(PREFIX).rsplit(".", 2)
    if len(numbers) != 2 or not all(number.isdecimal() for number in numbers):
        return None
    return _Owner(host, int(numbers[0]), int(numbers[1]))
