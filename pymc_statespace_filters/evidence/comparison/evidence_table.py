"""The table of `compare_evidence`."""

import math
from typing import ClassVar

import pandas as pd

from ...tables import SentenceTable

# Decimals of the log-evidences and their errors: two digits of the smallest error, within limits.
FEWEST_DECIMALS, MOST_DECIMALS = 2, 4


class EvidenceTable(SentenceTable):
    """The comparison of models; the sentences are about them."""

    main_columns: ClassVar[tuple[str, ...]] = (
        "prob",
        "prob_low",
        "prob_high",
        "log_evidence",
        "se",
        "step_error",
    )

    def _texts(self, name: str) -> list[str]:
        if name in ("log_evidence", "log_bayes_factor", "se", "step_error"):
            decimals = _decimals(self["se"]) if "se" in self else FEWEST_DECIMALS
            return [_fixed(value, decimals) for value in self[name]]
        return [_probability(value) for value in self[name]]


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
