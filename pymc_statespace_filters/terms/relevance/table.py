"""The table of `relevance`."""

from collections.abc import Iterator
from typing import Any, ClassVar, Self

import numpy as np
import pandas as pd

from ...tables import SentenceTable


class RelevanceTable(SentenceTable):
    """A DataFrame with a row for each coefficient.

    Attributes
    ----------
    log_evidence, log_evidence_se : float
        Under the optimised priors, and its standard error.
    """

    _metadata: ClassVar[list[str]] = ["sentences", "log_evidence", "log_evidence_se"]
    main_columns: ClassVar[tuple[str, ...]] = (
        "relevance",
        "prior_sd",
        "mean",
        "sd",
        "gain",
        "gain_se",
    )

    def __init__(
        self, data: Any = None, *, log_evidence: float, log_evidence_se: float, **settings: Any
    ) -> None:
        super().__init__(data, **settings)
        self.log_evidence, self.log_evidence_se = log_evidence, log_evidence_se

    @property
    def inclusion(self) -> dict[str, float]:
        """For `select_terms`: zero, always absent, for irrelevant terms, and 1/2 for the others."""
        return {str(name): 0.5 if one > 0 else 0.0 for name, one in self["prior_sd"].items()}

    def __copy__(self, deep: bool = False) -> Self:
        return type(self)(
            self.copy(deep),
            sentences=self.sentences,
            log_evidence=self.log_evidence,
            log_evidence_se=self.log_evidence_se,
        )

    def _texts(self, name: str) -> list[str]:
        decimals = {"relevance": 3, "gain": 2, "gain_se": 2}
        if name in decimals:
            return [
                "unknown" if np.isnan(one) else f"{one:.{decimals[name]}f}" for one in self[name]
            ]
        return [f"{one:.3g}" for one in self[name]]


def sentences(table: pd.DataFrame, evidence: float, error: float) -> Iterator[str]:
    """What the display says below the columns."""
    yield f"Log-evidence under these priors: {evidence:.2f} ± {error:.2f}."
    if out := [str(name) for name in table.index[table["prior_sd"] == 0]]:
        yield f"Irrelevant: {', '.join(out)}."
    for name, row in table.iterrows():
        if row["doubts"]:
            yield f"{name}: {row['doubts']}."
