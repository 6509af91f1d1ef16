"""The table of `identifiability`, with what it says in sentences."""

from collections.abc import Iterator
from typing import ClassVar, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..tables import SentenceTable, joined
from .weak_directions import (
    WEAK,
    combination_label,
    determined_combinations,
    precision,
    weak_directions,
)

DIFFERENT = 1.25  # factor between two ratios from which a posterior is not normal
FEWEST_FULL = 3  # full posteriors that are compared; fewer scatter as much as they may differ
NOTHING = 0.97  # ratio, from which a parameter is as uncertain as before

Array = NDArray[np.float64]
Columns = NDArray[np.int64]


class Identifiability(SentenceTable):
    """A DataFrame with a row for each parameter, and the weak directions.

    Attributes
    ----------
    directions : pandas.DataFrame
        A row for each direction in which half of the prior's sd or more remains, weakest first:
        ``remains``, the share that does, and the part of each parameter in sds of its prior.
    combinations : pandas.DataFrame
        What is determined of parameters that are not determined alone: sd and ratio.
    """

    _metadata: ClassVar[list[str]] = ["sentences", "directions", "combinations"]
    main_columns = ("ratio", "se", "q05", "q95", "coordinate", "prior_sd", "posterior_sd")

    directions: pd.DataFrame
    combinations: pd.DataFrame

    def _texts(self, name: str) -> list[str]:
        if name == "coordinate":
            return list(self[name])
        return [f"{value:.2g}" if name.endswith("sd") else f"{value:.3f}" for value in self[name]]


class Expected(NamedTuple):
    """Expected posteriors beside the prior, in the coordinates of k parameters.

    ``prior`` (k, k) and ``covs`` (m, k, k) are covariances, and ``full_sds`` those (k,) of full
    posteriors at the first of the m points, None where importance sampling failed.
    """

    labels: list[str]
    kinds: NDArray[np.str_]
    prior: Array
    covs: Array
    full_sds: list[Array | None]

    @property
    def sds(self) -> Array:
        """Of the posteriors (m, k)."""
        return np.sqrt(np.diagonal(self.covs, axis1=1, axis2=2))

    @property
    def prior_sd(self) -> Array:
        """Of the prior (k,)."""
        return np.sqrt(np.diagonal(self.prior))

    def compared(self) -> tuple[int, Array, Array]:
        """The number of full posteriors, their mean ratio (k,), and the expected one there.

        None where they are too few.
        """
        passed = [i for i, sd in enumerate(self.full_sds) if sd is not None]
        if len(passed) < FEWEST_FULL:
            return 0, np.full_like(self.prior_sd, np.nan), np.full_like(self.prior_sd, np.nan)
        full = np.mean([self.full_sds[i] for i in passed], axis=0)
        return len(passed), full / self.prior_sd, self.sds[passed].mean(axis=0) / self.prior_sd


def table_of(expected: Expected, chosen: Columns, sentences: list[str]) -> Identifiability:
    """The table of the ``chosen`` parameters, with these sentences first."""
    labels, kinds = expected.labels, expected.kinds
    ratios = expected.sds / expected.prior_sd
    q05, q95 = np.quantile(ratios, [0.05, 0.95], axis=0)
    columns = {
        "ratio": ratios.mean(axis=0),
        "se": ratios.std(axis=0, ddof=1) / len(ratios) ** 0.5,
        "q05": q05,
        "q95": q95,
        "coordinate": kinds,
        "prior_sd": expected.prior_sd,
        "posterior_sd": expected.sds.mean(axis=0),
        "full_ratio": expected.compared()[1],
    }
    table = pd.DataFrame(columns, index=pd.Index(labels, name="parameter"))
    found = determined_combinations(expected.covs, expected.prior, kinds, chosen)
    names = [
        combination_label(one, labels, is_log=kinds[one != 0][0] == "log")
        for one in found.exponents
    ]
    index = pd.Index(names, name="combination", dtype=object)
    combinations = pd.DataFrame({"sd": found.sd, "ratio": found.ratio}, index=index)
    further = [
        *_of_combinations(table, found.exponents, combinations),
        *_of_parameters(table, expected, chosen, found.exponents),
        *_of_full(expected, chosen),
    ]
    return Identifiability(
        table.iloc[chosen],
        directions=weak_directions(expected.covs, expected.prior, labels),
        combinations=combinations,
        sentences=[*sentences, *further],
    )


def _of_combinations(
    table: pd.DataFrame, exponents: Columns, combinations: pd.DataFrame
) -> Iterator[str]:
    for one, (name, sd) in zip(exponents, combinations["sd"].items(), strict=True):
        members = table[one != 0]
        how_well = precision(sd, is_log=members["coordinate"].iloc[0] == "log")
        yield (
            f"{name} is determined {how_well}, {joined(members.index)} alone are not: "
            f"{_remain(members)}."
        )


def _of_parameters(
    table: pd.DataFrame, expected: Expected, chosen: Columns, exponents: Columns
) -> Iterator[str]:
    """What is said of parameters that are in no combination, and whose ratio is believed."""
    is_open = ~(exponents != 0).any(axis=0) & ~_differs(expected)
    alone = table.iloc[[i for i in chosen if is_open[i]]]
    nothing, weak = alone["ratio"] >= NOTHING, alone["ratio"] >= WEAK
    say = "The data say" if expected.compared()[0] else "If posteriors are normal, the data say"
    if nothing.any():
        yield f"{say} nothing of {joined(alone.index[nothing])}."
    little = alone[weak & ~nothing]
    if len(little):
        yield f"{say} little of {joined(little.index)}: {_remain(little)}."


def _of_full(expected: Expected, chosen: Columns) -> Iterator[str]:
    n_full, n_failed = len(expected.full_sds), sum(sd is None for sd in expected.full_sds)
    n_compared, full, predicted = expected.compared()
    if n_failed:
        unchecked = (
            " The ratios are those of normal posteriors, and not checked; if a parameter is the "
            "width of a population, its ratio is too large."
        )
        yield (
            f"Importance sampling of the full posteriors of {n_failed} of {n_full} "
            "simulated records failed, as they are far from normal or have many parameters: "
            "simulate some records, and sample their posteriors." + unchecked * (not n_compared)
        )
    differs = _differs(expected)
    texts = [
        f"of {expected.labels[i]} {full[i]:.2g} instead of {predicted[i]:.2g}"
        for i in chosen
        if differs[i]
    ]
    if texts:
        yield (
            f"The posteriors are not normal: by full posteriors of {n_compared} simulated records "
            f"the ratio is {joined(texts)}."
        )


def _differs(expected: Expected) -> NDArray[np.bool_]:
    """Of which parameters full posteriors have another ratio."""
    _, full, predicted = expected.compared()
    return np.asarray(np.abs(np.log(full / predicted)) > np.log(DIFFERENT))


def _remain(table: pd.DataFrame) -> str:
    shares = [f"{100 * ratio:.0f} %" for ratio in table["ratio"]]
    if len(shares) == 1:
        return f"{shares[0]} of its prior remains"
    return f"{joined(shares)} of their priors remain"
