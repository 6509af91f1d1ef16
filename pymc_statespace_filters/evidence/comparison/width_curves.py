"""Probabilities as curves over the width of priors, whatever they are the probabilities of."""

from collections.abc import Iterable, Sequence

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from ...errors import ModelError
from .scaled_prior import ReweightedEvidence
from .selection import probabilities

WIDTHS = np.geomspace(0.25, 4, 17)

Array = NDArray[np.float64]


def width_factors(widths: ArrayLike | None) -> Array:
    """Check the widths of priors; by default those of `WIDTHS`."""
    if widths is None:
        return WIDTHS
    try:
        factors = np.asarray(widths, dtype=np.float64)
    except (TypeError, ValueError):
        factors = np.empty(0)
    if factors.ndim != 1 or factors.size == 0 or not np.isfinite(factors).all():
        raise ModelError(f"widths must be one-dimensional finite numbers, got {widths!r}")
    if not (factors > 0).all():
        raise ModelError(f"widths must be positive, got {widths!r}")
    return factors


def curves_of_models(
    log_evidence: Array,
    se: Array,
    log_prior: Array,
    reweighted: Sequence[Sequence[ReweightedEvidence]],
    ci_prob: float,
) -> dict[str, Array]:
    """What `prior_sensitivity` returns of m models at w widths, (m, w) each.

    ``log_evidence``, ``se`` and ``log_prior`` (m,) are those under the priors as they are, and
    ``reweighted`` has what the draws of each model say about every width. NaN where that is
    unreliable.
    """
    known = np.array([[one.is_reliable for one in of_model] for of_model in reweighted])
    ratio, error, n_effective, pareto_k, beyond = np.moveaxis(np.array(reweighted), -1, 0)
    log_evidence = np.where(known, log_evidence[:, np.newaxis] + ratio, np.nan)
    se = np.where(known, np.hypot(se[:, np.newaxis], error), np.nan)
    log_weight = log_evidence + log_prior[:, np.newaxis]
    of_widths = [
        probabilities(weights, errors, ci_prob)
        for weights, errors in zip(log_weight.T, se.T, strict=True)
    ]
    prob, low, high = np.moveaxis(np.array(of_widths), 0, -1)
    return {
        "prob": prob,
        "prob_low": low,
        "prob_high": high,
        "log_evidence": log_evidence,
        "se": se,
        "n_effective": n_effective,
        "pareto_k": pareto_k,
        "beyond": beyond,
    }


def dataset_of_curves(
    fields: dict[str, Array],
    names: Iterable[str],
    widths: Array,
    *,
    ci_prob: float,
    left_out: str = "",
    unknown: str = "",
    **attrs: str,
) -> xr.Dataset:
    """Curves (m, w) of what has these names, as `plot_prior_sensitivity` takes them."""
    notes = {"ci_prob": ci_prob, "width_left_out": left_out, "width_unknown": unknown}
    return xr.Dataset(
        {f"width_{name}": (("model", "width"), values) for name, values in fields.items()},
        coords={"model": list(names), "width": widths},
        attrs=notes | attrs,
    )
