"""Draws and states of a chain on disk, in immutable segments that survive a kill of the writer.

A segment is one file: the names of its arrays as JSON, the arrays in NumPy's npy format, and a
checksum of the run, the chain, the numbers of the records in it, and the content. It is written
under another name, flushed to disk and renamed: it exists as a whole or not at all, and a damaged
file or one of another chain is recognised.

A record has the draws since the one before, and the whole state of the chain. The last segments are
merged whenever 16 of them have similar lengths, so a chain of n records has at most some
16 log_16(n) files, and a draw is written about log_16(n) times. Only the last state is needed: a
merged segment has no other, and segments are also merged where old states would fill the disk (a
chain that carries its noise has a state of megabytes).
"""

import json
import os
import re
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from io import BytesIO
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import CheckpointError, CheckpointWarning

Arrays = Mapping[str, np.ndarray]

_FAN_IN = 16
# Draws of more bytes are not merged.
_MAX_MERGED_BYTES = 2**28
_MAX_OLD_STATE_BYTES = 2**28  # beside as many as the draws have
_CHECKSUM_SIZE = 4


class StoredChain(NamedTuple):
    """The stored arrays of a chain, by name."""

    draws: dict[str, np.ndarray]  # all draws, from the first record to the last
    state: dict[str, np.ndarray]  # the state of the chain after the last of them


class _Segment(NamedTuple):
    """Records ``first`` to ``last`` in one file."""

    path: Path
    first: int
    last: int
    draw_bytes: int = 0
    state_bytes: int = 0

    @property
    def n_records(self) -> int:
        return self.last - self.first + 1


class ChainJournal:
    """The stored records of one chain; one thread at a time may use it.

    Parameters
    ----------
    path : Path
        The files are named after it, as in ``chain-0.16-31.segment``; its folder exists.
    origin : bytes
        Identifies the run and the chain; enters each checksum.
    check : callable
        Raises if another job has taken the files over; called before they are touched.
    """

    def __init__(self, path: Path, origin: bytes, check: Callable[[], None] = lambda: None):
        self._path, self._origin, self._check = path, origin, check
        self._segments: list[_Segment] = []
        self._is_read = False

    def read(self) -> StoredChain | None:
        """Read all records up to the first that is missing or damaged; the later ones are removed.

        None if there is no good record.

        Warns
        -----
        CheckpointWarning
            If records were removed.

        Raises
        ------
        CheckpointError
            If a file cannot be read, or its name is that of a folder.
        """
        self._check()
        with self._named_errors("read"):
            stored = _joined(self._good_parts())
            self._is_read = True
            self._tidy()
        return stored if self._segments else None

    def append(self, draws: Arrays, state: Arrays) -> None:
        """Write one record; when this returns, it is on the disk.

        Parameters
        ----------
        draws : mapping of str to ndarray, shape (new draws, ...)
            The draws since the last record, under the same names each time; numbers or booleans.
        state : mapping of str to ndarray
            The whole state of the chain after them.

        Raises
        ------
        CheckpointError
            If the record cannot be written, for example because the disk is full. It is then not
            there, and those before it are.
        ValueError
            If an array has Python objects.
        """
        self._check()
        if not self._is_read:
            self.read()
        with self._named_errors("written"):
            number = self._n_records()
            self._segments.append(self._write(number, number, draws, state))
            self._tidy()

    @contextmanager
    def _named_errors(self, what: str) -> Iterator[None]:
        """Say of an error of the file system where it was, and what is kept."""
        try:
            yield
        except CheckpointError:
            raise
        except OSError as error:
            n_kept = self._n_records()
            raise CheckpointError(
                f"{error.filename or self._path}: record {n_kept + 1} of the chain cannot be "
                f"{what} ({error.strerror or error}). The {n_kept} before it are kept: when that "
                "is mended, the same call resumes after them"
            ) from error

    def _n_records(self) -> int:
        return self._segments[-1].last + 1 if self._segments else 0

    def _good_parts(self) -> Iterator[StoredChain]:
        """Load what follows in order from the first record; remove all else."""
        self._segments = []
        listed = self._listed()
        for i, segment in enumerate(listed):
            n_records = self._n_records()
            if segment.first < n_records:  # merged by a process that was killed before the removal
                segment.path.unlink()
                continue
            part = self._load(segment) if segment.first == n_records else None
            if part is None:
                self._discard(listed[i:], n_records)
                return
            self._segments.append(_Segment(*segment[:3], *map(_n_bytes, part)))
            yield part

    def _listed(self) -> list[_Segment]:
        """All segments on disk by their first record, the longest first."""
        pattern = re.compile(rf"{re.escape(self._path.name)}\.(\d+)-(\d+)\.segment")
        found = [
            _Segment(path, int(match[1]), int(match[2]))
            for path in self._path.parent.iterdir()
            if (match := pattern.fullmatch(path.name))
        ]
        return sorted(found, key=lambda segment: (segment.first, -segment.last))

    def _load(self, segment: _Segment) -> StoredChain | None:
        """The arrays in a segment, None if it is damaged or another one."""
        content = memoryview(segment.path.read_bytes())
        body, checksum = content[:-_CHECKSUM_SIZE], content[-_CHECKSUM_SIZE:]
        if checksum != self._checksum(segment.path, body):
            return None
        file = BytesIO(body)
        names = json.loads(file.readline())
        return StoredChain(*({name: np.load(file) for name in listed} for listed in names))

    def _write(self, first: int, last: int, draws: Arrays, state: Arrays) -> _Segment:
        body = BytesIO()
        body.write(json.dumps([list(draws), list(state)]).encode() + b"\n")
        for array in [*draws.values(), *state.values()]:
            np.save(body, array, allow_pickle=False)
        path = self._path.with_name(f"{self._path.name}.{first}-{last}.segment")
        unfinished = path.with_suffix(".unfinished")
        try:
            with open(unfinished, "wb") as file:
                file.write(body.getbuffer())
                file.write(self._checksum(path, body.getbuffer()))
                file.flush()
                os.fsync(file.fileno())
            os.replace(unfinished, path)
        except OSError:
            self._check()  # another job may have taken the files over
            unfinished.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)
        return _Segment(path, first, last, _n_bytes(draws), _n_bytes(state))

    def _tidy(self) -> None:
        """Merge segments if their old states fill the disk, or if there are many."""
        tail = self._small_tail()
        in_draws = sum(segment.draw_bytes for segment in tail)
        if sum(s.state_bytes for s in tail[:-1]) > _MAX_OLD_STATE_BYTES + in_draws:
            self._merge(tail)
        while len(tail := self._small_tail()[-_FAN_IN:]) == _FAN_IN:
            if tail[0].n_records > tail[-1].n_records * _FAN_IN // 2:
                break
            self._merge(tail)

    def _small_tail(self) -> list[_Segment]:
        """As many of the last segments as may be merged."""
        in_draws = accumulate(segment.draw_bytes for segment in reversed(self._segments))
        n_small = sum(n_bytes <= _MAX_MERGED_BYTES for n_bytes in in_draws)
        return self._segments[len(self._segments) - n_small :]

    def _merge(self, tail: Sequence[_Segment]) -> None:
        """Replace the last segments by a single one, with the last state only."""
        merged = self._write(tail[0].first, tail[-1].last, *_joined(map(self._load_again, tail)))
        self._segments = [*self._segments[: -len(tail)], merged]
        for segment in tail:
            segment.path.unlink()

    def _load_again(self, segment: _Segment) -> StoredChain:
        part = self._load(segment)
        if part is None:
            raise CheckpointError(
                f"{segment.path} was damaged after it had been written; the same call resumes from "
                f"the records before it"
            )
        return part

    def _discard(self, segments: Sequence[_Segment], n_good: int) -> None:
        first = segments[0]
        # The first last: if the process is killed meanwhile, the next read finds it again.
        for segment in reversed(segments):
            segment.path.unlink()
        resumes = f"the chain resumes after record {n_good}" if n_good else "the chain begins anew"
        warnings.warn(
            f"{first.path}: record {n_good + 1} is missing, damaged or of another chain. It and "
            f"all later ones are removed; {resumes}",
            CheckpointWarning,
            stacklevel=3,
        )

    def _checksum(self, path: Path, body: memoryview) -> bytes:
        """CRC-32: a cryptographic hash would be most of the cost of a record."""
        checksum = zlib.crc32(body, zlib.crc32(self._origin + path.name.encode()))
        return checksum.to_bytes(_CHECKSUM_SIZE, "little")


def sync_folder(path: Path) -> None:
    """Flush a folder's list of files to disk, on systems that can."""
    try:
        folder = os.open(path, os.O_RDONLY)
    except OSError:
        return
    with suppress(OSError):
        os.fsync(folder)
    os.close(folder)


def _joined(parts: Iterable[StoredChain]) -> StoredChain:
    """All draws, and the last state."""
    draws: list[dict[str, np.ndarray]] = []
    state: dict[str, np.ndarray] = {}
    for part in parts:
        draws.append(part.draws)
        state = part.state
    names = draws[0] if draws else {}
    return StoredChain({name: np.concatenate([d[name] for d in draws]) for name in names}, state)


def _n_bytes(arrays: Arrays) -> int:
    return sum(np.asarray(array).nbytes for array in arrays.values())
