"""Checkpoints: a folder with one file of a run, its settings and then its stored draws and states.

One process writes to it. Of several ranks that is the first, to which the others send what they
have to store, so that only the first has to see the folder.
"""

import json
import os
import re
import unicodedata
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import Any

from ...errors import DataMismatchError, ModelError
from .lock import locked
from .record_file import RecordFile, header_of

_FILE = "run.checkpoint"
_MAX_SHOWN = 80  # characters of a value in a message
_CURE = "delete the folder or give another path"
_MAX_READABLE = 40  # characters of a name


@contextmanager
def open_checkpoint(path: str | os.PathLike, settings: Mapping[str, Any]) -> Iterator[RecordFile]:
    """Open a checkpoint, or begin one where there is none; its folder is locked for the block.

    The folder is made if it does not exist. ``settings``, in JSON values, are all that the draws
    depend on: arguments, and fingerprints of model and data. Keys are ``chain 0``, for example.
    Raises `DataMismatchError` if the checkpoint is of a run with other settings: the message names
    every field that differs, with both values; `ModelError` if the folder cannot be used: it is a
    file, not writable, in use by another process, or its checkpoint is damaged at its beginning or
    of another format.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> folder = tempfile.TemporaryDirectory()
    >>> with open_checkpoint(folder.name, {"draws": 4}) as checkpoint:
    ...     checkpoint.append("chain 0", {"x": np.zeros(2)}, {"iteration": np.array(2)})
    >>> with open_checkpoint(folder.name, {"draws": 4}) as checkpoint:
    ...     draws, state = checkpoint.read("chain 0")
    >>> draws["x"].size, int(state["iteration"])
    (2, 2)
    >>> folder.cleanup()
    """
    folder, header = Path(path).absolute(), _canonical(dict(settings))
    with ExitStack() as stack:
        with _named_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            stack.callback(locked(folder).release)
            if (folder / _FILE).exists():
                _check_same(folder, json.loads(header))
            records = RecordFile(folder / _FILE, header)
        yield records


@contextmanager
def _named_errors(folder: Path) -> Iterator[None]:
    """Say of an error of the file system what to do about it."""
    try:
        yield
    except FileExistsError as error:  # on Windows, also of a folder above
        raise ModelError(f"checkpoint={error.filename!r} is a file: expected a folder") from None
    except OSError as error:
        inside = error.filename and Path(error.filename).parent == folder
        at = f" at {Path(error.filename).name}" if inside else ""
        raise ModelError(
            f"checkpoint={str(folder)!r} cannot be written to ({error.strerror}{at}): give another "
            "path"
        ) from error


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


def checked_folder(checkpoint: Any) -> str | os.PathLike:
    """The folder of a checkpoint, as the user gave it; a `ModelError` if it is no path."""
    if not isinstance(checkpoint, str | os.PathLike) or not os.fspath(checkpoint):
        raise ModelError(f"checkpoint must be the path of a folder, got {checkpoint!r}")
    return checkpoint


def _check_same(folder: Path, now: dict[str, Any]) -> None:
    """Raise unless the checkpoint in a folder has these settings."""
    try:
        stored = json.loads(header_of(folder / _FILE))
    except ValueError as error:
        raise ModelError(f"checkpoint={str(folder)!r}: its {_FILE} {error}; {_CURE}") from None
    differing = [
        f"{name}: the checkpoint has {_shown(stored, name)}, this run has {_shown(now, name)}"
        for name in dict.fromkeys([*stored, *now])
        if name not in stored
        or name not in now
        or _canonical(stored[name]) != _canonical(now[name])
    ]
    if differing:
        raise DataMismatchError(
            f"checkpoint={str(folder)!r} is of another run: {'; '.join(differing)}; {_CURE}"
        )


def _canonical(value: Any) -> str:
    """One text for equal JSON values; 1, 1.0 and True differ, NaN equals itself."""
    return json.dumps(value, sort_keys=True)


def _shown(values: Mapping[str, Any], name: str) -> str:
    if name not in values:
        return "nothing"
    text = _canonical(values[name])
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."
