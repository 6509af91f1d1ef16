"""One file to which records are appended; a process that is killed leaves all but the last whole.

The file begins with its format and a header. Before each record are its length and a checksum of
its content, its number and the header, so that a record that is torn, damaged, in the wrong place
or of another file is found; the file is cut there when it is opened.

Only the last state of a key is needed. Where old ones would fill the disk (a chain that carries its
noise has a state of megabytes, every few seconds), the file is written anew with one record of each
key, under another name until it is whole.
"""

import os
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import RLock
from typing import BinaryIO, NamedTuple

from ...errors import CheckpointError, CheckpointWarning, warn
from .arrays import Arrays, Stored, decoded, encoded, joined

_FORMAT, _VERSION = b"pymc_statespace_filters checkpoint ", b"3\n"
_FRAME = struct.Struct("<QI")  # length and CRC-32; a cryptographic hash would be most of the cost
_MAX_OLD_STATES = 2**28  # bytes, beside as many as are needed


class _Place(NamedTuple):
    start: int
    number: int  # of the record, in the whole file
    state_size: int


class _Index:
    """Where the records of a file are, by their key."""

    def __init__(self, header: str):
        self._origin = zlib.crc32(header.encode())
        self.places: dict[str, list[_Place]] = {}
        self.n_records = self.size = self.old_states = 0  # numbers, and bytes

    @property
    def salt(self) -> int:
        """Where the checksum of the next record begins."""
        return self.salt_of(self.n_records)

    def salt_of(self, number: int) -> int:
        """Where the checksum of a record begins."""
        return zlib.crc32(number.to_bytes(8, "little"), self._origin)

    def add(self, content: bytes) -> None:
        """Add the record that is at the end."""
        key, stored = decoded(content)
        state_size = sum(array.nbytes for array in stored.state.values())
        before = self.places.setdefault(key, [])
        self.old_states += before[-1].state_size if before else 0
        before.append(_Place(self.size, self.n_records, state_size))
        self.n_records += 1
        self.size += _FRAME.size + len(content)


class RecordFile:
    """A file of records, written by one process, of which any thread may use this object.

    If there is no such file, it is made. The header identifies the run: that of a file that is
    there must be the same; see `header_of`. Warns if the file was cut at a record
    that is not whole.
    """

    def __init__(self, path: Path, header: str):
        self.path, self._header, self._lock = path, header, RLock()
        self._index = self._opened() if path.exists() else self._begun(())

    def append(self, key: str, draws: Arrays, state: Arrays) -> None:
        """Write one record; when this returns, it is on the disk.

        It has the draws (new draws, ...) since the last record, under the same names each time,
        numbers or booleans, and the whole state after them. Raises `CheckpointError` if the file is
        not as this process has left it, or the record cannot be written, for example because the
        disk is full: it is then not there, and those before it are.
        """
        self.append_encoded(encoded(key, draws, state))

    def append_encoded(self, content: bytes) -> None:
        """Write a record made by `encoded`, as another rank sends it."""
        with self._lock, self._named_errors("written"):
            index = self._index
            if index.old_states > _MAX_OLD_STATES + index.size - index.old_states:
                self._index = index = self._begun(
                    encoded(key, *joined(self._records(key))) for key in index.places
                )
            # Opened anew: a file on a network is then as others have left it.
            with open(self.path, "r+b") as file:
                if file.seek(0, os.SEEK_END) != index.size:
                    raise CheckpointError(
                        f"{self.path}: another process has written to this file, so nothing more "
                        "is stored"
                    )
                try:
                    file.write(_framed(content, index.salt))
                    _flush(file)
                except BaseException:
                    with suppress(OSError):
                        file.truncate(index.size)
                    raise
                index.add(content)

    def read(self, key: str) -> Stored | None:
        """The draws in all records of a key, and the last state; None if there are none.

        Raises `CheckpointError` if the file cannot be read, or was damaged since it was opened.
        """
        with self._lock, self._named_errors("read"):
            return joined(self._records(key)) if key in self._index.places else None

    def _records(self, key: str) -> Iterator[Stored]:
        with open(self.path, "rb") as file:
            for place in self._index.places[key]:
                file.seek(place.start)
                content = _next_content(file, self._index.salt_of(place.number))
                if content is None:
                    raise CheckpointError(
                        f"{self.path}: record {place.number + 1} was damaged after it had been "
                        "written; the same call resumes from the records before it"
                    )
                yield decoded(content)[1]

    def _begun(self, contents: Iterable[bytes]) -> _Index:
        """Write the file with some records; it appears whole."""
        index, unfinished = _Index(self._header), self.path.with_suffix(".unfinished")
        with open(unfinished, "wb") as file:
            file.write(_FORMAT + _VERSION + _framed(self._header.encode(), 0))
            index.size = file.tell()
            for content in contents:
                file.write(_framed(content, index.salt))
                index.add(content)
            _flush(file)
        os.replace(unfinished, self.path)
        _flush_folder(self.path.parent)
        return index

    def _opened(self) -> _Index:
        """Find the records, and cut the file at the first that is not whole."""
        index = _Index(self._header)
        with open(self.path, "r+b") as file:
            _read_header(file)
            index.size = file.tell()
            while (content := _next_content(file, index.salt)) is not None:
                index.add(content)
            is_cut = file.seek(0, os.SEEK_END) > index.size
            file.truncate(index.size)
        if is_cut:
            n = index.n_records
            warn(
                f"{self.path}: record {n + 1} is torn or damaged. It and all later ones are "
                f"removed; the run {f'resumes after record {n}' if n else 'begins anew'}",
                CheckpointWarning,
            )
        return index

    @contextmanager
    def _named_errors(self, what: str) -> Iterator[None]:
        """Say of an error of the file system where it was, and what is kept."""
        try:
            yield
        except CheckpointError:
            raise
        except FileNotFoundError as error:
            raise CheckpointError(
                f"{self.path} is gone: it was moved or deleted during the run"
            ) from error
        except OSError as error:
            n = self._index.n_records
            raise CheckpointError(
                f"{self.path}: record {n + 1} cannot be {what} ({error.strerror or error}). The "
                f"{n} before it are kept: when that is mended, the same call resumes after them"
            ) from error


def header_of(path: Path) -> str:
    """The header of a file of records.

    Raises `ValueError` if the file is of another format, or its header is damaged.
    """
    with open(path, "rb") as file:
        return _read_header(file)


def _read_header(file: BinaryIO) -> str:
    if file.read(len(_FORMAT)) != _FORMAT:
        raise ValueError("is damaged or not of a checkpoint")
    if (version := file.readline(9)) != _VERSION:
        raise ValueError(
            f"has the format {version.decode(errors='replace').strip()} of another version of this "
            f"package, which reads the format {_VERSION.decode().strip()}"
        )
    if (content := _next_content(file, 0)) is None:
        raise ValueError("is damaged")
    return content.decode()


def _framed(content: bytes, salt: int) -> bytes:
    return _FRAME.pack(len(content), zlib.crc32(content, salt)) + content


def _next_content(file: BinaryIO, salt: int) -> bytes | None:
    """The content of the next record, None if it is not whole."""
    frame = file.read(_FRAME.size)
    if len(frame) < _FRAME.size:
        return None
    size, checksum = _FRAME.unpack(frame)
    if size > os.fstat(file.fileno()).st_size - file.tell():
        return None
    content = file.read(size)
    return content if zlib.crc32(content, salt) == checksum else None


def _flush(file: BinaryIO) -> None:
    file.flush()
    os.fsync(file.fileno())


def _flush_folder(path: Path) -> None:
    """Flush a folder's list of files to disk, on systems that can."""
    try:
        folder = os.open(path, os.O_RDONLY)
    except OSError:
        return
    with suppress(OSError):
        os.fsync(folder)
    os.close(folder)
