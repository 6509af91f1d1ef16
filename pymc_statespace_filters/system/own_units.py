"""States as a user sees them: drifting parameters in their own units, not on their scales."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.hermite_e import hermegauss
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .model import StateSpaceModel

Array = NDArray[np.float64]

_N_NODES, _N_TERMS = 101, 40


def in_own_units(system: "StateSpaceModel", states: Array) -> Array:
    """States (..., n) as a filter has them, in a user's units."""
    if not system.drifting:
        return states
    found = states.copy()
    with np.errstate(over="ignore"):
        for i, one in _places(system):
            found[..., i] = one.link.values(states[..., i])
    return found


def moments_in_own_units(system: "StateSpaceModel", mean: Array, sd: Array) -> tuple[Array, Array]:
    """Means and standard deviations (..., n), of laws that are normal as a filter has the state."""
    if not system.drifting:
        return mean, sd
    mean, sd = mean.copy(), sd.copy()
    for i, one in _places(system):
        mean[..., i], sd[..., i] = one.link.moments(mean[..., i], sd[..., i])
    return mean, sd


def law_in_own_units(system: "StateSpaceModel", mean: Array, cov: Array) -> tuple[Array, Array]:
    r"""Means (..., n) and covariances (..., n, n) of normal laws of the states of a filter.

    Functions of two standard normals of correlation :math:`\rho` have the covariance
    :math:`\sum_{k \ge 1} a_k b_k \rho^k`, with their coefficients in normalised Hermite polynomials
    (Mehler).
    """
    sd = np.sqrt(np.maximum(np.diagonal(cov, axis1=-2, axis2=-1), 0.0))
    scale = np.where(sd > 0, sd, 1.0)
    correlation = np.clip(cov / (scale[..., :, None] * scale[..., None, :]), -1.0, 1.0)
    coefficients = np.zeros((*sd.shape, _N_TERMS))
    coefficients[..., 0] = sd  # of the state itself, a linear function
    nodes, weights = hermegauss(_N_NODES)
    polynomials = _polynomials(nodes) * (weights / weights.sum())
    for i, one in _places(system):
        at = one.link.values(mean[..., i, None] + sd[..., i, None] * nodes)
        coefficients[..., i, :] = at @ polynomials.T
    powers = np.cumprod(np.repeat(correlation[..., None], _N_TERMS, axis=-1), axis=-1)
    found = np.einsum("...ik,...jk,...ijk->...ij", coefficients, coefficients, powers)
    return moments_in_own_units(system, mean, sd)[0], found


def run_in_own_units(
    system: "StateSpaceModel",
    law: tuple[Array, Array],
    members: Array,
    weights: Array,
    *,
    are_points: bool,
) -> tuple[Array, Array, Array]:
    """Means (T, n), covariances and members (T, N, n) of a run, from those that a filter has.

    Members that are points give the moments. Where they have covariances of their own, as of
    `RBPF`, or there are none, the whole law counts as normal.
    """
    if not system.drifting:
        return *law, members
    members = in_own_units(system, members)
    if are_points and weights.shape[1]:
        return *moments_of_members(members, weights), members
    return *law_in_own_units(system, *law), members


def moments_of_members(members: Array, weights: Array) -> tuple[Array, Array]:
    """Means (T, n) and covariances (T, n, n), over 1 - sum w^2, of weighted members (T, N, n)."""
    spread = 1.0 - (weights**2).sum(axis=1)
    members = np.where(weights[..., None] > 0.0, members, 0.0)
    mean = np.einsum("ti,tia->ta", weights, members)
    rest = np.where(weights[..., None] > 0.0, members - mean[:, None], 0.0)
    total = np.einsum("ti,tia,tib->tab", weights, rest, rest)
    cov = np.divide(
        total, spread[:, None, None], out=np.zeros_like(total), where=spread[:, None, None] > 0.0
    )
    nowhere = ~weights.any(axis=1)
    mean[nowhere], cov[nowhere] = np.nan, np.nan
    return mean, cov


def _polynomials(nodes: Array) -> Array:
    """Hermite polynomials of degree 1 to `_N_TERMS` at nodes, of mean square one."""
    found = [np.ones_like(nodes), nodes]
    for k in range(1, _N_TERMS):
        found.append((nodes * found[k] - np.sqrt(k) * found[k - 1]) / np.sqrt(k + 1))
    return np.array(found[1:])


def _places(system: "StateSpaceModel") -> list:
    """The index and the parameter of every state that is one."""
    return list(enumerate(system.drifting, start=system.n - len(system.drifting)))
