"""What `compare_evidence` says of its numbers: sentences, and the column of errors of the step."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ...errors import ModelError
from ...tables import joined, quoted
from ..evidence import Evidence

SIGNIFICANT = 2.0  # standard errors


def sentences(
    table: pd.DataFrame, evidences: Mapping[str, Evidence], ci_prob: float
) -> Iterator[str]:
    """Yield what applies to the compared models; ``table`` is in order of probability."""
    yield from _undecided(table, ci_prob)
    yield from _criteria(table)
    yield from _warnings(evidences)
    yield from _approximate(evidences)
    yield from step_error_sentences(table)


def needs_warning(evidence: Evidence) -> bool:
    """Whether the evidence is less reliable than its standard error suggests."""
    return any(_reasons(evidence))


def _undecided(table: pd.DataFrame, ci_prob: float) -> Iterator[str]:
    best, *others = table.index
    rivals = [name for name in others if table.loc[name, "undecided"]]
    if not rivals:
        return
    errors = table.loc[[best, *rivals], "se"]
    remedy = ": smaller errors, from more draws or a smaller target_se, would decide"
    if not (errors > 0).all():  # unknown, or a tie of exact numbers
        remedy = ""
    which = f"whether {best!r} or {rivals[0]!r} is more probable"
    if len(rivals) > 1:
        which = f"which of {quoted([best, *rivals])} is the most probable"
    yield f"Undecided at {100 * ci_prob:g} %: {which}{remedy}."


def _criteria(table: pd.DataFrame) -> Iterator[str]:
    """Say that AIC or BIC choose another model than the evidence, and why."""
    chosen = str(table["log_evidence"].idxmax())
    rivals = {
        name.upper(): str(table[name].idxmin())
        for name in ("aic", "bic")
        if table.loc[chosen, name] > table[name].min()
    }
    if not rivals:
        return
    if len(set(rivals.values())) == 1:
        choices = f"{' and '.join(rivals)} choose {next(iter(rivals.values()))!r}"
        choices = choices if len(rivals) > 1 else choices.replace("choose", "chooses")
    else:
        choices = " and ".join(f"{name} chooses {rival!r}" for name, rival in rivals.items())
    compared = list(dict.fromkeys([*rivals.values(), chosen]))
    why = _against_bic(table, compared) if "BIC" in rivals else _against_aic(table, compared)
    yield f"{choices}, the evidence {chosen!r}: {why}."


def _against_bic(table: pd.DataFrame, names: list[str]) -> str:
    parts = []
    for name in names:
        row = table.loc[name]
        excess = _penalty(row) - row["n_parameters"] / 2 * math.log(row["n_observations"])
        parts.append(f"{name!r} by {abs(excess):.1f} nats {'more' if excess > 0 else 'less'}")
    return (
        f"the priors penalise {joined(parts)} than BIC's k/2 ln J does; the wider a prior, the "
        "larger its penalty"
    )


def _against_aic(table: pd.DataFrame, names: list[str]) -> str:
    parts = [
        f"{name!r} by {_penalty(table.loc[name]):.1f} for {table.loc[name, 'n_parameters']}"
        for name in names
    ]
    return (
        "AIC penalises each parameter by 1 nat, the priors penalise "
        f"{joined(parts)}; the wider a prior, the larger its penalty"
    )


def _penalty(row: pd.Series) -> float:
    """By how many nats the evidence is below the maximum of the likelihood."""
    return float(row["max_log_likelihood"] - row["log_evidence"])


def _warnings(evidences: Mapping[str, Evidence]) -> Iterator[str]:
    """Name the models with a warning, those with the same one together."""
    models: dict[str, list[str]] = {}
    for name, evidence in evidences.items():
        reasons = list(_reasons(evidence))
        if reasons:
            models.setdefault(f"({evidence.estimator}): {'; '.join(reasons)}", []).append(name)
    for text, names in models.items():
        yield f"Warning for {quoted(names)} {text.removesuffix('.')}."


def _reasons(evidence: Evidence) -> Iterator[str]:
    if evidence.doubts:
        yield evidence.doubts
    if evidence.improper and "not normalised" not in evidence.doubts:
        yield f"the prior of {evidence.improper} is improper or not normalised"
    if math.isnan(evidence.se):
        yield "the estimate has no standard error, so that no interval is known"
    if evidence.noise == "held":
        yield "the chains held one noise seed, and se excludes the error of the filter"


def _approximate(evidences: Mapping[str, Evidence]) -> Iterator[str]:
    names = [name for name, evidence in evidences.items() if evidence.approximate]
    yield from approximation(names, len(evidences))


def approximation(names: Sequence[str], n_models: int) -> Iterator[str]:
    """Yield whose likelihood is approximate, of models with these names among so many."""
    if not names:
        return
    of_whom = "all models" if len(names) == n_models > 1 else quoted(names)
    yield (
        f"The likelihood of {of_whom} is a filter's approximation; se does not include its error."
    )


def step_error_columns(step_errors: Any, names: Sequence[str]) -> pd.DataFrame:
    """``step_error`` and ``step_error_se`` of every model from tables of `step_error`.

    NaN for models without a table, which have no integrator.
    """
    if not isinstance(step_errors, Mapping) or not set(step_errors) <= set(names):
        raise ModelError(
            "step_errors must map names of the models to tables of step_error, "
            "{name: psf.step_error(idata, model), ...}, because evidences hold neither draws nor "
            f"equations; got {_shown(step_errors)} for the models {list(names)}"
        )
    found = {name: _first_halving(name, table) for name, table in step_errors.items()}
    unknown = (np.nan, np.nan)
    rows = [found.get(name, unknown) for name in names]
    return pd.DataFrame(
        rows, columns=["step_error", "step_error_se"], index=pd.Index(names, name="model")
    )


def step_error_sentences(table: pd.DataFrame) -> Iterator[str]:
    """Yield which log-evidences depend on the step by more than their standard errors."""
    if "step_error" not in table:
        return
    change, se = table["step_error"], table["step_error_se"]
    known = (change.abs() > table["se"].fillna(0.0)) & (change.abs() > SIGNIFICANT * se)
    for name in table.index[known]:
        yield (
            f"With half the integration step the log-evidence of {name!r} is "
            f"{'higher' if change[name] > 0 else 'lower'} by {abs(change[name]):.2g}, and se "
            "excludes that: raise substeps and sample again."
        )


def _first_halving(name: str, table: Any) -> tuple[float, float]:
    wanted = ["log_evidence_change", "log_evidence_se"]
    if not (isinstance(table, pd.DataFrame) and set(wanted) <= set(table.columns) and len(table)):
        raise ModelError(
            f"step_errors[{name!r}] must be a table of psf.step_error(idata, model), got "
            f"{type(table).__name__}"
        )
    change, se = table[wanted].iloc[0]
    return float(change), float(se)


def _shown(step_errors: Any) -> str:
    return repr(list(step_errors) if isinstance(step_errors, Mapping) else step_errors)
