"""Checkpoints: a folder with the settings of a run, and the stored draws and states of its chains.

The settings are written once (see `manifest`), and stored chains are immutable files (see
`journal`); each file appears whole. So a process that is killed at any moment leaves a folder that
is not yet a checkpoint, or a good one up to the last record.

Several ranks use one folder that all of them see: the first opens it, and the others join with its
ticket. When a job has died, one of its ranks may still be writing while the next job opens the
folder. Two things prevent damage: a rank checks the lease of its job before it writes, and each job
moves the files to a new subfolder and removes the former one, so that a write in progress fails.
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

from ...errors import ModelError
from .journal import ChainJournal, sync_folder
from .lease import FolderLease, becomes_visible, check_held
from .manifest import canonical, write_or_compare

_MAX_READABLE = 40  # characters of a name


class Ticket(NamedTuple):
    """What another rank needs to join a checkpoint; it can be pickled."""

    folder: str
    lease: str
    settings: str


class Checkpoint:
    """An open checkpoint; a context manager that releases the folder at its end.

    Made by `open_checkpoint`, or by `join_checkpoint` on other ranks, which release nothing. Other
    ranks join with the ``ticket``, until this checkpoint is closed.
    """

    def __init__(self, ticket: Ticket, lease: FolderLease | None = None):
        self.path, self.ticket = Path(ticket.folder), ticket
        self._lease = lease
        self._journals: dict[int | str, ChainJournal] = {}

    def journal(self, chain: int | str) -> ChainJournal:
        """The journal of a chain, 0 the first, or of "starts" or "length"; always the same object.

        One rank at a time uses the journal of a chain, and begins with `ChainJournal.read`.
        """
        if chain not in self._journals:
            path = _subfolder_of(self.path / self.ticket.lease) / f"chain-{chain}"
            origin = f"{self.ticket.settings}\n{chain}".encode()
            self._journals[chain] = ChainJournal(path, origin, self.check)
        return self._journals[chain]

    def check(self) -> None:
        """Raise a `ModelError` if another job has taken the folder over."""
        check_held(self.path / self.ticket.lease)

    def close(self) -> None:
        """Release the folder."""
        if self._lease is not None:
            self._lease.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_checkpoint(path: str | os.PathLike, settings: Mapping[str, Any]) -> Checkpoint:
    """Open a checkpoint, or begin one where there is none.

    Parameters
    ----------
    path : str or path
        The folder; it is made if it does not exist.
    settings : mapping of str to JSON values
        All that the draws depend on: arguments, and fingerprints of model and data.

    Returns
    -------
    Checkpoint

    Raises
    ------
    DataMismatchError
        If the checkpoint is of a run with other settings; the message names every field that
        differs, with both values.
    ModelError
        If the folder cannot be used: it is something else, damaged, of another format, not
        writable, or in use by another process. A process of another computer, or of another
        container, is watched for 20 s before its folder is taken over.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> folder = tempfile.TemporaryDirectory()
    >>> with open_checkpoint(folder.name, {"draws": 4}) as checkpoint:
    ...     checkpoint.journal(0).append({"x": np.zeros(2)}, {"iteration": np.array(2)})
    >>> with open_checkpoint(folder.name, {"draws": 4}) as checkpoint:
    ...     draws, state = checkpoint.journal(0).read()
    >>> draws["x"].size, int(state["iteration"])
    (2, 2)
    >>> folder.cleanup()
    """
    folder = Path(path).absolute()
    text = canonical(dict(settings))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lease = FolderLease(folder)
        try:
            write_or_compare(folder, text)
            _take_chains(folder, lease.path)
        except BaseException:
            lease.release()
            raise
    except FileExistsError as error:  # on Windows, also of a folder above
        raise ModelError(f"checkpoint={error.filename!r} is a file: expected a folder") from None
    except OSError as error:
        inside = error.filename and Path(error.filename).parent == folder
        at = f" at {Path(error.filename).name}" if inside else ""
        raise ModelError(
            f"checkpoint={str(folder)!r} cannot be written to ({error.strerror}{at}): give another "
            "path"
        ) from error
    return Checkpoint(Ticket(str(folder), lease.path.name, text), lease)


def join_checkpoint(ticket: Ticket) -> Checkpoint:
    """Open a checkpoint on a rank other than the first, with the ticket of the first.

    It gives the journals of the chains that this rank runs, as long as the first rank has the
    folder open.

    Raises
    ------
    ModelError
        If the folder of that name here is another one: the first rank's lease is not in it. On a
        network a file may become visible late, so this takes a minute.

    Examples
    --------
    >>> import tempfile
    >>> folder = tempfile.TemporaryDirectory()
    >>> with open_checkpoint(folder.name, {"draws": 4}) as first:
    ...     with join_checkpoint(first.ticket) as second:
    ...         second.path == first.path
    True
    >>> folder.cleanup()
    """
    if not becomes_visible(Path(ticket.folder, ticket.lease)):
        raise ModelError(
            f"checkpoint={ticket.folder!r} is not on a file system that all ranks see: "
            f"{platform.node()} does not find {ticket.lease}, which the first rank has written "
            f"there; give a path on a shared file system"
        )
    return Checkpoint(ticket)


def folder_name(name: str) -> str:
    """A folder name for any text: its letters and digits, and a hash of the whole.

    Readable, and different for different texts also where case is ignored, or where an accent can
    be written in two ways.

    Examples
    --------
    >>> folder_name("Double well / additive")
    'Double-well-additive-0c8368e4c4'
    """
    letters = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    readable = re.sub("[^A-Za-z0-9]+", "-", letters)[:_MAX_READABLE].strip("-")
    digest = blake2b(name.encode("utf-8", "surrogatepass"), digest_size=5).hexdigest()
    return f"{readable}-{digest}".removeprefix("-")


def _subfolder_of(lease: Path) -> Path:
    """Where the job of a lease has its chains."""
    return lease.with_name(f"chains{lease.suffix}")


def _take_chains(folder: Path, lease: Path) -> None:
    """Move the chains of former jobs to the subfolder of this one."""
    current = _subfolder_of(lease)
    current.mkdir()
    for former in folder.glob("chains.*"):
        if former != current:
            for path in former.glob("*.segment"):
                path.rename(current / path.name)
            check_held(lease)
            shutil.rmtree(former)  # with unfinished files
    sync_folder(current)
    sync_folder(folder)


def checked_folder(checkpoint: Any) -> str | os.PathLike:
    """The folder of a checkpoint, as the user gave it; a `ModelError` if it is no path."""
    if not isinstance(checkpoint, str | os.PathLike) or not os.fspath(checkpoint):
        raise ModelError(f"checkpoint must be the path of a folder, got {checkpoint!r}")
    return checkpoint
