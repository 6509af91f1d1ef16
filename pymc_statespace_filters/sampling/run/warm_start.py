"""Starts and proposals from a pilot: the draws of a posterior close to that of the model.

The pilot may be of a smaller model. What it lacks then comes from the prior, and a population is
annealed from there to the posterior before the chains start.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.linalg
import xarray as xr
from pymc.model import Model

from ...errors import DataMismatchError, ModelError
from ...pymc_model.elements import places_in_vector
from ...pymc_model.posterior_draws import posterior_group, unconstrained_draws
from ..target.settings import RandomWalkSettings
from ..target.variables import continuous_value_vars
from .request import SamplingRequest

# Least eigenvalue of the draws' correlation matrix, below which they lie in a hyperplane.
SINGULAR = 1e-10
# Range of the variances proposed by a chain of the pilot, relative to those of all draws. Adapted
# ones lie between 0.002 and 4. Outside, the chain had not converged, or used the prior's.
LEAST_RATIO, LARGEST_RATIO = 1e-3, 4.0
MOST_KEPT = 500  # draws, for the first mixture of the proposals


def warm_started(request: SamplingRequest, model: Model, pilot: Any) -> SamplingRequest:
    """Start chains at draws of a pilot, with proposals from its chains or its draws.

    The warm-up, which may be short, changes the proposal covariance only if the user has chosen
    how. A pilot that lacks variables of the model determines neither starts nor covariance, only
    the population from which they are found. Raises `ModelError` if starts or proposals are given
    too, or cannot be made of the pilot's draws; `DataMismatchError` if the pilot has no variable of
    the model, or one of another shape or support.
    """
    for name in ("initvals", "proposal_cov"):
        if getattr(request, name) is not None:
            raise ModelError(f"{name} must be None with a pilot, which determines it")
    if not continuous_value_vars(None, model):
        return request  # the run itself raises that there is nothing to sample
    try:
        posterior = posterior_group(pilot)
        shared = _shared_names(posterior, model)
        draws = unconstrained_draws(pilot, model, shared)
    except (ModelError, DataMismatchError) as error:
        raise type(error)(f"pilot: {error}") from None
    cov = _covariance(draws.reshape(-1, draws.shape[-1]))
    names = [rv.name for rv in model.free_RVs]
    request = request._replace(pilot=_rows(_thinned(draws), shared, model))
    if len(shared) < len(names):
        return request
    adapted = [c for c in _adapted_covs(pilot, len(cov)) if _is_plausible(c, cov)]
    # A quarter of a block is longer than the warm-up, so that the proposals never change.
    without_adaptation = replace(request.settings, adapt_every=4 * request.tune + 4)
    return request._replace(
        initvals=_starts(posterior, names, request.chains),
        proposal_cov=_rounded(np.mean(adapted or [cov], axis=0)),
        settings=request.settings if _is_chosen(request.settings) else without_adaptation,
    )


def _is_chosen(settings: RandomWalkSettings) -> bool:
    """Whether the user has said how the covariance is to be adapted."""
    default = RandomWalkSettings()
    return (settings.adaptation, settings.adapt_every) != (default.adaptation, default.adapt_every)


def _shared_names(posterior: xr.Dataset, model: Model) -> list[str]:
    """Free variables of the model that have draws; a DataMismatchError if there are none."""
    names = [rv.name for rv in model.free_RVs]
    shared = [name for name in names if name in posterior]
    if not shared:
        raise DataMismatchError(
            f"idata must have draws of a free variable of the model, {', '.join(names)}, got "
            f"{sorted(map(str, posterior.data_vars))}"
        )
    return shared


def _thinned(draws: np.ndarray) -> np.ndarray:
    """Some of the draws (chain, draw, k) of each chain, in the order in which they were made."""
    step = -(-draws.shape[0] * draws.shape[1] // MOST_KEPT)
    kept = draws[:, ::-step][:, ::-1]
    return _rounded(kept.swapaxes(0, 1).reshape(-1, draws.shape[-1]))


def _rows(draws: np.ndarray, shared: list[str], model: Model) -> list[list[float | None]]:
    """Draws (n, k) of some variables as positions of the model, None for what they lack."""
    places = places_in_vector(model)
    known = np.concatenate([np.full(at.size, name in shared) for name, at in places.items()])
    rows = np.full((len(draws), known.size), None, dtype=object)
    rows[:, known] = draws
    return rows.tolist()


def warm_started_models(
    request: SamplingRequest, models: Mapping[str, Model], pilot: Any
) -> list[SamplingRequest]:
    """The requests of several models: a pilot for each name, or one for all that share variables.

    Raises as `warm_started`, with the name of the model; also if no model has the name of a pilot,
    or none shares a variable with the only one.
    """
    if pilot is None:
        return [request] * len(models)
    if isinstance(pilot, xr.DataTree):
        pilots = {name: pilot for name, model in models.items() if _shares(pilot, model)}
        if not pilots:
            names = sorted({rv.name for model in models.values() for rv in model.free_RVs})
            raise DataMismatchError(
                f"pilot must have draws of a free variable of a model, {', '.join(names)}"
            )
    elif isinstance(pilot, Mapping):
        pilots = dict(pilot)
    else:
        raise ModelError(
            "pilot must be a DataTree or a mapping of names of models to DataTrees, got "
            f"{type(pilot).__name__}"
        )
    if unknown := [name for name in pilots if name not in models]:
        raise ModelError(
            f"pilot must have names of models, {', '.join(models)}, got {unknown[0]!r}"
        )
    requests = []
    for name, model in models.items():
        try:
            started = request
            if name in pilots:
                started = warm_started(request, model, pilots[name])
        except (ModelError, DataMismatchError) as error:
            raise type(error)(f"models[{name!r}]: {error}") from None
        requests.append(started)
    return requests


def _shares(pilot: xr.DataTree, model: Model) -> bool:
    """Whether a pilot has draws of a free variable of a model."""
    posterior = posterior_group(pilot)
    return any(rv.name in posterior for rv in model.free_RVs)


def _covariance(positions: np.ndarray) -> np.ndarray:
    """Covariance of the draws times 2.38^2 / d; an error if it is singular."""
    dim = positions.shape[-1]
    cov = np.atleast_2d(np.cov(positions, rowvar=False))
    sd = np.sqrt(cov.diagonal())
    if not (np.isfinite(sd).all() and (sd > 0.0).all()) or (
        np.linalg.eigvalsh(cov / np.outer(sd, sd)).min() < SINGULAR
    ):
        raise ModelError(
            "pilot must have draws with a regular covariance on the unconstrained space, got draws "
            "that are constant or lie in a hyperplane"
        )
    return cov * 2.38**2 / dim


def _adapted_covs(pilot: xr.DataTree, dim: int) -> list[np.ndarray]:
    """Last proposal covariance of each chain of the pilot, if it recorded any.

    For a curved posterior the adapted covariance is smaller than the covariance of all draws gives,
    and several times more efficient.
    """
    stats = pilot["sample_stats"].to_dataset() if "sample_stats" in pilot.children else {}
    if "proposal_cov" not in stats:
        return []
    proposed = stats["proposal_cov"]
    if "chain" not in proposed.dims:
        return []
    if "draw" in proposed.dims:  # as of pm.sample
        proposed = proposed.isel(draw=-1)
    last = proposed.transpose("chain", ...).values
    return list(last) if last.shape[1:] == (dim, dim) else []


def _is_plausible(adapted: np.ndarray, cov: np.ndarray) -> bool:
    """Whether a proposal covariance fits the draws, in the same order and transforms."""
    if not np.isfinite(adapted).all():
        return False
    ratios = scipy.linalg.eigvalsh(adapted, cov)
    return bool(LEAST_RATIO < ratios.min() and ratios.max() < LARGEST_RATIO)


def _rounded(cov: np.ndarray) -> np.ndarray:
    """Round to twelve digits, so that a run may be resumed on another processor."""
    return np.array([float(f"{value:.12g}") for value in cov.flat]).reshape(cov.shape)


def _starts(posterior: xr.Dataset, names: list[str], chains: int) -> list[dict[str, np.ndarray]]:
    """The last draws of the pilot's chains; with more chains than the pilot's, earlier draws."""
    n_chains, n_draws = posterior.sizes["chain"], posterior.sizes["draw"]
    per_chain = -(-chains // n_chains)
    starts = []
    for i in range(chains):
        draw = n_draws - 1 - (i // n_chains) * n_draws // per_chain
        point = posterior.isel(chain=i % n_chains, draw=draw)
        starts.append({name: point[name].values for name in names})
    return starts
