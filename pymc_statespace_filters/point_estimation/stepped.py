"""The maximum of a likelihood that is a staircase of some parameters, such as the time of a switch.

No derivative says anything of these parameters. They are searched over the range of the population,
in turn with the maximum over the others, which is found while they are held.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..evidence.estimators.newton import BatchFunction
from ..sampling.starts.annealing import Population
from .estimate import STEPPED, Lost, Peak

N_TRIED, N_SEARCHES = 400, 5  # values of a parameter on a line; searches at most
MIN_GAIN = 1e-6  # nats, of a search that is worth another one
INTERVAL_NATS = 1.92  # below the maximum: an interval of 95 % (Wilks 1938)

Array = NDArray[np.float64]
Maximize = Callable[[BatchFunction, Population], Peak]


def maximize_stepped(
    log_likelihood: BatchFunction,
    population: Population,
    stepped: NDArray[np.bool_],
    maximize: Maximize,
    *,
    is_noisy: bool,
) -> Peak:
    """Find the maximum over all parameters; ``stepped`` (k,) marks those of the staircase.

    Those of a noisy likelihood stay where the best point of the population has them.
    """
    point = population.x[np.argmax(population.log_ratio)]
    ends = np.full((stepped.sum(), 2, len(point)), np.nan)
    for _ in range(N_SEARCHES):
        peak = _over_others(log_likelihood, point, population, stepped, maximize)
        point = _with(point, ~stepped, peak.point[None])[0]
        if is_noisy:
            break
        before = peak.value
        for i, j in enumerate(map(int, np.flatnonzero(stepped))):
            point, ends[i] = _searched(log_likelihood, point, j, population.x[:, j])
        if float(log_likelihood(point[None])[0]) < before + MIN_GAIN:
            break
    return _of_all(peak, point, stepped, ends)


def _with(point: Array, varied: NDArray[np.bool_], x: Array) -> Array:
    """A point (k,) with other values x (m, r) of the varied parameters, (m, k)."""
    found = np.tile(point, (len(x), 1))
    found[:, varied] = x
    return found


def _over_others(
    log_likelihood: BatchFunction,
    point: Array,
    population: Population,
    stepped: NDArray[np.bool_],
    maximize: Maximize,
) -> Peak:
    """The maximum over the parameters that are not stepped, the others held."""
    others = ~stepped
    if others.any():
        of_others = population._replace(x=population.x[:, others])
        return maximize(lambda x: log_likelihood(_with(point, others, x)), of_others)
    value, nothing = float(log_likelihood(point[None])[0]), np.empty((0, 0))
    return Peak(np.empty(0), value, 0.0, nothing, (), nothing, nothing, ())


def _searched(
    log_likelihood: BatchFunction, point: Array, j: int, values: Array
) -> tuple[Array, Array]:
    """The middle of the highest step along one parameter, and the ends (2, k) of its interval."""
    is_j = np.arange(len(point)) == j
    low, high = values.min(), values.max()
    for _ in range(2):  # the second time within the interval alone
        tried = np.linspace(low, high, N_TRIED)
        found = log_likelihood(_with(point, is_j, tried[:, None]))
        inside = tried[found >= found.max() - INTERVAL_NATS]
        low, high = inside.min(), inside.max()
    best = int(found.argmax())
    level = np.flatnonzero(found >= found[best] - MIN_GAIN)
    step = level[np.cumsum(np.diff(level, prepend=level[0]) > 1) == 0]
    middle = 0.5 * (tried[step[0]] + tried[step[-1]])
    return _with(point, is_j, np.array([[middle]]))[0], _with(
        point, is_j, np.array([[low], [high]])
    )


def _of_all(peak: Peak, point: Array, stepped: NDArray[np.bool_], ends: Array) -> Peak:
    """The maximum over the others as one over all parameters, with the stepped ones lost."""
    k, others = len(point), ~stepped

    def rows(of_others: Array) -> Array:
        return _with(np.zeros(k), others, of_others[None])[0]

    basis = np.zeros((k, peak.basis.shape[1]))
    basis[others] = peak.basis
    hessian, cov = np.full((k, k), np.nan), np.zeros((k, k))
    hessian[np.ix_(others, others)] = peak.hessian
    cov[np.ix_(others, others)] = peak.simulation_cov
    lost = [one._replace(direction=rows(one.direction)) for one in peak.lost]
    lost += [
        Lost(axis, STEPPED, tuple(interval))
        for axis, interval in zip(np.eye(k)[stepped], ends, strict=True)
    ]
    return peak._replace(
        point=point,
        basis=basis,
        lost=tuple(lost),
        hessian=hessian,
        simulation_cov=cov,
        rivals=tuple((_with(point, others, at[None])[0], value) for at, value in peak.rivals),
    )
