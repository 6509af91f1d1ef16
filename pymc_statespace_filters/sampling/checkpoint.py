"""Checkpoints: a folder that says what was asked for, and holds one log for each chain.

``run.json`` is written once, when the folder is made, and appears as a whole; a log only grows (see
`chain_log`). So a process that is killed between any two calls leaves a folder behind that is not
yet a checkpoint, or a good one up to the last record.
"""

import json
import os
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.sampling import folder_lock
from pymc_statespace_filters.sampling.chain_log import ChainLog, sync_folder
from pymc_statespace_filters.sampling.folder_lock import FolderLock

FORMAT = "pymc_statespace_filters checkpoint"
VERSION = 1

_RUN = "run.json"
_UNFINISHED = "run.json.unfinished"
_LONGEST_SHOWN = 80
_CURE = "delete the folder or give another path"


class Checkpoint:
    """An open checkpoint; a context manager that gives the folder free at its end.

    Made by `open_checkpoint`.

    Attributes
    ----------
    path : Path
        The folder.
    """

    def __init__(self, path: Path, lock: FolderLock, asked: str):
        self.path = path
        self._lock = lock
        self._asked = asked
        self._logs: dict[int, ChainLog] = {}

    def log(self, chain: int) -> ChainLog:
        """Give the log of a chain, 0 the first; always the same object."""
        if chain not in self._logs:
            origin = f"{self._asked}\n{chain}".encode()
            self._logs[chain] = ChainLog(self.path / f"chain-{chain}.log", origin)
        return self._logs[chain]

    def close(self) -> None:
        """Close the logs and give the folder free."""
        for log in self._logs.values():
            log.close()
        self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
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
        not writable, or in use by another process.

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
    text = _canonical(dict(asked))
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
        if (folder / _RUN).exists():
            _compare(folder, text)
        else:
            _begin(folder, text)
    except BaseException:
        lock.release()
        raise
    return Checkpoint(folder, lock, text)


def _begin(folder: Path, asked: str) -> None:
    """Make a checkpoint of an empty folder, or of one that a killed process was about to make."""
    begun = {_UNFINISHED, *(p.name for p in folder.glob(f"{folder_lock.PREFIX}*"))}
    if foreign := sorted(p.name for p in folder.iterdir() if p.name not in begun):
        raise ModelError(
            f"checkpoint={str(folder)!r} is not a checkpoint: it holds {', '.join(foreign[:3])}"
            f"{', ...' if len(foreign) > 3 else ''} but no {_RUN}; give another path"
        )
    run = {"format": FORMAT, "version": VERSION, "asked": json.loads(asked)}
    run["sum"] = _sum(run["version"], run["asked"])
    with open(folder / _UNFINISHED, "w", encoding="utf-8") as file:
        json.dump(run, file, indent=1)
        file.flush()
        os.fsync(file.fileno())
    os.replace(folder / _UNFINISHED, folder / _RUN)
    sync_folder(folder)
    sync_folder(folder.parent)


def _compare(folder: Path, asked: str) -> None:
    """Raise unless the folder is a checkpoint of just this."""
    stored, now = _stored(folder), json.loads(asked)
    differing = [
        f"{name}: the checkpoint has {_shown(stored, name)}, asked for {_shown(now, name)}"
        for name in dict.fromkeys([*stored, *now])
        if name not in stored
        or name not in now
        or _canonical(stored[name]) != _canonical(now[name])
    ]
    if differing:
        raise DataMismatchError(
            f"checkpoint={str(folder)!r} is of another run: {'; '.join(differing)}; {_CURE}"
        )


def _stored(folder: Path) -> dict[str, Any]:
    """What the checkpoint was asked for."""
    try:
        run = json.loads((folder / _RUN).read_bytes())
        format_, version = run["format"], run["version"]
    except (ValueError, TypeError, KeyError):
        format_, version = None, None
    if format_ != FORMAT or not isinstance(version, int):
        raise ModelError(
            f"checkpoint={str(folder)!r}: its {_RUN} is damaged or not of a checkpoint; {_CURE}"
        )
    if version > VERSION:
        raise ModelError(
            f"checkpoint={str(folder)!r} has the format {version}, of a newer version of this "
            f"package, which reads up to {VERSION}: update the package, or give another path"
        )
    asked = run.get("asked")
    if not isinstance(asked, dict) or run.get("sum") != _sum(version, asked):
        raise ModelError(f"checkpoint={str(folder)!r}: its {_RUN} is damaged; {_CURE}")
    return asked


def _canonical(value: Any) -> str:
    """One text for equal values; it tells 1 from 1.0 and True, and NaN equals itself."""
    return json.dumps(value, sort_keys=True)


def _sum(version: int, asked: dict[str, Any]) -> str:
    return blake2b(_canonical([version, asked]).encode(), digest_size=16).hexdigest()


def _shown(values: Mapping[str, Any], name: str) -> str:
    if name not in values:
        return "nothing"
    text = _canonical(values[name])
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."
