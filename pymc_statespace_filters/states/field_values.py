"""Values of fields at draws of their coefficients and from their prior, and the states there."""

import math

import numpy as np
import pymc as pm
import pytensor
import xarray as xr
from numpy.typing import NDArray
from pytensor.graph.traversal import ancestors
from scipy.spatial import cKDTree

from ..pymc_model.at_points import GraphsAtPoints
from ..pymc_model.posterior_draws import unconstrained_draws
from ..pymc_model.state_space_variable import observed_variables
from ..system.gaussian_process_terms import KERNEL_LENGTHS, GaussianProcessTerms
from ..system.term_library import TermLibrary
from .draws import SAMPLE_DIMS
from .groups import state_dims

_AT_ONCE = 4_000_000  # values of the field in memory
_N_PRIOR = 500  # draws of the coefficients from their prior
_NEAR = 0.1  # of the range of the states, for terms that have no length of their own

type Terms = GaussianProcessTerms | TermLibrary
Array = NDArray[np.float64]


def paths_of(smoothed: xr.Dataset, model: pm.Model, basis: Terms) -> Array:
    """Smoothed states of the terms (draws, rows, states), of all variables that have them."""
    variables = observed_variables(model)
    dims, parts = state_dims(variables), []
    for variable in variables:
        if set(basis.states) <= set(variable.system.states):
            drawn = smoothed[f"{variable.name}_states"].sel({dims[variable.name]: [*basis.states]})
            drawn = drawn.transpose(*SAMPLE_DIMS, ..., dims[variable.name])
            parts.append(drawn.values.reshape(-1, *drawn.shape[2:]))
    return np.concatenate(parts, axis=1) if parts else np.empty((0, 0, len(basis.states)))


def values_of(basis: Terms, points: Array) -> Array:
    """The terms (terms, n) at points (states, n)."""
    return np.asarray(pytensor.function([], basis(points), mode="FAST_COMPILE")())


def moments_of(draws: Array, basis: Terms, grid: Array, ci_prob: float) -> dict[str, Array]:
    """What is known of the field at points (states, n), each (n,)."""
    tail = (1 - ci_prob) / 2
    parts: dict[str, list[Array]] = {}
    values = values_of(basis, grid)
    for some in np.array_split(values, math.ceil(values.shape[1] * len(draws) / _AT_ONCE), axis=1):
        at_draws = draws @ some
        low, high = np.quantile(at_draws, [tail, 1 - tail], axis=0)
        found = {
            "mean": at_draws.mean(axis=0), "sd": at_draws.std(axis=0), "low": low, "high": high,
            "prob_positive": (at_draws > 0).mean(axis=0),
        }  # fmt: skip
        for key, of_some in found.items():
            parts.setdefault(key, []).append(of_some)
    return {key: np.concatenate(of_all) for key, of_all in parts.items()}


def prior_draws(model: pm.Model, name: str, rng: np.random.Generator) -> Array | None:
    """Draws (draws, terms) of the coefficients from their prior; None if it is improper."""
    if name not in model.named_vars:
        return None
    try:
        drawn = pm.draw(model[name], _N_PRIOR, random_seed=rng, mode="FAST_COMPILE")
    except NotImplementedError:  # of pm.Flat
        return None
    return np.asarray(drawn, dtype=np.float64)


def kernel_lengths(model: pm.Model, name: str, idata: xr.DataTree) -> Array | None:
    """The length (draws, states) of the kernel by which `prior_sd` made the coefficients' prior."""
    if name not in model.named_vars:
        return None
    lengths = [one for one in ancestors([model[name]]) if one.name == KERNEL_LENGTHS]
    if len(lengths) != 1:
        return None
    [at_draws] = GraphsAtPoints(model, lengths)(unconstrained_draws(idata, model, least=1))
    return at_draws.reshape(-1, at_draws.shape[-1])


def standard_deviation(draws: Array | None, basis: Terms, points: Array) -> Array:
    """The standard deviation (n,) of the field at points (states, n)."""
    if draws is None:
        return np.full(points.shape[1], np.nan)
    return np.asarray((draws @ values_of(basis, points)).std(axis=0))


def share_near(basis: Terms, grid: Array, visited: Array) -> Array:
    """The share (n,) of the visited states (m, states) near points (states, n)."""
    if not len(visited):
        return np.full(grid.shape[1], np.nan)
    if isinstance(basis, GaussianProcessTerms):
        lengths = basis.shortest_length
    else:
        lengths = np.maximum(_NEAR * np.ptp(visited, axis=0), np.finfo(float).tiny)
    tree = cKDTree(visited / lengths)
    counts = tree.query_ball_point(grid.T / lengths, 1.0, p=np.inf, return_length=True)
    return np.asarray(counts / len(visited))
