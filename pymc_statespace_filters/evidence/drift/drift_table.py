"""The table of `drift_evidence`."""

from collections.abc import Iterator
from typing import ClassVar

import pandas as pd
import xarray as xr

from ..comparison.evidence_table import EvidenceTable


class DriftTable(EvidenceTable):
    """A DataFrame with a row for each strength, and the same for other widths of the priors.

    Attributes
    ----------
    widths : xarray.Dataset
        For `plot_prior_sensitivity`.
    """

    _metadata: ClassVar[list[str]] = ["sentences", "widths"]
    main_columns: ClassVar[tuple[str, ...]] = (
        "prob",
        "prob_low",
        "prob_high",
        "log_bayes_factor",
        "se",
    )
    widths: xr.Dataset


def sentences(table: pd.DataFrame, others: list[str], ci_prob: float) -> Iterator[str]:
    """What the display says below the columns; ``others`` are the other free variables."""
    yield (
        "prob is that of drift, against the model with the strength at zero and the same priors of "
        f"{', '.join(others)}."
    )
    if open_ones := [
        name for name, row in table.iterrows() if row["undecided"] and not row["doubts"]
    ]:
        yield f"Undecided at {100 * ci_prob:g} %: whether {' and '.join(open_ones)} is zero."
    for name, row in table.iterrows():
        if row["doubts"]:
            yield f"{name}: {row['doubts']}."
