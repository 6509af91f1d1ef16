"""The table of `relevance`."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ...tables import SentenceTable
from .weighed import N_POINTS, Weighed

SURE = 6.0  # nats of gain, from which a term is not in question

Array = NDArray[np.float64]


class Optimised(NamedTuple):
    """Priors of the largest evidence, and the true density under them.

    ``prior_sd`` and ``relevance`` (p,) are zero where a term is absent.
    """

    prior_sd: Array
    relevance: Array
    weighed: Weighed


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
        "rivals",
    )

    def __init__(
        self, data: Any = None, *, log_evidence: float, log_evidence_se: float, **settings: Any
    ) -> None:
        super().__init__(data, **settings)
        self.log_evidence, self.log_evidence_se = log_evidence, log_evidence_se

    @property
    def inclusion(self) -> dict[str, float]:
        """For `select_terms`: zero, always absent, for irrelevant terms.

        Rivals of a term with a gain below `SURE` stay open, as other terms do: 1/2.
        """
        in_doubt = self.loc[~(self["gain"] >= SURE), "rivals"]
        rivals = {one for names in in_doubt for one in names.split("; ")}
        is_open = (self["prior_sd"] > 0) | self.index.isin(rivals)
        return {str(name): 0.5 if one else 0.0 for name, one in is_open.items()}

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
        return [one if isinstance(one, str) else f"{one:.3g}" for one in self[name]]


def relevance_table(
    names: Sequence[str], best: Optimised, without: Mapping[int, Optimised]
) -> RelevanceTable:
    """The table of the optimum, and of those without one of its terms."""
    table = pd.DataFrame(
        {
            "relevance": best.relevance,
            "prior_sd": best.prior_sd,
            "mean": best.weighed.mean,
            "sd": best.weighed.sd,
        },
        index=pd.Index(names, name="term"),
    )
    gains = [_gain(best, without.get(j), names) for j in range(len(names))]
    table = table.join(pd.DataFrame(gains, index=table.index))
    with np.errstate(divide="ignore"):
        table["alpha"] = table["prior_sd"] ** -2.0
    log_evidence, se = best.weighed.evidence
    said = [*_sentences(table, log_evidence, se)]
    return RelevanceTable(table, log_evidence=log_evidence, log_evidence_se=se, sentences=said)


def _gain(best: Optimised, without: Optimised | None, names: Sequence[str]) -> dict[str, Any]:
    """The columns that compare the optimum with that without a term, None if it is the same."""
    if without is None:
        known = {"gain": 0.0, "gain_se": 0.0, "rivals": "", "pareto_k": -np.inf}
        return known | {"n_effective": np.inf, "doubts": ""}
    one, other = best.weighed.evidence, without.weighed.evidence
    doubts = "; ".join(without.weighed.doubts())
    rivals = (best.prior_sd == 0) & (without.prior_sd > 0)
    return {
        "gain": np.nan if doubts else one.value - other.value,
        "gain_se": np.nan if doubts else float(np.hypot(one.error, other.error)),
        "rivals": "; ".join(np.array(names)[rivals]),
        "pareto_k": without.weighed.tail,
        "n_effective": other.kish_ess(N_POINTS),
        "doubts": doubts,
    }


def _sentences(table: pd.DataFrame, evidence: float, error: float) -> Iterator[str]:
    """What the display says below the columns."""
    yield f"Log-evidence under these priors: {evidence:.2f} ± {error:.2f}."
    # With a negative gain the optimum was a local one, and is better without the term.
    if out := [str(one) for one in table.index[(table["prior_sd"] == 0) | (table["gain"] < 0)]]:
        yield f"Irrelevant: {', '.join(out)}."
    for name, row in table.iterrows():
        if row["doubts"]:
            yield f"{name}: {row['doubts']}."
