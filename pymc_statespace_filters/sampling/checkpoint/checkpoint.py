"""Checkpoints: a folder that says what was asked for, and holds one log for each chain.

What was asked for appears as a whole (see `run_file`), and a log only grows (see `chain_log`). So a
process that is killed between any two calls leaves a folder behind that is not yet a checkpoint, or
a good one up to the last record.

Several ranks share a folder that all of them see: the first opens it, and the others join by its
ticket. When a job has died, one of its ranks may still be writing while the next job opens the
folder. Two things keep it off: a log is touched only while the lock of its job is there, and the
next job replaces the logs by copies, so that a write on its way goes into a file without a name.
"""

import os
import platform
import re
import shutil
import unicodedata
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple, Self

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling.checkpoint.journal import ChainLog, sync_folder
from pymc_statespace_filters.sampling.checkpoint.lease import FolderLock, check_held, comes_in_sight
from pymc_statespace_filters.sampling.checkpoint.manifest import RUN, begin, canonical, compare

_READABLE = 40  # characters of a name


class Ticket(NamedTuple):
    """What another rank needs to join a checkpoint; it can be pickled."""

    folder: str
    lock: str
    asked: str


class Checkpoint:
    """An open checkpoint; a context manager that gives the folder free at its end.

    Made by `open_checkpoint`, or by `join_checkpoint` for the rank of another process, which holds
    nothing and gives nothing free.

    Attributes
    ----------
    path : Path
        The folder.
    """

    def __init__(self, ticket: Ticket, lock: FolderLock | None = None):
        self.path = Path(ticket.folder)
        self._ticket = ticket
        self._lock = lock
        self._logs: dict[int, ChainLog] = {}

    def log(self, chain: int) -> ChainLog:
        """Give the log of a chain, 0 the first; always the same object.

        One rank at a time uses the log of a chain, and closes it before another does.
        """
        if chain not in self._logs:
            origin = f"{self._ticket.asked}\n{chain}".encode()
            self._logs[chain] = ChainLog(self.path / f"chain-{chain}.log", origin, self.check)
        return self._logs[chain]

    def ticket(self) -> Ticket:
        """Give what other ranks need for `join_checkpoint`, until this one is closed."""
        return self._ticket

    def beat(self) -> None:
        """Show other computers that this job lives: to be called every second or so.

        From the opening to the end, or the folder is taken over. Where it was joined, this does
        nothing.

        Raises
        ------
        ModelError
            If the folder is not ours any more.
        """
        if self._lock is not None:
            self._lock.beat()

    def check(self) -> None:
        """Raise a `ModelError` if the folder is not ours any more."""
        check_held(self.path / self._ticket.lock)

    def close(self) -> None:
        """Close the logs and give the folder free."""
        for log in self._logs.values():
            log.close()
        if self._lock is not None:
            self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_checkpoint(path: str | os.PathLike, asked: Mapping[str, Any]) -> Checkpoint:
    """Open a checkpoint, or begin one where there is none.

    Parameters
    ----------
    path : str or path
        The folder; it is made if it does not exist.
    asked : mapping of str to JSON values
        All that the draws depend on: arguments, and fingerprints of model and data.

    Returns
    -------
    Checkpoint

    Raises
    ------
    DataMismatchError
        If the checkpoint is of a run that was asked for something else; the message names every
        field that differs, with both values.
    ModelError
        If the folder cannot be used: it is something else, damaged, written by a newer version,
        not writable, or in use by another process. A process of another computer, or of another
        container, is watched for 20 s before its folder is taken over.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> folder = tempfile.TemporaryDirectory()
    >>> with open_checkpoint(folder.name, {"draws": 4}) as checkpoint:
    ...     checkpoint.log(0).append({"x": np.zeros(2)}, {"iteration": np.array(2)})
    >>> with open_checkpoint(folder.name, {"draws": 4}) as checkpoint:
    ...     draws, state = checkpoint.log(0).read()
    >>> draws["x"].size, int(state["iteration"])
    (2, 2)
    >>> folder.cleanup()
    """
    folder = Path(path).absolute()
    text = canonical(dict(asked))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FolderLock(folder)
    except FileExistsError:
        raise ModelError(f"checkpoint={str(folder)!r} is a file: expected a folder") from None
    except OSError as error:
        raise ModelError(
            f"checkpoint={str(folder)!r} cannot be written to ({error.strerror}): give another path"
        ) from error
    try:
        if lock.is_taken_over:
            _replace_logs(folder, lock)
        if (folder / RUN).exists():
            compare(folder, text)
        else:
            begin(folder, text)
    except BaseException:
        lock.release()
        raise
    return Checkpoint(Ticket(str(folder), lock.path.name, text), lock)


def join_checkpoint(ticket: Ticket) -> Checkpoint:
    """Take part in a checkpoint that the first rank has opened.

    Parameters
    ----------
    ticket : Ticket
        Of that checkpoint.

    Returns
    -------
    Checkpoint
        For the logs of the chains that this rank runs, as long as the first rank holds the folder.

    Raises
    ------
    ModelError
        If the folder of that name here is another one, for the first rank's lock is not in it. On a
        network a file may come in sight late, so this takes a minute.

    Examples
    --------
    >>> import tempfile
    >>> folder = tempfile.TemporaryDirectory()
    >>> with open_checkpoint(folder.name, {"draws": 4}) as first:
    ...     with join_checkpoint(first.ticket()) as second:
    ...         second.path == first.path
    True
    >>> folder.cleanup()
    """
    if not comes_in_sight(Path(ticket.folder, ticket.lock)):
        raise ModelError(
            f"checkpoint={ticket.folder!r} is not on a file system that all ranks see: "
            f"{platform.node()} does not find {ticket.lock} in it, which the first rank has put "
            f"there; give a path on a shared file system"
        )
    return Checkpoint(ticket)


def subfolder(name: str) -> str:
    """Give the name of a folder for something of any name.

    Readable, and another one for another name also where case makes no difference, or an accent can
    be written in two ways.

    Parameters
    ----------
    name : str

    Returns
    -------
    str
        Some letters and digits of it, and a hash of all of it.

    Examples
    --------
    >>> subfolder("Double well / additive")
    'Double-well-additive-0c8368e4c4'
    """
    letters = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    readable = re.sub("[^A-Za-z0-9]+", "-", letters)[:_READABLE].strip("-")
    digest = blake2b(name.encode("utf-8", "surrogatepass"), digest_size=5).hexdigest()
    return f"{readable}-{digest}".removeprefix("-")


def _replace_logs(folder: Path, lock: FolderLock) -> None:
    """Put copies in the place of the logs, whose files a dying process may still write to."""
    for path in sorted(folder.glob("chain-*.log")):
        copy = path.with_name(f"{path.name}.copy")
        shutil.copyfile(path, copy)
        with open(copy, "rb+") as file:
            os.fsync(file.fileno())
        lock.beat()
        check_held(lock.path)
        os.replace(copy, path)
    sync_folder(folder)
