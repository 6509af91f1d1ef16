"""Chains that begin with what the draws of another posterior tell, close to their own."""

from dataclasses import replace
from typing import Any

import numpy as np
import scipy.linalg
import xarray as xr
from pymc.model import Model

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.pymc_model.posterior_draws import posterior_group, unconstrained_draws
from pymc_statespace_filters.sampling.run.model_task import Asked
from pymc_statespace_filters.sampling.target.variables import continuous_value_vars

# The least eigenvalue of the draws' correlation matrix. Below, they lie in a plane.
FLAT = 1e-10
# Variances that a chain of the pilot proposed, relative to those by the draws of all. Learnt ones
# lie between 0.002 and 4. Beyond, a chain had not settled, or knew only the prior.
LEAST_RATIO, LARGEST_RATIO = 1e-3, 4.0


def with_head_start(asked: Asked, model: Model, pilot: Any, *, adapts: bool) -> Asked:
    """Start chains at draws of a pilot, and propose by what it knows of its posterior.

    Parameters
    ----------
    asked : Asked
    model : pymc.Model
    pilot : xarray.DataTree
        Draws of all free variables of the model.
    adapts : bool
        Whether the warm-up learns other proposals. A short one had better not.

    Raises
    ------
    ModelError
        If starts or proposals are given besides, or the pilot's draws do not make them.
    DataMismatchError
        If the pilot is of another model.
    """
    for name in ("initvals", "proposal_cov"):
        if getattr(asked, name) is not None:
            raise ModelError(f"{name} is what the pilot gives: leave one of them out")
    if not continuous_value_vars(None, model):
        return asked  # the run itself will say that there is nothing to sample
    try:
        draws = unconstrained_draws(pilot, model)
    except (ModelError, DataMismatchError) as error:
        raise type(error)(f"pilot: {error}") from None
    posterior = posterior_group(pilot)
    cov = _covariance(draws.reshape(-1, draws.shape[-1]))
    names = [rv.name for rv in model.free_RVs]
    learnt = [own for own in _learnt(pilot, len(cov)) if _is_like(own, cov)]
    # Not even a quarter of a block is ever full, so that nothing is learnt of it.
    unlearning = replace(asked.settings, adapt_every=4 * asked.tune + 4)
    return asked._replace(
        initvals=_starts(posterior, names, asked.chains),
        proposal_cov=_rounded(np.mean(learnt or [cov], axis=0)),
        settings=asked.settings if adapts else unlearning,
    )


def _covariance(positions: np.ndarray) -> np.ndarray:
    """That of the draws, times 2.38^2 / d; an error if a random walk by it stays in a plane."""
    dim = positions.shape[-1]
    cov = np.atleast_2d(np.cov(positions, rowvar=False))
    sd = np.sqrt(cov.diagonal())
    if not (np.isfinite(sd).all() and (sd > 0.0).all()) or (
        np.linalg.eigvalsh(cov / np.outer(sd, sd)).min() < FLAT
    ):
        raise ModelError(
            "pilot: its draws lie in a plane, or stand still, and a random walk by their "
            "covariance would too"
        )
    return cov * 2.38**2 / dim


def _learnt(pilot: xr.DataTree, dim: int) -> list[np.ndarray]:
    """How each chain of the pilot proposed in the end, if it was a random walk.

    Where the posterior is bent, what adaptation has settled for is smaller than what the covariance
    of all draws asks for, and several times better.
    """
    stats = pilot["sample_stats"].to_dataset() if "sample_stats" in pilot.children else {}
    if "proposal_cov" not in stats:
        return []
    proposed = stats["proposal_cov"]
    if not {"chain", "draw"} <= set(proposed.dims):
        return []
    last = proposed.isel(draw=-1).transpose("chain", ...).values
    return list(last) if last.shape[1:] == (dim, dim) else []


def _is_like(learnt: np.ndarray, cov: np.ndarray) -> bool:
    """Whether it was learnt from such draws: by another chain, order or transform it was not."""
    if not np.isfinite(learnt).all():
        return False
    ratios = scipy.linalg.eigvalsh(learnt, cov)
    return bool(LEAST_RATIO < ratios.min() and ratios.max() < LARGEST_RATIO)


def _rounded(cov: np.ndarray) -> np.ndarray:
    """To twelve digits: the last ones are another processor's to say, and a run goes on there."""
    return np.array([float(f"{value:.12g}") for value in cov.flat]).reshape(cov.shape)


def _starts(posterior: xr.Dataset, names: list[str], chains: int) -> list[dict[str, np.ndarray]]:
    """The ends of the pilot's chains; earlier draws where there are more chains than there."""
    n_chains, n_draws = posterior.sizes["chain"], posterior.sizes["draw"]
    per_chain = -(-chains // n_chains)
    starts = []
    for i in range(chains):
        draw = n_draws - 1 - (i // n_chains) * n_draws // per_chain
        at = posterior.isel(chain=i % n_chains, draw=draw)
        starts.append({name: at[name].values for name in names})
    return starts
