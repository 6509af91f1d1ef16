"""The column of `compare_evidence` that shows what a shorter integration step would change."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ...errors import ModelError

SIGNIFICANT = 2.0  # standard errors


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
