"""The log of a chain: draws and states in a file that only grows, whatever kills its writer.

A record is self-contained: a head (mark, length of the body, length of the list of contents), the
body (that list as JSON, then the numbers of each array), and a checksum. The checksum covers the
head, the body and the checksum of the record before, the first one that of the run: a record that
is torn, altered, out of order or of another chain is not taken for a good one, nor what follows.

Only the last state is ever needed. Where those before it fill the file (a chain that carries its
noise has large ones), the log is written anew as a single record, which takes its place at once.
"""

import json
import os
import struct
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from pymc_statespace_filters.errors import CheckpointWarning

Arrays = Mapping[str, np.ndarray]

_HEAD = struct.Struct("<8sQQ")
_MARK = b"psfchain"
_CHECKSUM_SIZE = 4
_FLAGS = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)
# So many bytes of overtaken states, and as many as the draws have, may lie about in a log.
_SPARE = 2**28
_NUMBERS = "biuf"  # the kinds of numpy numbers whose bytes are all there is to them


class Stored(NamedTuple):
    """What a log holds of its chain.

    Attributes
    ----------
    draws : dict of str to ndarray, shape (draws, ...)
        All draws, from the first record to the last.
    state : dict of str to ndarray
        The state of the chain after the last of them.
    """

    draws: dict[str, np.ndarray]
    state: dict[str, np.ndarray]


class _Tip(NamedTuple):
    """Where the next record goes, and the checksum that it follows on."""

    end: int
    checksum: bytes


class ChainLog:
    """The log of one chain; one thread at a time may use it.

    Parameters
    ----------
    path : Path
        The file; it need not exist.
    origin : bytes
        What its first record follows on: bytes that belong to this run and this chain alone.
    check : callable
        Raises where this log is not ours any more; called before the file is touched.
    """

    def __init__(self, path: Path, origin: bytes, check: Callable[[], None] = lambda: None):
        self.path = path
        self._check = check
        self._origin = _checksum(origin)
        self._file: BinaryIO | None = None
        self._tip = _Tip(0, self._origin)
        self._overtaken = 0
        self._in_draws = 0

    def read(self) -> Stored | None:
        """Read all good records, and cut off what follows them.

        Returns
        -------
        Stored or None
            None if there is no good record.

        Warns
        -----
        CheckpointWarning
            If something was cut off; it names the file and what is lost.
        """
        self._check()
        stored = self._read()
        if stored is not None and self._is_loose():
            self._compact(stored)
        return stored

    def _read(self) -> Stored | None:
        file = self._open()
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        tip = _Tip(0, self._origin)
        parts: list[dict[str, np.ndarray]] = []
        state: dict[str, np.ndarray] = {}
        self._overtaken = self._in_draws = 0
        for body, contents, checksum in _good_records(file, size, self._origin):
            parts.append(_arrays(body, contents["draws"]))
            self._overtaken += _n_bytes(state)
            self._in_draws += _n_bytes(parts[-1])
            state = _arrays(body, contents["state"])
            tip = _Tip(file.tell(), checksum)
        self._tip = tip
        if tip.end < size:
            file.truncate(tip.end)
            self._warn(size - tip.end, len(parts))
        if not parts:
            return None
        return Stored({name: np.concatenate([p[name] for p in parts]) for name in parts[0]}, state)

    def append(self, draws: Arrays, state: Arrays) -> None:
        """Write one record; when this returns, it is on the disk.

        The cost is that of the new draws and the state alone; most of it is spent without Python's
        lock. Until it returns nobody may change the arrays, which are not copied. A record that
        could not be written is taken back.

        Parameters
        ----------
        draws : mapping of str to ndarray, shape (new draws, ...)
            The draws since the last record, under the same names each time; numbers or booleans.
        state : mapping of str to ndarray
            The state of the chain after them, whole.

        Raises
        ------
        OSError
            If the disk refuses, for one because it is full.
        """
        self._check()
        if self._file is None:
            self.read()
        file, is_first = self._open(), self._tip.end == 0
        pieces = _record(draws, state, self._tip.checksum)
        try:
            file.seek(self._tip.end)
            tip = _written(file, pieces)
        except BaseException:
            self._take_back(file)
            raise
        self._tip = tip
        self._overtaken += 0 if is_first else _n_bytes(state)
        self._in_draws += _n_bytes(draws)
        if self._is_loose():
            self.read()

    def close(self) -> None:
        """Close the file; the log may be used again."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _open(self) -> BinaryIO:
        if self._file is None:
            existed = self.path.exists()
            self._fresh_path().unlink(missing_ok=True)  # of a process killed before the exchange
            # Not "a": what a failed write has left behind must be written over.
            self._file = os.fdopen(os.open(self.path, _FLAGS, 0o666), "r+b")
            if not existed:
                sync_folder(self.path.parent)
        return self._file

    def _is_loose(self) -> bool:
        return self._overtaken > _SPARE + self._in_draws

    def _compact(self, stored: Stored) -> None:
        """Put a file of one record in the place of the log."""
        fresh = self._fresh_path()
        with os.fdopen(os.open(fresh, _FLAGS | os.O_TRUNC, 0o666), "r+b") as file:
            self._tip = _written(file, _record(*stored, self._origin))
        self.close()
        os.replace(fresh, self.path)
        sync_folder(self.path.parent)
        self._overtaken = 0

    def _fresh_path(self) -> Path:
        return self.path.with_name(f"{self.path.name}.new")

    def _take_back(self, file: BinaryIO) -> None:
        """Cut off a half-written record, and what the file object would still write on closing."""
        self._file = None
        with suppress(OSError):
            file.close()
        self._check()  # or it would be another's file that is cut
        os.truncate(self.path, self._tip.end)

    def _warn(self, n_bytes: int, n_good: int) -> None:
        remains = f"the chain goes on from record {n_good}" if n_good else "the chain begins anew"
        warnings.warn(
            f"{self.path}: record {n_good + 1}, at byte {self._tip.end}, is torn or damaged. "
            f"The last {n_bytes} bytes are lost and cut off; {remains}",
            CheckpointWarning,
            stacklevel=3,
        )


def sync_folder(path: Path) -> None:
    """Bring a folder's list of files to the disk, where the system has a way to ask for it."""
    try:
        folder = os.open(path, os.O_RDONLY)
    except OSError:
        return
    with suppress(OSError):
        os.fsync(folder)
    os.close(folder)


def _checksum(*pieces: Any) -> bytes:
    """CRC-32: half the cost of a cryptographic hash, which is most of the cost of a record."""
    checksum = 0
    for piece in pieces:
        checksum = zlib.crc32(piece, checksum)
    return checksum.to_bytes(_CHECKSUM_SIZE, "little")


def _good_records(
    file: BinaryIO, size: int, last: bytes
) -> Iterator[tuple[bytes, dict[str, Any], bytes]]:
    """Body, list of contents and checksum of each record, up to the first that is not good."""
    while (head := file.read(_HEAD.size)) and len(head) == _HEAD.size:
        mark, body_size, contents_size = _HEAD.unpack(head)
        if mark != _MARK or body_size + _CHECKSUM_SIZE > size - file.tell():
            return
        body, checksum = file.read(body_size), file.read(_CHECKSUM_SIZE)
        if checksum != _checksum(last, head, body):
            return
        yield body, _located(json.loads(body[:contents_size]), contents_size), checksum
        last = checksum


def _record(draws: Arrays, state: Arrays, last: bytes) -> list[Any]:
    """The pieces of a record that follows on a checksum; the last of them is its own."""
    new_draws, new_state = _plain(draws), _plain(state)
    contents = json.dumps({"draws": _contents(new_draws), "state": _contents(new_state)})
    arrays = [*new_draws.values(), *new_state.values()]
    body = [contents.encode(), *(array.reshape(-1).view(np.uint8).data for array in arrays)]
    head = _HEAD.pack(_MARK, sum(map(len, body)), len(body[0]))
    return [head, *body, _checksum(last, head, *body)]


def _written(file: BinaryIO, pieces: list[Any]) -> _Tip:
    """Write a record where the file stands; when this returns, it is on the disk."""
    file.writelines(pieces)
    file.flush()
    os.fsync(file.fileno())
    return _Tip(file.tell(), pieces[-1])


def _n_bytes(arrays: Arrays) -> int:
    return sum(np.asarray(array).nbytes for array in arrays.values())


def _plain(arrays: Arrays) -> dict[str, np.ndarray]:
    """The arrays as contiguous little-endian numbers."""
    plain = {}
    for name, given in arrays.items():
        array = np.asarray(given, order="C")
        if array.dtype.kind not in _NUMBERS:
            raise TypeError(f"{name}: a log holds numbers and booleans, got {array.dtype}")
        plain[name] = array.astype(array.dtype.newbyteorder("<"), copy=False)
    return plain


def _contents(arrays: Arrays) -> list[tuple[str, str, tuple[int, ...]]]:
    return [(name, array.dtype.str, array.shape) for name, array in arrays.items()]


def _located(contents: dict[str, list], begin: int) -> dict[str, Any]:
    """The contents of a record with the place of each array in its body."""
    located: dict[str, list] = {"draws": [], "state": []}
    for kind, listed in located.items():
        for name, code, shape in contents[kind]:
            dtype = np.dtype(code)
            listed.append((name, dtype, shape, begin))
            begin += int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    return located


def _arrays(body: bytes, located: list[tuple]) -> dict[str, np.ndarray]:
    """Copies: an array that looked into the body would keep all of it in memory."""
    return {
        name: np.ndarray(shape, dtype, body, begin).copy() for name, dtype, shape, begin in located
    }
