"""The Bayes factor for drift against the width of the priors of the strengths, by reweighting.

With wider priors nearly all of the prior is at strengths that the data exclude, so that the factor
falls without bound (Lindley's paradox); with narrower ones it tends to one.
"""

from collections.abc import Mapping

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ...importance import log_mean, mcse
from ...pymc_model.posterior_draws import populations_of
from ..comparison.scaled_prior import ScaledPrior, average_ratios
from ..comparison.selection import probabilities

Array = NDArray[np.float64]


def bayes_factor_by_width(
    model: pm.Model,
    idata: xr.DataTree,
    log_terms: Mapping[tuple[str, ...], Array | None],
    widths: Array,
    log_prior: Array,
    ci_prob: float,
) -> xr.Dataset:
    """The probability of drift for strengths whose priors are scaled together.

    ``log_terms`` has the terms (chain, draw) of the mean Z_0 / Z_1 for each set of strengths, or
    None where that mean is unknown; ``log_prior`` (2,) is that of constant and drifting. The result
    is as that of `prior_sensitivity`.
    """
    names = [", ".join(strengths) for strengths in log_terms]
    posterior, population = idata["posterior"].to_dataset(), populations_of(idata)
    factor, error = np.full((2, len(names), len(widths)), np.nan)
    for i, (strengths, terms) in enumerate(log_terms.items()):
        if terms is None:
            continue
        scaled = ScaledPrior(model, strengths)
        for j, width in enumerate(widths):
            ratios, beyond = scaled.log_ratios(posterior, float(width))
            if average_ratios(ratios, beyond, population).is_reliable:
                factor[i, j] = log_mean(ratios) - log_mean(terms)
                # Both means are of the same draws.
                error[i, j] = mcse(_relative(ratios) - _relative(terms), population)
    fields = {"log_bayes_factor": factor, "se": error}
    fields |= _probabilities(factor, error, log_prior, ci_prob)
    return xr.Dataset(
        {f"width_{name}": (("model", "width"), field) for name, field in fields.items()},
        coords={"model": [f"drift, {name}" for name in names], "width": widths},
        attrs={"ci_prob": ci_prob, "width_left_out": "", "width_unknown": ""},
    )


def _relative(log_terms: Array) -> Array:
    return np.asarray(np.exp(log_terms - log_mean(log_terms)))


def _probabilities(
    factor: Array, error: Array, log_prior: Array, ci_prob: float
) -> dict[str, Array]:
    found = np.full((3, *factor.shape), np.nan)
    for at in np.ndindex(factor.shape):
        log_weight, se = np.array([0.0, factor[at]]) + log_prior, np.array([0.0, error[at]])
        found[(slice(None), *at)] = [one[1] for one in probabilities(log_weight, se, ci_prob)]
    return dict(zip(("prob", "prob_low", "prob_high"), found, strict=True))
