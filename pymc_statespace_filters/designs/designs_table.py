"""The table of `expected_information`: its columns, and what it says of them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..evidence.comparison.comparison_sentences import approximation
from ..filters.written import short_form
from ..tables import SentenceTable, joined, quoted
from .information import (
    DECIDED,
    INVERSE,
    MISLED,
    MODEL,
    PARAMETERS,
    Estimate,
    best_first,
    estimate,
    estimate_of_share,
)
from .rivals import Rival

SIGNIFICANT = 2.0  # standard errors
MOST_INVERSE = 15.0  # log of a mean that is 1: it is as large with a probability of exp(-15)

Array = NDArray[np.float64]


class DesignsTable(SentenceTable):
    """Designs, best first; the sentences are about the ranking and its numbers."""

    main_columns: ClassVar[tuple[str, ...]] = (
        "information",
        "low",
        "high",
        "se",
        "diff",
        "dse",
        DECIDED,
        MISLED,
    )

    def _texts(self, name: str) -> list[str]:
        return ["unknown" if math.isnan(value) else f"{value:.3f}" for value in self[name]]


def table_of(
    replicated: Mapping[str, Mapping[str, Array]],
    n_kept: Mapping[str, Sequence[int]],
    rivals: Mapping[str, Rival],
    weights: Array,
    var_names: Sequence[str] | None,
) -> DesignsTable:
    """The table of quantities by design, see `information.replicates`.

    ``n_kept`` are the numbers of records of each model under each design.
    """
    about = "the parameters" if var_names is None else joined(list(var_names))
    ranks_by = PARAMETERS + "[0]" if len(rivals) == 1 else MODEL
    order, differences = best_first({name: own[ranks_by] for name, own in replicated.items()})
    rows = {
        name: _ranking(replicated[name], ranks_by, differences[name])
        | _further(replicated[name], n_kept[name], list(rivals))
        | {f"n_records[{model}]": n for model, n in zip(rivals, n_kept[name], strict=True)}
        | {f"n_draws[{model}]": len(rival.theta) for model, rival in rivals.items()}
        | {f"n_effective[{model}]": rival.n_effective for model, rival in rivals.items()}
        for name in order
    }
    data = pd.DataFrame.from_dict(rows, orient="index")
    data.index.name = "design"
    said = [*_sentences(data, rivals, weights, about)]
    if var_names is None:
        said += _impossible(replicated, rivals)
    return DesignsTable(data, sentences=said)


def _ranking(own: Mapping[str, Array], ranks_by: str, difference: Estimate) -> dict[str, Any]:
    kind, _, index = ranks_by.partition("[")
    index = f"[{index}" if index else ""
    middle, low, high = (estimate(own[f"{kind}{end}{index}"]) for end in ("", "_low", "_high"))
    return {
        "information": middle.value, "low": low.value, "high": high.value, "se": middle.se,
        "diff": difference.value, "dse": difference.se, "change": middle.change,
        "low_se": low.se, "high_se": high.se,
    }  # fmt: skip


def _further(
    own: Mapping[str, Array], n_kept: Sequence[int], models: list[str]
) -> dict[str, float]:
    """The value of every other quantity, its error and its change, by the names of the models."""
    if len(models) == 1:
        return {}
    found: dict[str, float] = {}
    for key, replicates in own.items():
        kind, _, index = key.removesuffix("]").partition("[")
        if kind.startswith((MODEL, INVERSE)):
            continue
        numbers = [int(i) for i in index.split(", ")] if index else list(range(len(models)))
        label = f"[{', '.join(models[i] for i in numbers)}]" if index else ""
        if kind in (DECIDED, MISLED):
            one = estimate_of_share(replicates, sum(n_kept[i] for i in numbers))
        else:
            one = estimate(replicates)
        found[f"{kind}{label}"] = one.value
        if not kind.endswith(("_low", "_high")):
            found |= {f"{kind}_se{label}": one.se, f"{kind}_change{label}": one.change}
    return found


def _sentences(
    table: pd.DataFrame, rivals: Mapping[str, Rival], weights: Array, about: str
) -> Iterator[str]:
    if len(rivals) == 1:
        yield f"Ranked by the expected information about {about}, in nats."
    else:
        entropy = -(weights * np.log(weights)).sum()
        yield (
            "Ranked by the expected information about which model is true, in nats; certainty is "
            f"{entropy:.3f}."
        )
    yield from _not_told_apart(table)
    yield from _above_the_draws(table, rivals, about)
    for name, rival in rivals.items():
        if len(rival.theta) < rival.n_given:
            yield (
                f"{len(rival.theta)} of {rival.n_given} draws{_of(name, rivals)} are used, evenly "
                f"thinned; all are worth {rival.n_effective} independent ones."
            )
    approximate = [name for name, rival in rivals.items() if not rival.is_exact]
    yield from approximation(approximate, len(rivals))


def _of(name: str, rivals: Mapping[str, Rival]) -> str:
    return "" if len(rivals) == 1 else f" of {name!r}"


def _impossible(
    replicated: Mapping[str, Mapping[str, Array]], rivals: Mapping[str, Rival]
) -> Iterator[str]:
    """Say which designs prove a filter wrong, by Markov's inequality."""
    for i, (name, rival) in enumerate(rivals.items()):
        logs = {design: own[f"{INVERSE}[{i}]"][0] for design, own in replicated.items()}
        if wrong := [design for design, log in logs.items() if log > MOST_INVERSE]:
            other = "GridFilter()" if rival.system.n == 1 else "another filter"
            yield (
                f"With {quoted(wrong)} other parameters explain records{_of(name, rivals)} better "
                f"by {max(logs.values()):.0f} nats than those that made them, which is impossible: "
                f"the likelihood of {short_form(rival.filter)} is wrong there, and all numbers of "
                f"these designs with it: take {other}."
            )


def _not_told_apart(table: pd.DataFrame) -> Iterator[str]:
    first, *others = table.index
    near = [n for n in others if -table.loc[n, "diff"] < SIGNIFICANT * table.loc[n, "dse"]]
    if near:
        verb = "is" if len(near) == 1 else "are"
        bounds = (table["high"] - table["low"])[[first, *near]]
        together = "a larger n_draws brings low and high together, and "
        yield (
            f"{quoted(near)} {verb} not told apart from {first!r} (a difference below 2 dse): "
            f"{together if bounds.max() > table.loc[near, 'dse'].max() else ''}"
            "a larger n_records, or target_se, makes the errors smaller."
        )


def _above_the_draws(table: pd.DataFrame, rivals: Mapping[str, Rival], about: str) -> Iterator[str]:
    """Say where so few draws are near the one that made a record that they tell too little."""
    for name, rival in rivals.items():
        low, high = (
            table[end] if len(rivals) == 1 else table[f"{PARAMETERS}_{end}[{name}]"]
            for end in ("low", "high")
        )
        most = math.log(len(rival.theta))
        if not (near := list(table.index[(low > most - 1) | (high - low > 1)])):
            continue
        has_more = len(rival.theta) < rival.n_effective or rival.n_effective == rival.n_given
        remedy = "more n_draws" if has_more else "longer chains"
        which = ", and about which model," if len(rivals) > 1 else ""
        yield (
            f"With {quoted(near)} information about {about}{_of(name, rivals)}{which} may be above "
            f"what the draws can show, the log of their number, {most:.1f}: there low is a lower "
            f"bound, and the others are not reliable; {remedy} would show more."
        )
