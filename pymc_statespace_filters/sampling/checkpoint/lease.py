"""A lease on a folder, so that one job at a time writes there.

Each job puts a new lease file into the folder, and then looks at those of other jobs: of two jobs
at least the later one sees the other, and gives up. `filelock.SoftFileLease` writes the file,
which names the process and its host, and touches it every few seconds in a thread. The lease of a
process of this computer that has ended is removed at once. Any other is watched, and removed if it
is not touched for 20 s; only changes count, the clocks of two computers are never compared. A job
that was suspended for longer finds its file gone and stores nothing more.

SoftFileLease can also take over one common file. That is not used, because it exchanges two file
names in one step, which NFS, SMB and most parallel file systems refuse: there the lease of a dead
job would never expire. File names that are never used again need no exchange.
"""

import errno
import os
import platform
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from time import sleep
from uuid import uuid4

from filelock import SoftFileLease

from ...errors import ModelError

PREFIX = "lease."

_HEARTBEAT_SECONDS = 3.0
_POLL_SECONDS = 1.0
# A lease that is not touched between so many polls has expired: several heartbeats are missing.
_N_POLLS = 20
# NFS may remember for a minute that a file does not exist.
_N_POLLS_FOR_NEW_FILE = 60


class FolderLease:
    """A lease on a folder until `release`; ``path`` is its file, whose name is never used again.

    Raises
    ------
    ModelError
        If a living process has a lease on the folder.
    OSError
        If the folder is not writable.
    """

    def __init__(self, folder: Path):
        self.path = folder / f"{PREFIX}{_process_table()}-{uuid4().hex[:16]}"
        self._lease = _lease(self.path)
        self._lease.acquire(blocking=False)
        try:
            others = [path for path in folder.glob(f"{PREFIX}*") if path != self.path]
            ended = [path for path in others if _has_ended(path)]
            expired = _expired([path for path in others if path not in ended])
            for path in ended + expired:
                try:
                    path.unlink(missing_ok=True)
                except PermissionError:  # Windows: the file is open in a living process
                    raise _in_use(path) from None
        except BaseException:
            self.release()
            raise

    def release(self) -> None:
        """Release the folder; in a fork of the process this does nothing."""
        self._lease.release()


def check_held(lease: Path) -> None:
    """Raise a `ModelError` if a lease file is gone: the folder was taken over."""
    if _last_touched(lease) is None:
        raise ModelError(
            f"{lease.parent}: the lease file {lease.name} of this job is gone, so nothing more is "
            f"stored: another job took the folder over after {_N_POLLS * _POLL_SECONDS:.0f} s "
            f"without a heartbeat, or the file was deleted"
        )


def becomes_visible(lease: Path) -> bool:
    """Whether a lease that another computer made is visible here, within a minute."""
    for _ in range(_N_POLLS_FOR_NEW_FILE):
        if _last_touched(lease) is not None:
            return True
        sleep(_POLL_SECONDS)
    return _last_touched(lease) is not None


def _lease(path: Path) -> SoftFileLease:
    return SoftFileLease(
        path,
        lease_duration=_N_POLLS * _POLL_SECONDS,
        heartbeat_interval=_HEARTBEAT_SECONDS,
        thread_local=False,
    )


def _process_table() -> str:
    """Identify the table of processes that this one is in: of this computer, and this container.

    Computers and containers may have the same name; the kernel's start and the name space of
    process numbers tell them apart.
    """
    table = platform.node()
    with suppress(OSError):
        table += Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
        table += os.readlink("/proc/self/ns/pid")
    return blake2b(table.encode(), digest_size=8).hexdigest()


def _has_ended(path: Path) -> bool:
    """Whether the owner is a process of this table that has ended; raise if it is this one."""
    if _lease(path).is_lock_held_by_us:
        raise ModelError(f"{path.parent} is in use by this process already: {path}")
    pid = _lease(path).pid
    if pid is None or not path.name.startswith(f"{PREFIX}{_process_table()}-"):
        return False
    if os.name == "nt":  # removing the file fails if it has not
        return True
    with suppress(PermissionError):  # a process of another user
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
    return False


def _expired(leases: list[Path]) -> list[Path]:
    """Leases that are not touched for a while; raise if one of them is touched."""
    touched = {path: time for path in leases if (time := _last_touched(path)) is not None}
    for _ in range(_N_POLLS):  # counted, so that a process suspended between two polls misses none
        if not touched:
            break
        sleep(_POLL_SECONDS)
        for path, before in list(touched.items()):
            now = _last_touched(path)
            if now is None:
                del touched[path]
            elif now != before:
                raise _in_use(path)
    return list(touched)


def _last_touched(path: Path) -> int | None:
    """When a lease was last touched, None if it is gone; NFS asks the server for an open file."""
    try:
        with open(path, "rb") as file:
            return os.fstat(file.fileno()).st_mtime_ns
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ESTALE):
            return None
        raise


def _in_use(path: Path) -> ModelError:
    owner = _lease(path).owner
    name = "an unknown process"
    if owner is not None:  # in a container the name space of process numbers follows the host
        name = f"process {owner.pid} on {owner.hostname.partition('?pidns')[0]}"
    return ModelError(
        f"{path.parent} is in use by {name}, which holds {path.name}: wait for its end or give "
        f"another path"
    )
