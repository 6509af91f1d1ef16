"""Log-likelihoods without PyMC: numbers in, numbers out."""

import warnings
from collections import Counter
from typing import Any

import numpy as np

from pymc_statespace_filters.errors import FilterWarning, ModelError
from pymc_statespace_filters.filters import COLLAPSED, FAILURES, Filter
from pymc_statespace_filters.model import StateSpaceModel
from pymc_statespace_filters.ops import (
    HEALTH_SIZE,
    BatchLogLikelihood,
    LogLikelihood,
    evaluator,
    has_batch,
)
from pymc_statespace_filters.parameters import flat_parameters
from pymc_statespace_filters.records import (
    check_inputs,
    check_observed,
    check_seed,
    check_system,
    check_t0,
    steps_of,
)


def log_likelihood(
    system: StateSpaceModel,
    filter: Filter,
    params: Any,
    observed: Any,
    *,
    steps: Any = None,
    times: Any = None,
    inputs: Any = None,
    t0: float = 0.0,
    seed: Any = 0,
) -> np.ndarray:
    """Evaluate the log-likelihood of a record, term by term.

    Parameters
    ----------
    system : StateSpaceModel
    filter : EKF, EnKF, BootstrapPF, PFEnKF or GridFilter
    params : mapping
        Parameter values by name; arrays broadcast to a shape S (a declared parameter's own shape
        comes last).
    observed : array_like, shape (J, p), or (J,) if p = 1
        The record; NaN marks a missing component.
    steps : array_like of int, shape (J,)
        The step of each observation; 0 is where the initial state holds. Or give `times`.
    times : array_like, shape (J,)
        Times of the observations, on the grid ``t0 + k * dt`` to a millionth of a step.
    inputs : array_like, shape (rows, n_inputs)
        Row k holds during step k.
    t0 : float
        Time of step 0.
    seed : int or array_like of int
        The noise inside the filter, if it has any; broadcasts with the parameters.

    Returns
    -------
    ndarray, shape S + (J,)
        log p(d_j | d_1 .. d_{j-1}); their sum over j is the log-likelihood. A wholly missing row
        has the term 0; from an observation at which the filter fails on, terms are -inf.

    Warns
    -----
    FilterWarning
        Once, if a filter failed or its particles collapsed.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> terms = psf.log_likelihood(system, psf.EKF(), {"a": 0.9}, [0.3, 1.2], steps=[0, 3])
    >>> terms.shape
    (2,)
    """
    check_kinds(system, filter)
    t0 = check_t0(t0)
    at = steps_of(steps, times, system.dt, t0)
    data = check_observed(observed, system, at.size)
    forces = check_inputs(inputs, system, at)
    theta = flat_parameters(system, params)
    seeds = check_seed("seed", seed)
    try:
        shape = np.broadcast_shapes(theta.shape[:-1], seeds.shape)
    except ValueError:
        raise ModelError(
            f"seed of shape {seeds.shape} does not broadcast with parameters "
            f"of shape {theta.shape[:-1]}"
        ) from None
    theta = np.broadcast_to(theta, (*shape, theta.shape[-1]))
    seeds = np.broadcast_to(seeds, shape)
    points = np.ascontiguousarray(theta).reshape(seeds.size, theta.shape[-1])
    record = (at, data, forces, np.asarray(t0))
    terms, health = _evaluate(LogLikelihood(system, filter), points, record, seeds.ravel())
    warn_of(filter, health)
    return terms.reshape(*shape, at.size)


def _evaluate(
    op: LogLikelihood, points: np.ndarray, record: tuple, seeds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Terms and health of every point: side by side where the filter can, else in turn."""
    if len(points) > 1 and has_batch(op):
        # Such a filter draws nothing: any seed will do.
        return evaluator(BatchLogLikelihood(op.system, op.filter))(points, *record, seeds[0])
    evaluate = evaluator(op)
    terms = np.empty((len(points), record[0].size))
    health = np.empty((len(points), HEALTH_SIZE))
    for i, point in enumerate(points):
        terms[i], health[i] = evaluate(point, *record, np.asarray(seeds[i]))
    return terms, health


def warn_of(filter: Filter, health: np.ndarray, *, stacklevel: int = 3) -> None:
    """One warning for what went wrong in some evaluations, given their health (n, 3)."""
    failed = health[:, 1] != 0
    if failed.any():
        reasons = Counter(FAILURES[int(code)] for code in health[failed, 1])
        listed = "; ".join(f"{count} times {reason}" for reason, count in reasons.most_common())
        warnings.warn(
            f"{filter} gave -inf in {failed.sum()} of {len(health)} evaluations: {listed}",
            FilterWarning,
            stacklevel=stacklevel,
        )
    collapsed = ~failed & (health[:, 0] < COLLAPSED)
    if collapsed.any():
        warnings.warn(
            f"{filter}: at some observation fewer than {COLLAPSED:g} particles carried all the "
            f"weight, in {collapsed.sum()} of {len(health)} evaluations (smallest effective "
            f"number {health[~failed, 0].min():.3g}). The log-likelihood may be tens of nats too "
            f"low, by a different amount for every seed; more particles lessen this only slowly. "
            f"EKF() and EnKF(n, likelihood='gaussian') do not collapse, but have a bias of their "
            f"own where the state is not Gaussian.",
            FilterWarning,
            stacklevel=stacklevel,
        )


def check_kinds(system: Any, filter: Any) -> None:
    """Raise unless these are a system and a filter that can treat it."""
    check_system(system)
    if not isinstance(filter, Filter.__value__):
        raise ModelError(
            f"filter must be a filter such as psf.EKF() or psf.EnKF(1250), got {filter!r}"
        )
    filter.check(system)
