"""A folder for one job at a time, without a lock that outlives a killed one.

Whoever wants the folder puts a file into it whose name says who it is, and then looks for others:
of two processes at least the later one sees the other. As the name says everything, there is no
moment at which a lock exists and its owner is unknown, and no lock is ever removed but by its owner
or after its owner's death.

Whether an owner lives is asked of the table of processes, if it is in ours. If it is not (another
computer, or another container, where our table would say nothing), its lock is watched: an owner
writes to it every few seconds. Only changes count; no two clocks are compared. An owner that was
taken for dead and was not, but suspended, finds its lock gone and stops.
"""

import errno
import os
import platform
from collections.abc import Sequence
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from time import monotonic, sleep
from typing import NamedTuple
from urllib.parse import quote

from pymc_statespace_filters.errors import ModelError

PREFIX = "lock."

_BEAT_SECONDS = 3.0
_LOOK_SECONDS = 1.0
# So many looks at a lock that stands still, and its owner is dead: of several beats none has come.
_LOOKS = 20
# NFS may remember for a minute that a file is not there.
_LOOKS_FOR_A_NEW_FILE = 60


class _Owner(NamedTuple):
    """A process: its table of processes, its number, and when it began (0: unknown)."""

    place: str
    pid: int
    began: int  # for numbers recur

    def __str__(self) -> str:
        return f"process {self.pid} on {self.place.partition('@')[0]}"


class FolderLock:
    """Hold a folder until `release`.

    Parameters
    ----------
    folder : Path

    Attributes
    ----------
    path : Path
        The lock's file.
    is_taken_over : bool
        Whether a job that died had the folder. Some of its processes may be dying still.

    Raises
    ------
    ModelError
        If a living process holds it, or one of which that cannot be known.
    OSError
        If nothing can be written into the folder.
    """

    def __init__(self, folder: Path):
        self._me = _owner(os.getpid())
        self.path = folder / _name(self._me)
        self._n_beats, self._beaten_at = 0, monotonic()
        try:
            # It stays open: Windows refuses to delete the open file of a living process.
            self._file: int | None = os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        except FileExistsError:
            raise ModelError(f"{folder} is in use by this process already: {self.path}") from None
        try:
            dead = self._dead([path for path in folder.glob(f"{PREFIX}*") if path != self.path])
            for path in dead:
                _remove(path)
            self.is_taken_over = bool(dead)
        except BaseException:
            self.release()
            raise

    def beat(self) -> None:
        """Show that this process lives; to be called every second or so, it writes more rarely.

        Raises
        ------
        ModelError
            If the lock has gone.
        """
        now = monotonic()
        if now - self._beaten_at < _BEAT_SECONDS:
            return
        self._beaten_at = now
        self._n_beats += 1
        with suppress(OSError):  # a beat missed; a sick disk is spoken of when a log is written
            check_held(self.path)
            # Closed each time: NFS may keep for itself what is written to an open file.
            with open(self.path, "r+b") as file:
                file.write(b"%12d\n" % self._n_beats)

    def release(self) -> None:
        """Give the folder free; a fork of the owner's process leaves it alone."""
        if os.getpid() == self._me.pid and self._file is not None:
            os.close(self._file)
            self._file = None
            self.path.unlink(missing_ok=True)

    def _dead(self, locks: Sequence[Path]) -> list[Path]:
        """All these locks, but those that are given free meanwhile; raise if an owner lives."""
        dead, elsewhere = [], []
        for path in locks:
            owner = _parse(path.name)
            if owner is None:
                raise _unclear(path, "an unknown process")
            if owner.place != self._me.place:
                elsewhere.append(path)
            elif _lives(owner):
                raise ModelError(
                    f"{path.parent} is in use by {owner}: wait for its end or give another path"
                )
            else:
                dead.append(path)
        return dead + self._silent(elsewhere)

    def _silent(self, locks: Sequence[Path]) -> list[Path]:
        """Those of these locks that stay as they are for a while; raise if one changes."""
        seen = {path: _content(path) for path in locks}
        for _ in range(_LOOKS):  # counted: who is suspended between two looks misses none
            if not seen:
                break
            sleep(_LOOK_SECONDS)
            self.beat()  # another newcomer may be watching us
            for path, before in list(seen.items()):
                now = _content(path)
                if now is None:
                    del seen[path]
                elif now != before:
                    raise ModelError(
                        f"{path.parent} is in use by {_parse(path.name)}, which writes to "
                        f"{path.name}: wait for its end, and {_LOOKS * _LOOK_SECONDS:.0f} s in "
                        f"which that file does not change, or give another path"
                    )
        return list(seen)


def check_held(lock: Path) -> None:
    """Raise unless a lock is still there.

    Raises
    ------
    ModelError
        If it has gone: the folder belongs to somebody else, or to nobody.
    """
    if not _is_there(lock):
        raise ModelError(
            f"{lock.parent}: its lock {lock.name} has gone, nothing more is stored there: another "
            f"job has taken the folder over, after {_LOOKS * _LOOK_SECONDS:.0f} s without a sign "
            f"of life, or the file was deleted"
        )


def comes_in_sight(lock: Path) -> bool:
    """Whether a lock that another computer has made is seen here, now or a little later."""
    for _ in range(_LOOKS_FOR_A_NEW_FILE):
        if _is_there(lock):
            return True
        sleep(_LOOK_SECONDS)
    return _is_there(lock)


def _is_there(lock: Path) -> bool:
    return _content(lock) is not None


def _content(lock: Path) -> bytes | None:
    """What is in a lock, None if it has gone; opened, for only then NFS asks the server."""
    try:
        return lock.read_bytes()
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ESTALE):
            return None
        raise


def _remove(lock: Path) -> None:
    """Remove the lock of a dead process."""
    try:
        lock.unlink(missing_ok=True)
    except PermissionError:  # on Windows it lives
        raise _unclear(lock, str(_parse(lock.name))) from None


def _unclear(lock: Path, who: str) -> ModelError:
    return ModelError(
        f"{lock.parent} is in use by {who}: wait for its end or give another path; if it is not "
        f"running any more, delete {lock}"
    )


def _lives(owner: _Owner) -> bool:
    """Whether a process of our table is running; on Windows the attempt to delete decides."""
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


def _place() -> str:
    """Whose table of processes this is.

    The computer's name, and what tells apart computers and containers of one name: the start of the
    system's kernel, and the name space of process numbers.
    """
    table = ""
    with suppress(OSError):
        start = Path("/proc/sys/kernel/random/boot_id").read_text()
        numbers = os.readlink("/proc/self/ns/pid")
        table = blake2b(f"{start} {numbers}".encode(), digest_size=4).hexdigest()
    return f"{quote(platform.node(), safe='')}@{table}"


def _owner(pid: int) -> _Owner:
    return _Owner(_place(), pid, _began(pid))


def _name(owner: _Owner) -> str:
    return f"{PREFIX}{owner.place}.{owner.pid}.{owner.began}"


def _parse(name: str) -> _Owner | None:
    """Read a lock's name; None for any that is not of a process that beats."""
    place, *numbers = name.removeprefix(PREFIX).rsplit(".", 2)
    if "@" not in place or len(numbers) != 2 or not all(n.isdecimal() for n in numbers):
        return None
    return _Owner(place, int(numbers[0]), int(numbers[1]))
