"""``maximum_likelihood``: the parameters under which the data are most probable.

Standard errors in the model's units follow by the delta method.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pymc.model import Model

from ..errors import ModelError
from ..evidence.estimators.newton import BatchFunction, WithGradient
from ..progress import row_progress
from ..pymc_model.at_points import ConstrainedValues
from ..pymc_model.elements import labels_of
from ..pymc_model.inspection import given_model
from ..pymc_model.prior import ModelFactors
from ..pymc_model.stepped import stepped_variables
from ..sampling.starts.annealing import N_SWEEPS, Population
from ..sampling.starts.modes import is_reordered
from ..sampling.starts.population import population_of
from ..sampling.target.target import MANY_DIMENSIONS
from ..system.checks import check_random_seed
from .estimate import (
    EDGE,
    HIDDEN,
    INCREASING,
    LEVEL,
    STEPPED,
    MaximumLikelihoodEstimate,
    Peak,
    flattened,
)
from .noisy import maximize_estimated
from .smooth import maximize_smooth
from .stepped import maximize_stepped

Array = NDArray[np.float64]

TYPICAL_EVALUATIONS = 50  # times (k + 1)^2, for the progress bar
STEP = 1e-3  # of the differences, in standard deviations of the population
# Standard errors, of a move along a direction that changes a parameter; with noisy directions.
INVOLVED, INVOLVED_NOISY = 0.05, 0.5
FAR, ROUNDING = (30.0, 40.0), 1e-6  # unconstrained, where a parameter is at its bound
AT_BOUND = 0.02  # standard deviations of the population: smaller moves end at a bound
# Maxima agree within these nats and standard errors; relative, of a parameter that has none.
SAME_NATS, SAME_ERRORS, SAME_DIGITS = 0.005, 0.05, 1e-3


def maximum_likelihood(
    model: Model | None = None,
    *,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
) -> MaximumLikelihoodEstimate:
    r"""Find the parameters of largest likelihood, with standard errors.

    No draws are needed, and no start: 256 draws of the prior are led to the posterior, as in
    `find_starts`, and the searches start from there. The priors say only where to look. They have
    no part in the maximum.

    Parameters
    ----------
    model : pymc.Model, optional
        Default: the model of the ``with`` block. Its free variables must be continuous, and their
        priors proper.
    random_seed : int or numpy.random.Generator, optional
    progressbar : bool
        Whether to show a progress bar of the population if it takes longer than two seconds.

    Returns
    -------
    MaximumLikelihoodEstimate
        Its ``estimate`` and ``standard_errors`` hold the free variables by name, in the model's
        units and shapes, and ``summary()`` is a table of them. ``log_likelihood`` is the logarithm
        of everything in the model except the priors of free variables. ``covariance`` is that of
        the estimate in the model's units, and ``hessian`` (k, k) the curvature on the unconstrained
        space.

    Raises
    ------
    ModelError
        If an argument is not as described, the model has no observed variable and no Potential, a
        free variable is discrete, a prior cannot be drawn from (as ``pm.Flat``), or no draw of the
        prior has a positive likelihood.

    Notes
    -----
    A deterministic likelihood (EKF, UKF, IPLF, GridFilter, PyMC's own) is maximised by Newton's
    method with finite differences, from up to five points of the population that lie far apart. The
    largest maximum found counts. It is refined until a Newton step is shorter than 1e-6 standard
    errors.

    If the likelihood is estimated (EnKF, BootstrapPF, GuidedPF, PFEnKF), quadratics are fitted to
    estimates around the maximum [1]_. This finds the maximum of the expected likelihood with the
    errors ``simulation_errors`` and ``log_likelihood_se``, which decrease with more particles; the
    notes give their size in standard errors. They contain no misfit of the quadratic, which is
    fitted over 0.6 standard errors; by it the standard errors differ from those of the exact
    likelihood by 10 to 20 %.

    Standard errors are from the observed information, the Hessian H of the log-likelihood on the
    unconstrained space: :math:`\sqrt{\operatorname{diag}(-J H^{-1} J^\top)}`, with the Jacobian J
    of the parameters in the model's units. At a maximum that is the inverse information in these
    units. They hold for long records [2]_. A parameter has none at a bound, such as a scale of
    zero, if the likelihood does not determine it, if noise hides the curvature, or if the
    likelihood is a staircase of it, as of the time of a switch: ``reasons`` says which, with an
    interval for a staircase. A parameter at a bound counts as known for the errors of the others.

    The population costs 3000 to 16 000 evaluations of the likelihood, in threads; Newton's method
    about 50 (k + 1)² for k parameters, the quadratics 4000 to 10 000. From nine parameters on, a
    likelihood with a gradient costs some 200 (k + 1) evaluations and 40 (k + 1) gradients.

    If the likelihood has several maxima, the largest need not be where the posterior has any mass;
    it is then not found. Maxima less than two nats lower are named in the notes, but not those
    that have the same numbers in another order: labels exchanged, as of regimes.

    References
    ----------
    .. [1] E. L. Ionides, C. Breto, J. Park, R. A. Smith and A. A. King (2017). Monte Carlo profile
       confidence intervals for dynamic systems. Journal of the Royal Society Interface 14,
       20170126.
    .. [2] O. E. Barndorff-Nielsen and D. R. Cox (1994). Inference and Asymptotics. Chapman & Hall,
       section 3.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> walk = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> record = psf.simulate(walk, {"a": 0.8}, steps=range(100), random_seed=1)
    >>> with pm.Model():
    ...     a = pm.Uniform("a", 0, 1)
    ...     d = psf.StateSpace(
    ...         "d", walk, psf.EKF(), steps=range(100), observed=record["observations"]
    ...     )
    ...     found = psf.maximum_likelihood(random_seed=1)
    >>> found
    Maximum likelihood: log-likelihood -155.5885
               estimate  standard_error
    parameter
    a          0.578093        0.108064
    """
    model = given_model(model)
    if not (model.observed_RVs or model.potentials):
        raise ModelError("model must have an observed variable or a Potential, got neither")
    rng = check_random_seed(random_seed)
    factors, n_evaluations = ModelFactors(model), 0

    def evaluate(x: Array) -> tuple[Array, Array]:
        nonlocal n_evaluations
        n_evaluations += len(x)
        return factors.evaluate(x, rng)

    # The searches follow the gradient themselves: the population need not.
    found, _ = population_of(model, rng, progressbar=progressbar, settles=False)
    x = found.x[::N_SWEEPS]
    population = Population(x, *evaluate(x))

    def maximize(log_likelihood: BatchFunction, population: Population) -> Peak:
        if factors.is_noisy:
            return maximize_estimated(log_likelihood, population, rng)
        return maximize_smooth(log_likelihood, population)

    def values(x: Array) -> Array:
        return evaluate(x)[1]

    def with_slopes(x: Array) -> tuple[Array, Array]:
        nonlocal n_evaluations
        n_evaluations += len(x)
        assert slopes is not None
        return slopes(x)

    slopes = factors.with_slopes() if x.shape[1] >= MANY_DIMENSIONS else None
    log_likelihood = values if slopes is None else WithGradient(values, with_slopes)
    stepped = _is_stepped(model)
    with row_progress(factors.likelihood.calls, enabled=progressbar) as announce:
        announce("Maximising the likelihood", TYPICAL_EVALUATIONS * (x.shape[1] + 1) ** 2)
        if stepped.any():
            peak = maximize_stepped(
                log_likelihood, population, stepped, maximize, is_noisy=factors.is_noisy
            )
        else:
            peak = maximize(log_likelihood, population)
    return _described(model, peak, population.x, n_evaluations)


def _is_stepped(model: Model) -> NDArray[np.bool_]:
    """Of which parameters (k,) the likelihood is a staircase."""
    names, point = stepped_variables(model), model.initial_point()
    return np.concatenate(
        [
            np.full(point[model.rvs_to_values[rv].name].size, rv.name in names)
            for rv in model.free_RVs
        ]
    )


def _described(
    model: Model, peak: Peak, population: Array, n_evaluations: int
) -> MaximumLikelihoodEstimate:
    """The maximum in the model's units."""
    values = ConstrainedValues(model)
    estimate = values(peak.point)
    labels = [
        label for name, value in estimate.items() for label in labels_of(name, value.shape, model)
    ]
    covariance, simulation, reasons = errors_of(values, peak, population, labels)
    ends = np.cumsum([value.size for value in estimate.values()])[:-1]

    def named(flat: Array) -> dict[str, np.ndarray]:
        parts = zip(estimate.items(), np.split(flat, ends), strict=True)
        return {name: part.reshape(value.shape) for (name, value), part in parts}

    return MaximumLikelihoodEstimate(
        estimate=estimate,
        log_likelihood=peak.value,
        log_likelihood_se=peak.value_se,
        standard_errors=named(np.sqrt(np.diag(covariance))),
        reasons=reasons,
        simulation_errors=named(simulation),
        covariance=pd.DataFrame(covariance, index=labels, columns=labels),
        unconstrained=peak.point,
        hessian=peak.hessian,
        notes=(*peak.notes, *_notes_on_rivals(peak, values, np.sqrt(np.diag(covariance)))),
        n_evaluations=n_evaluations,
    )


def _notes_on_rivals(peak: Peak, values: ConstrainedValues, errors: Array) -> Iterator[str]:
    known = [(flattened(values(peak.point)), peak.value)]
    for point, value in peak.rivals:
        flat = flattened(values(point))
        if any(
            abs(value - other) < SAME_NATS
            and is_reordered(flat, numbers, _tolerance(numbers, errors))
            for numbers, other in known
        ):
            continue
        known.append((flat, value))
        named = ", ".join(
            f"{name} = {np.array2string(found, precision=4)}"
            for name, found in values(point).items()
        )
        yield f"another maximum, {peak.value - value:.2f} nats lower, is at {named}"


def _tolerance(numbers: Array, errors: Array) -> Array:
    return np.where(np.isnan(errors), SAME_DIGITS * np.abs(numbers), SAME_ERRORS * errors)


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
    visited = np.array([flattened(values(x)) for x in population])
    here, spread = flattened(values(peak.point)), visited.std(axis=0)
    along = jacobian @ peak.basis
    covariance = along @ along.T
    directions = np.array([lost.direction for lost in peak.lost]).reshape(-1, len(peak.point))
    moves = np.abs(jacobian @ directions.T)
    least = [INVOLVED_NOISY if lost.kind == HIDDEN else INVOLVED for lost in peak.lost]
    involved = (moves > 0) & (moves >= np.multiply.outer(np.linalg.norm(along, axis=1), least))
    reasons = {}
    for i in np.flatnonzero(involved.any(axis=1)):
        which = int(np.where(involved[i], moves[i], -1.0).argmax())
        names = [labels[j] for j in np.flatnonzero(involved[:, which])]
        small = moves[i, which] < AT_BOUND * spread[i]
        reasons[labels[i]] = _reason(peak.lost[which].kind, names, at_bound=bool(small))
        if peak.lost[which].kind == LEVEL and len(names) == 1 and not small:
            reasons[labels[i]] = _reason_of_level(labels[i], float(here[i]), visited[:, i])
        if peak.lost[which].kind == STEPPED:
            ends = [float(flattened(values(x))[i]) for x in peak.lost[which].interval]
            reasons[labels[i]] = _reason_of_steps(ends)
        covariance[i], covariance[:, i] = np.nan, np.nan
    for i in np.flatnonzero(_at_bounds(values, peak.point, spread)):
        reasons.setdefault(labels[i], _reason(INCREASING, [], at_bound=True))
        covariance[i], covariance[:, i] = np.nan, np.nan
    simulation = np.sqrt(np.einsum("ik,kl,il->i", jacobian, peak.simulation_cov, jacobian))
    if peak.value_se > 0:
        simulation[np.isnan(np.diag(covariance))] = np.nan
    return Errors(covariance, simulation, reasons)


def _at_bounds(
    values: Callable[[Array], Mapping[str, np.ndarray]], point: Array, spread: Array
) -> NDArray[np.bool_]:
    """Which scalars are at a finite bound of their support, measured by the population's spread.

    A curvature there is that of a transform: the likelihood has none.
    """
    here, found = flattened(values(point)), np.zeros(len(spread), dtype=bool)
    with np.errstate(over="ignore"):
        for move in np.concatenate([np.eye(len(point)), -np.eye(len(point))]):
            near, far = (flattened(values(point + far * move)) for far in FAR)
            is_bound = np.isfinite(far) & (near != here) & (np.abs(far - near) < ROUNDING * spread)
            found |= is_bound & (np.abs(far - here) < AT_BOUND * spread)
    return found


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


def _reason_of_level(label: str, value: float, visited: Array) -> str:
    """Why one scalar has none along which the likelihood is level, given those of the population.

    The search leaves the population only where the likelihood rises.
    """
    if visited.min() <= value <= visited.max():
        return _reason(LEVEL, [label], at_bound=False)
    moves = "grows" if value > visited.max() else "falls"
    return (
        f"the likelihood levels off as {label} {moves}, without a maximum: its limit fits the data "
        "best"
    )


def _reason_of_steps(ends: list[float]) -> str:
    """Why a parameter of which the likelihood is a staircase has none, and its interval."""
    reason = "the likelihood is a staircase of it, which a condition compares with times or data"
    if not np.isfinite(ends).all():
        return f"{reason}, and too noisy to search; sample_dram samples it"
    low, high = sorted(ends)
    return (
        f"{reason}; within 1.92 nats of the maximum from {low:.4g} to {high:.4g}, the others held"
    )
