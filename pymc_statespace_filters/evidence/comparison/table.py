"""The table of `compare_evidence`: a DataFrame that prints its main columns, with sentences."""

import math
from collections.abc import Callable, Sequence
from html import escape
from textwrap import fill
from typing import Any, ClassVar

import pandas as pd

MAIN_COLUMNS = ("prob", "prob_low", "prob_high", "log_evidence", "se", "step_error")
WIDTH = 80
# Decimals of the log-evidences and their errors: two digits of the smallest error, within limits.
FEWEST_DECIMALS, MOST_DECIMALS = 2, 4


class EvidenceTable(pd.DataFrame):
    """A DataFrame whose display has few columns, and below them sentences about the models.

    Slices, results of operations and of ``table.copy()`` are plain DataFrames.

    Parameters
    ----------
    data : pandas.DataFrame
        With columns of `MAIN_COLUMNS`, and others.
    sentences : sequence of str
        What the display says below the columns.
    """

    _metadata: ClassVar[list[str]] = ["sentences"]

    def __init__(self, data: Any = None, *, sentences: Sequence[str] = ()) -> None:
        super().__init__(data)
        self.sentences = tuple(sentences)

    @property
    def _constructor(self) -> Callable[..., pd.DataFrame]:
        return pd.DataFrame

    # Not `copy`, with which pandas begins operations that make the sentences wrong.
    def __copy__(self, deep: bool = False) -> "EvidenceTable":
        return EvidenceTable(self.copy(deep), sentences=self.sentences)

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> "EvidenceTable":
        return self.__copy__(deep=True)

    def __repr__(self) -> str:
        shown = self._shown().to_string(
            line_width=WIDTH, max_rows=pd.get_option("display.max_rows")
        )
        lines = (fill(text, WIDTH, subsequent_indent="  ") for text in self._all_sentences())
        return "\n".join([shown, *lines])

    def _repr_html_(self) -> str:
        sentences = "".join(f"<p>{escape(text)}</p>" for text in self._all_sentences())
        return self._shown().to_html(max_rows=pd.get_option("display.max_rows")) + sentences

    def _shown(self) -> pd.DataFrame:
        """The main columns that are still there, as texts."""
        return pd.DataFrame(
            {name: _texts(name, self) for name in MAIN_COLUMNS if name in self}, index=self.index
        )

    def _all_sentences(self) -> tuple[str, ...]:
        others = [str(name) for name in self.columns if name not in MAIN_COLUMNS]
        further = f"Further columns, shown by .to_string(): {', '.join(others)}."
        return (*self.sentences, further) if others else self.sentences


def _texts(name: str, table: pd.DataFrame) -> list[str]:
    if name in ("log_evidence", "se", "step_error"):
        decimals = _decimals(table["se"]) if "se" in table else FEWEST_DECIMALS
        return [_fixed(value, decimals) for value in table[name]]
    return [_probability(value) for value in table[name]]


def _decimals(errors: pd.Series) -> int:
    """Decimals that show two digits of the smallest positive error."""
    positive = [error for error in errors if error > 0]
    wanted = 1 - math.floor(math.log10(min(positive))) if positive else FEWEST_DECIMALS
    return min(max(wanted, FEWEST_DECIMALS), MOST_DECIMALS)


def _fixed(value: float, decimals: int) -> str:
    return "unknown" if math.isnan(value) else f"{value:.{decimals}f}"


def _probability(prob: float) -> str:
    """A probability with three decimals; one that they would round to zero or one, as a limit."""
    if math.isnan(prob):
        return "unknown"
    if 0 < prob < 0.0005:
        return "<0.001"
    return ">0.999" if 0.9995 <= prob < 1 else f"{prob:.3f}"
