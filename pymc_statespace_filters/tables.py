"""Tables that print their main columns, and sentences below them, in 80 columns of text."""

import re
from collections.abc import Callable, Iterable, Sequence
from html import escape
from textwrap import fill
from typing import Any, ClassVar, Self

import pandas as pd

WIDTH = 80


def wrapped(sentences: Sequence[str]) -> list[str]:
    """Sentences as paragraphs that fit into `WIDTH`, with an indent from the second line on."""
    return [fill(text, WIDTH, subsequent_indent="  ") for text in sentences]


def quoted(names: Iterable[str]) -> str:
    """Names in quotes, joined."""
    return joined([repr(name) for name in names])


def joined(parts: Iterable[str], word: str = "and") -> str:
    """Join as in "a, b and c"."""
    *others, last = parts
    return f"{', '.join(others)} {word} {last}" if others else last


class SentenceTable(pd.DataFrame):
    """A DataFrame whose display has its main columns, and below them sentences.

    ``_metadata`` names what it has beside them. Slices, results of operations and of
    ``table.copy()`` are plain DataFrames.
    """

    main_columns: ClassVar[tuple[str, ...]]
    _metadata: ClassVar[list[str]] = ["sentences"]

    def __init__(self, data: Any = None, *, sentences: Sequence[str] = (), **further: Any) -> None:
        super().__init__(data)
        for name, value in further.items():
            setattr(self, name, value)
        self.sentences = tuple(sentences)

    @property
    def _constructor(self) -> Callable[..., pd.DataFrame]:
        return pd.DataFrame

    # Not `copy`, with which pandas begins operations that make the sentences wrong.
    def __copy__(self, deep: bool = False) -> Self:
        return type(self)(self.copy(deep), **{name: getattr(self, name) for name in self._metadata})

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> Self:
        return self.__copy__(deep=True)

    def __repr__(self) -> str:
        shown = self._shown().to_string(
            line_width=WIDTH, max_rows=pd.get_option("display.max_rows")
        )
        return "\n".join([shown, *wrapped(self._all_sentences())])

    def _repr_html_(self) -> str:
        sentences = "".join(f"<p>{escape(text)}</p>" for text in self._all_sentences())
        return self._shown().to_html(max_rows=pd.get_option("display.max_rows")) + sentences

    def _shown(self) -> pd.DataFrame:
        """The main columns that are still there, as texts."""
        names = [name for name in self.main_columns if name in self]
        return pd.DataFrame({name: self._texts(name) for name in names}, index=self.index)

    def _texts(self, name: str) -> list[str]:
        """The cells of a column as they are shown."""
        raise NotImplementedError

    def _all_sentences(self) -> tuple[str, ...]:
        others = [str(name) for name in self.columns if name not in self.main_columns]
        others = list(dict.fromkeys(re.sub(r"\[.*\]", "[...]", name) for name in others))
        further = f"Further columns, shown by .to_string(): {', '.join(others)}."
        return (*self.sentences, further) if others else self.sentences
