"""Named arrays as bytes: a line of JSON with a key, names, types and shapes, then the arrays."""

import json
from collections.abc import Iterable, Mapping
from itertools import islice
from typing import NamedTuple

import numpy as np

Arrays = Mapping[str, np.ndarray]


class Stored(NamedTuple):
    """What was stored under a key, by the names of arrays."""

    draws: dict[str, np.ndarray]  # all draws, from the first record to the last
    state: dict[str, np.ndarray]  # the state after the last of them


def encoded(key: str, draws: Arrays, state: Arrays) -> bytes:
    """One record: the draws since the one before, and the whole state after them.

    Raises `ValueError` if an array has Python objects.
    """
    parts = [{name: np.asarray(array) for name, array in some.items()} for some in (draws, state)]
    arrays = [array for part in parts for array in part.values()]
    if any(array.dtype.hasobject for array in arrays):
        raise ValueError("arrays of Python objects cannot be stored")
    layouts = [
        [(name, array.dtype.str, array.shape) for name, array in part.items()] for part in parts
    ]
    line = json.dumps([key, *layouts]).encode() + b"\n"
    return b"".join([line, *(array.tobytes() for array in arrays)])


def decoded(content: bytes) -> tuple[str, Stored]:
    """The key and the arrays of a record; they are read-only."""
    offset = content.index(b"\n") + 1
    key, *layouts = json.loads(content[:offset])
    arrays = []
    for _, dtype, shape in (array for layout in layouts for array in layout):
        count = int(np.prod(shape))
        arrays.append(np.frombuffer(content, dtype, count, offset).reshape(shape))
        offset += arrays[-1].nbytes
    rest = iter(arrays)
    names = [[name for name, *_ in layout] for layout in layouts]
    return key, Stored(*(dict(zip(some, islice(rest, len(some)), strict=True)) for some in names))


def joined(records: Iterable[Stored]) -> Stored:
    """All draws of some records, and the last state."""
    draws: list[dict[str, np.ndarray]] = []
    state: dict[str, np.ndarray] = {}
    for record in records:
        draws.append(record.draws)
        state = record.state
    names = draws[0] if draws else {}
    return Stored(
        {name: np.concatenate([one[name] for one in draws]) for name in names},
        {name: array.copy() for name, array in state.items()},
    )
