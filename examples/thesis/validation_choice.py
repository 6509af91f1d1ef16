"""How often each of the rivals is chosen, and from how many measurements on."""

import numpy as np
import pandas as pd
import xarray as xr

EXPONENT = 3.0  # alpha of the thesis's correction J^(-k alpha / 2), k the number of parameters


def corrected(log_evidences: xr.DataArray) -> xr.DataArray:
    """Apply the correction to log-evidences: `dimension_prior` for arrays with k and J."""
    return log_evidences - EXPONENT / 2 * log_evidences["k"] * np.log(log_evidences["J"])


def chosen(log_evidences: xr.DataArray) -> pd.DataFrame:
    """Return the percentage of records on which a model has the largest evidence, for every J."""
    best = log_evidences.argmax("model")
    return pd.DataFrame({
        model: 100 * (best == i).mean("record").to_series()
        for i, model in enumerate(log_evidences["model"].values)
    })  # fmt: skip


def crossings(log_evidences: dict[str, xr.DataArray]) -> pd.DataFrame:
    """Return the number of measurements from which M1 is chosen on most records.

    The columns are flat priors of density one, the same with the correction, and Uniform priors on
    the same supports, which divide by their volume.
    """
    rows = {}
    for name, found in log_evidences.items():
        rows[name] = {}
        priors = {
            "flat": found,
            "flat, corrected": corrected(found),
            "Uniform": found - found["log_volume"],
        }
        for column, values in priors.items():
            majority = (chosen(values)["M1"] > 50).astype(int)
            from_here_on = majority[::-1].cummin()[::-1]
            rows[name][column] = str(from_here_on.idxmax()) if from_here_on.any() else "none"
    return pd.DataFrame(rows).T.rename_axis("measured")
