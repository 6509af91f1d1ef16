"""Covariance and standard errors in the model's units, by the delta method."""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from .estimate import flattened
from .peak import EDGE, HIDDEN, INCREASING, Peak

STEP = 1e-3  # of the differences, in standard deviations of the population
# Standard errors, of a move along a direction that changes a parameter; with noisy directions.
INVOLVED, INVOLVED_NOISY = 0.05, 0.5
AT_BOUND = 0.02  # standard deviations of the population: smaller moves end at a bound

Array = NDArray[np.float64]


class Errors(NamedTuple):
    """Covariance (n, n) and simulation errors (n,) of all scalars, and why some have none."""

    covariance: Array  # NaN for scalars with a reason
    simulation: Array
    reasons: dict[str, str]


def errors_of(
    values: Callable[[Array], Mapping[str, np.ndarray]],
    peak: Peak,
    population: Array,
    labels: list[str],
) -> Errors:
    """Errors of the free variables, whose ``values`` are a function of the unconstrained vector."""
    jacobian = _jacobian(lambda x: flattened(values(x)), peak.point, STEP * population.std(axis=0))
    spread = np.std([flattened(values(x)) for x in population], axis=0)
    along = jacobian @ peak.basis
    covariance = along @ along.T
    directions = np.array([lost.direction for lost in peak.lost]).reshape(-1, len(peak.point))
    moves = np.abs(jacobian @ directions.T)
    least = [INVOLVED_NOISY if lost.kind == HIDDEN else INVOLVED for lost in peak.lost]
    involved = moves >= np.multiply.outer(np.linalg.norm(along, axis=1), least)
    reasons = {}
    for i in np.flatnonzero(involved.any(axis=1)):
        which = int(np.where(involved[i], moves[i], -1.0).argmax())
        names = [labels[j] for j in np.flatnonzero(involved[:, which])]
        small = moves[i, which] < AT_BOUND * spread[i]
        reasons[labels[i]] = _reason(peak.lost[which].kind, names, at_bound=bool(small))
        covariance[i], covariance[:, i] = np.nan, np.nan
    simulation = np.sqrt(np.einsum("ik,kl,il->i", jacobian, peak.simulation_cov, jacobian))
    if peak.value_se > 0:
        simulation[np.isnan(np.diag(covariance))] = np.nan
    return Errors(covariance, simulation, reasons)


def _jacobian(function: Callable[[Array], Array], point: Array, steps: Array) -> Array:
    """Derivatives (n, k) of a smooth function at a point (k,), by differences of fourth order."""
    columns = []
    for h, axis in zip(steps, np.diag(steps), strict=True):
        near, far = (function(point + t * axis) - function(point - t * axis) for t in (1, 2))
        columns.append((8 * near - far) / (12 * h))
    return np.stack(columns, axis=1)


def _reason(kind: str, names: list[str], *, at_bound: bool) -> str:
    """Why a parameter has no standard error."""
    if kind == EDGE:
        return "at the edge of its support, where the likelihood ends"
    if at_bound:
        return "at a bound of its support, towards which the likelihood levels off"
    direction = f"as {', '.join(names)} {'changes' if len(names) == 1 else 'change together'}"
    if kind == HIDDEN:
        return f"the noise of the likelihood hides its curvature {direction}"
    if kind == INCREASING:
        return f"not a maximum: the Hessian is not negative definite {direction}"
    return f"not identified: the likelihood is level {direction}"


def scalar_labels(model: pm.Model, values: Mapping[str, np.ndarray]) -> list[str]:
    """Labels of all scalars in values: a name, and its coordinates or indices in brackets."""
    return [label for name, value in values.items() for label in _labels(model, name, value.shape)]


def _labels(model: pm.Model, name: str, shape: tuple[int, ...]) -> Iterator[str]:
    dims = model.named_vars_to_dims.get(name, (None,) * len(shape))
    coords = [model.coords.get(dim) for dim in dims]
    for index in np.ndindex(*shape):
        parts = [i if coord is None else coord[i] for i, coord in zip(index, coords, strict=True)]
        yield f"{name}[{', '.join(map(str, parts))}]" if parts else name
