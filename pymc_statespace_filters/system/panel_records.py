"""The records of a panel: their labels, their rows, and the codes on which their noise depends.

A record without a panel is one without a label, and its code is 0.
"""

from collections.abc import Callable, Sequence
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np

from ..errors import ModelError
from .checks import is_integer, shortened

# Columns of the rows of a panel, see `record`.
RECORD, STEP, FIRST_INPUT = range(3)
N_COLUMNS = 3


class Records(NamedTuple):
    """Records in the order of their rows.

    ``labels`` has one label for each, None without a panel, ``starts`` (G + 1,) the first row of
    each and the number of rows, ``codes`` (G,) what their noise depends on.
    """

    labels: list[Any]
    starts: np.ndarray
    codes: np.ndarray

    @property
    def is_panel(self) -> bool:
        """Whether the records have labels."""
        return self.labels != [None]

    def slices(self) -> list[slice]:
        """The rows of each record."""
        return [slice(*ends) for ends in zip(self.starts[:-1], self.starts[1:], strict=True)]

    def of_rows(self) -> np.ndarray:
        """The number of the record of each row, (J,)."""
        return np.repeat(np.arange(len(self.labels)), np.diff(self.starts))

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """The values (J, ...) of each record."""
        return [values[rows] for rows in self.slices()]

    def check_each(self, check: Callable[..., Any], *parts: Sequence[Any]) -> list[Any]:
        """Check what each record has; an error names the record of a panel and its first row."""
        if not self.is_panel:
            return [check(*own) for own in zip(*parts, strict=True)]
        found = []
        for label, first, *own in zip(self.labels, self.starts, *parts, strict=False):
            try:
                found.append(check(*own))
            except ModelError as error:
                raise ModelError(f"record {label!r}, whose first row is {first}: {error}") from None
        return found


# A record without a panel, before the number of its rows is known.
ALONE = Records([None], np.zeros(1, np.int64), np.zeros(1, np.int64))


def records_of(panel: Any) -> Records:
    """Check the labels of all rows, of one record together, and find the records."""
    labels = np.asarray(panel)
    if labels.ndim != 1 or labels.size == 0:
        raise ModelError(
            f"panel must be a vector, the label of the record of each row, got {shortened(panel)}"
        )
    if labels.dtype.kind not in "iu":
        labels = _integers_or_texts(labels)
    has_texts = labels.dtype.kind == "O"
    codes = np.array([_hash(text) for text in labels] if has_texts else labels, dtype=np.int64)
    starts = np.flatnonzero(np.concatenate([[True], codes[1:] != codes[:-1], [True]]))
    seen: dict[Any, int] = {}
    for first in starts[:-1].tolist():
        label = labels[first]
        if label in seen:
            raise ModelError(
                f"panel must have the rows of a record together, got record {label!r} in row "
                f"{seen[label]} and, behind others, in row {first}: sort the rows by record, then "
                "by time"
            )
        seen[label] = first
    found = [label.item() if isinstance(label, np.generic) else label for label in seen]
    return Records(found, starts, codes[starts[:-1]])


def rows_of_copies(steps: np.ndarray, n: int) -> np.ndarray:
    """The rows of a panel of n copies of a record (J,), or of the records of a panel (J, 3)."""
    rows = steps
    if steps.ndim == 1:
        rows = np.zeros((len(steps), N_COLUMNS), np.int64)
        rows[:, STEP] = steps
    number = np.cumsum(np.diff(rows[:, RECORD], prepend=rows[0, RECORD]) != 0)
    copies = np.tile(rows, (n, 1))
    copies[:, RECORD] = np.add.outer(np.arange(n) * (number[-1] + 1), number).ravel()
    return copies


def _integers_or_texts(labels: np.ndarray) -> np.ndarray:
    """Labels of one kind, integers or objects; tables hold integers also as floats and objects."""
    if labels.dtype.kind == "f":
        is_number = np.isfinite(labels) & (labels == np.round(labels))
    else:
        is_number = np.array([is_integer(label) for label in labels])
    is_text = np.array([isinstance(label, str) and label != "" for label in labels])
    if not (is_label := is_number if is_number.any() else is_text).all():
        row = int(np.argmin(is_label))
        raise ModelError(
            f"panel must hold integers or texts, got {labels.tolist()[row]!r} in row {row}: every "
            "row needs the label of its record"
        )
    return labels.astype("int64" if is_number.any() else object)


def _hash(label: str) -> int:
    """63 bits of a text, the same in every process."""
    return int.from_bytes(blake2b(label.encode(), digest_size=8).digest()) >> 1
