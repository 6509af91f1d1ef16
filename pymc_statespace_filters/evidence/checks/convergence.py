"""Convergence of the chains, on which every estimate from their draws relies."""

import math
from collections.abc import Iterator

import numpy as np
import xarray as xr
from arviz_stats import ess, rhat

from ...lower_chains import lower_chains
from ..posterior.draws import Posterior

MAX_RHAT = 1.05
# Effective draws of all chains with which R-hat and ESS are reliable (Vehtari et al. 2021).
ENOUGH_EFFECTIVE = 400


def check_convergence(posterior: Posterior, idata: xr.DataTree | None = None) -> Iterator[str]:
    """Yield a reason to distrust every estimate from the draws if the chains disagree.

    As a rule of thumb, the effective sample size grows with the number of draws: the factor by
    which draws are missing is `ENOUGH_EFFECTIVE` over the smallest one, at least 2. More draws do
    not help where a chain stays far below another one. ``idata`` tells which sampler drew them.
    """
    parameters = np.moveaxis(posterior.draws, -1, 0)
    with np.errstate(invalid="ignore"):  # R-hat of a constant parameter is 0 / 0
        rhats = [float(rhat(values)) for values in parameters]
    largest = max((one for one in rhats if not np.isnan(one)), default=1.0)
    if largest <= MAX_RHAT:
        return
    found = f"the chains disagree (R-hat {largest:.2f})"
    if low := lower_chains(dict(enumerate(posterior.log_density)), len(parameters)):
        lowest = max(low, key=lambda chain: chain.nats)
        yield f"{found}: {lowest}: start it where the others are (initvals), or tune longer"
        return
    poor = [v for v, one in zip(parameters, rhats, strict=True) if one > MAX_RHAT]
    effective = min(float(ess(v)) for v in poor)
    factor = max(2, math.ceil(ENOUGH_EFFECTIVE / max(effective, 1.0)))
    how = f" (until_ess={ENOUGH_EFFECTIVE} of sample_dram)" if _drawn_by_us(idata) else ""
    yield (
        f"{found}: their effective sample size is {effective:.0f}; about {factor} times as many "
        f"draws would give {ENOUGH_EFFECTIVE}{how}. If R-hat stays above {MAX_RHAT}, start the "
        "chains elsewhere (initvals) or tune longer"
    )


def _drawn_by_us(idata: xr.DataTree | None) -> bool:
    """Whether the draws are those of `sample_dram`, which notes whether they are exact."""
    return idata is not None and "refresh_noise" in idata.attrs
