"""A population of points of a posterior, from which chains start and learn their proposals.

Draws of the prior are annealed to the posterior. If the filters are expensive and the systems allow
Gaussian ones (`pilot_filters`), these lead the way: the population is first annealed to the prior
times the square root of their likelihood, and from there to the posterior, which takes fewer
evaluations. The square root, because the two likelihoods may differ by many nats. Draws of some
variables from a pilot, if there are any, lead the way instead (`nested_reference`).

A filter with a tolerance may be tens of times slower at draws of the prior than in the posterior.
The points are therefore found with its coarse form, whose posterior is nearly the same, and the
filter itself evaluates only those that have been found.

In many dimensions the moves of the annealing are too few. The population then settles by moves
along the gradient, if there is one (`langevin`).

The cost is proportional to the number of points. If they are few, the Gaussian filter still leads
many, which cost little, and an expensive filter evaluates some of them.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray
from pymc.model import Model

from ...compiler.native.rows import Rows
from ...errors import ModelError
from ...filters.outcomes import why_zero
from ...progress import row_progress
from ...pymc_model.prior import can_sample
from ...statistics.student_mixture import StudentMixture, mixture_of
from ..kernel.state import draw_seeds
from ..target.initial_points import N_DRAWS
from ..target.log_density import LogDensity
from ..target.settings import RandomWalkSettings
from ..target.target import MANY_DIMENSIONS, Target
from ..target.variables import RaveledVariables
from .annealing import N_SWEEPS, Population, anneal
from .exact_fit import check_fit
from .langevin import PER_DIMENSION, settle
from .modes import Points, find_modes

N_POINTS = 256
_TYPICAL_EVALUATIONS = 36  # for each point, for the progress bar
_DRAWN = 4  # draws of a reference for each point, at most N_POINTS or what a Gaussian filter finds
_DEPTH, _DEPTH_PER_DIMENSION = 10.0, 3.0  # nats below the highest point, where points are left out
_TYPICAL_MOVES = 40  # of each point, for the progress bar
_MOST_BATCHES = 10  # of draws of the prior
_FEWEST = 16  # points of positive likelihood, for a pilot to lead the way

Array = NDArray[np.float64]
# From points (m, d) to log-densities (m,) of the prior and of the posterior.
Densities = Callable[[Array], tuple[Array, Array]]

_N_COMPONENTS = 4  # of the known draws, which may have several modes
_PRIOR_WEIGHT = 0.2


def population_of(
    model: Model,
    rng: np.random.Generator,
    *,
    progressbar: bool,
    n_points: int = N_POINTS,
    settles: bool = True,
) -> tuple[Points, RaveledVariables]:
    """Points distributed nearly as a model's posterior, and their coordinates.

    In many dimensions they are some nats below it if they do not settle along the gradient. Raises
    `ModelError` if a free variable is discrete, a prior is improper, or no draw of the prior has a
    positive likelihood.
    """
    if model.discrete_value_vars:
        names = [model.values_to_rvs[value].name for value in model.discrete_value_vars]
        raise ModelError(f"model must have continuous free variables only, got discrete {names}")
    if improper := [rv.name for rv in model.free_RVs if not can_sample(rv, model)]:
        raise ModelError(
            f"the prior of {', '.join(improper)} is improper and cannot be sampled: "
            "give it a proper prior"
        )
    target = Target(model, None, RandomWalkSettings())
    target.prepare()
    found = find_population(
        target, rng, progressbar=progressbar, n_points=n_points, settles=settles
    )
    return found, target.raveled


def find_population(
    target: Target,
    rng: np.random.Generator,
    *,
    progressbar: bool,
    n_points: int = N_POINTS,
    pilot: Array | None = None,
    settles: bool = True,
) -> Points:
    """Points distributed nearly as the posterior, ``n_points`` in each of the last sweeps.

    ``pilot`` are draws (n, d) of a posterior close by, with columns of NaN for what it lacks.
    Raises `ModelError` if no draw of the prior has a positive likelihood, or if the model fits the
    record exactly.
    """
    search = partial(
        _search,
        target,
        rng,
        progressbar=progressbar,
        n_points=n_points,
        pilot=pilot,
        settles=settles,
    )
    found = None
    if (coarse := target.coarse_density()) is not None:
        found = _evaluated(target, search(coarse), rng, progressbar=progressbar)
    if found is None or not len(found.x):
        found = search(target.density)
    check_fit(target, found.x, found.log_density)
    return found


def _evaluated(
    target: Target, found: Points, rng: np.random.Generator, *, progressbar: bool
) -> Points:
    """The points of positive likelihood among those found with coarse filters."""
    rows = target.density.at_rows()
    with row_progress(rows, enabled=progressbar) as announce:
        announce("Evaluating the starts", len(found.x))
        log_density = _densities(rows, target, rng)(found.x)[1]
    index = np.flatnonzero(log_density > -np.inf)
    return Points(found.x[index], log_density[index], found.mode[index])


def _search(
    target: Target,
    rng: np.random.Generator,
    density: LogDensity,
    *,
    progressbar: bool,
    n_points: int,
    pilot: Array | None,
    settles: bool,
) -> Points:
    """Points distributed nearly as a log-density, that of the target or a coarse one."""
    led = _led_by_gaussian(target, rng, progressbar=progressbar) if pilot is None else None
    rows = density.at_rows()
    with row_progress(rows, enabled=progressbar) as announce:
        announce("Finding starts", _TYPICAL_EVALUATIONS * n_points)
        full = _densities(rows, target, rng)
        found = None
        if pilot is not None:
            reference = nested_reference(pilot, target.prior_draws.draws, rng)
            x = reference.sample(min(_DRAWN * n_points, N_POINTS), rng)
            found = _annealed(_population(x, _from_reference(reference, full)), n_points, rng)
        elif led is not None:
            x, cheap = led
            x = x[:: -(-len(x) // (_DRAWN * n_points))]
            found = _annealed(_population(x, _from_gaussian(cheap, full)), n_points, rng)
        if found is None:
            drawn = _prior_population(target, _from_prior(full), n_points)
            found = _annealed(drawn, n_points, rng, fewest=1)
        if found is None:
            raise ModelError(_nowhere(target, density, drawn[0].x, rng))
        x, log_density = found.x, found.log_first + found.log_ratio
    if settles and (settled := _settled(target, x, rng, of_pilot=False, progressbar=progressbar)):
        x, log_density = settled
    return Points(x, log_density, find_modes(x, lambda x: full(x)[1], rng))


def _led_by_gaussian(
    target: Target, rng: np.random.Generator, *, progressbar: bool
) -> tuple[Array, Densities] | None:
    """Points of the prior times the square root of a Gaussian likelihood, and its densities.

    None if there is none, if the filters are cheap, or if it is positive at too few points.
    """
    density = target.pilot_density()
    if density is None:
        return None
    rows = density.at_rows()
    with row_progress(rows, enabled=progressbar) as announce:
        announce("Finding starts by a Gaussian filter", _TYPICAL_EVALUATIONS * N_POINTS)
        cheap = _densities(rows, target, rng)
        drawn = _prior_population(target, _from_prior(cheap), N_POINTS)
        found = _annealed(drawn, N_POINTS, rng)
    if found is None:
        return None
    settled = _settled(target, found.x, rng, of_pilot=True, progressbar=progressbar)
    return (found.x if settled is None else settled[0]), cheap


def _settled(
    target: Target, x: Array, rng: np.random.Generator, *, of_pilot: bool, progressbar: bool
) -> tuple[Array, Array] | None:
    """Points of the last sweep moved along the gradient, and their log-densities.

    None in few dimensions, where the annealing is enough, in too many for these points, or if there
    is no gradient.
    """
    dim = target.raveled.dim
    last = x[-(len(x) // N_SWEEPS) :]
    is_few = len(last) < PER_DIMENSION * dim
    if dim < MANY_DIMENSIONS or (is_few and not target.takes_curvature):
        return None
    rows = target.gradient_rows(of_pilot=of_pilot)
    if rows is None:
        return None

    def evaluate(x: Array) -> tuple[Array, Array]:
        results = rows(x, *_seeds(target, len(x), rng).T)
        return _number(results[0]), results[-1]

    with row_progress(rows, enabled=progressbar) as announce:
        announce("Settling the starts", _TYPICAL_MOVES * len(last))
        return settle(last, evaluate, rng)


def _nowhere(target: Target, density: LogDensity, x: Array, rng: np.random.Generator) -> str:
    """Say that no draw of the prior has a positive likelihood, why, and what to do."""
    explained = x[:N_DRAWS]
    results = density.at_rows()(explained, *_seeds(target, len(explained), rng).T)
    return (
        f"the likelihood is zero at all of {len(x)} draws of the prior: "
        f"{why_zero(density.failures(results), len(explained))}"
    )


def _population(x: Array, log_densities: Densities) -> tuple[Population, Densities]:
    return Population(x, *log_densities(x)), log_densities


def _prior_population(
    target: Target, log_densities: Densities, n_points: int
) -> tuple[Population, Densities]:
    """Draws of the prior, more of them if few have a positive likelihood."""
    population, _ = _population(target.prior_draws.draws, log_densities)
    for batch in range(1, _MOST_BATCHES):
        if np.isfinite(population.log_ratio).sum() >= n_points // 4:
            break
        more, _ = _population(target.prior_draws.batch(batch), log_densities)
        pairs = zip(population, more, strict=True)
        population = Population(*(np.concatenate(pair) for pair in pairs))
    return population, log_densities


def _annealed(
    drawn: tuple[Population, Densities],
    n_points: int,
    rng: np.random.Generator,
    fewest: int = _FEWEST,
) -> Population | None:
    """The points led to the second distribution; None if it is positive at too few of them."""
    population, log_densities = drawn
    if np.isfinite(population.log_ratio).sum() < fewest:
        return None
    return _without_stragglers(anneal(population, log_densities, n_points, rng))


def _without_stragglers(population: Population) -> Population:
    """The points that have reached the second distribution, at least a quarter of them.

    A point that no move has led out of a ridge lies many nats below all others, where there is next
    to nothing of the distribution.
    """
    log_density = population.log_first + population.log_ratio
    most = log_density.max() - _DEPTH - _DEPTH_PER_DIMENSION * population.x.shape[1]
    least = min(most, float(np.quantile(log_density, 0.75)))
    return population.at(np.flatnonzero(log_density >= least))


def _densities(rows: Rows, target: Target, rng: np.random.Generator) -> Densities:
    """Log-densities of prior and posterior; an estimate gets new noise, unless it is fixed."""

    def evaluate(x: Array) -> tuple[Array, Array]:
        posterior, prior = rows(x, *_seeds(target, len(x), rng).T)[:2]
        return _number(prior), _number(posterior)

    return evaluate


def _seeds(target: Target, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Seeds of the noise of n evaluations, (n, noisy)."""
    seeds = draw_seeds(rng, (n, len(target.seed_names)))
    if not target.settings.refresh_noise:
        seeds = np.broadcast_to(target.fixed_seeds, seeds.shape)
    return seeds


def _from_prior(densities: Densities) -> Densities:
    def evaluate(x: Array) -> tuple[Array, Array]:
        prior, posterior = densities(x)
        with np.errstate(invalid="ignore"):
            return prior, _number(posterior - prior)

    return evaluate


def _from_reference(reference: StudentMixture, full: Densities) -> Densities:
    def evaluate(x: Array) -> tuple[Array, Array]:
        first, second = reference.log_density(x), full(x)[1]
        return first, second - first

    return evaluate


def _from_gaussian(cheap: Densities, full: Densities) -> Densities:
    def evaluate(x: Array) -> tuple[Array, Array]:
        first, second = cheap(x)[1], full(x)[1]
        with np.errstate(invalid="ignore"):
            return first, _number(second - first)

    return evaluate


def _number(values: Array) -> Array:
    """The values, with minus infinity for NaN and plus infinity."""
    return np.where(values < np.inf, values, -np.inf)


def nested_reference(known: Array, prior: Array, rng: np.random.Generator) -> StudentMixture:
    """The mixture for draws (n, d) with columns of NaN, and draws of the prior (m, d).

    The draws are of a posterior that lacks the variables of these columns, such as that of a nested
    model. Their product with the prior of the others is described by a mixture of Student-t
    distributions. A further component covers the prior of all variables, as the posterior may lie
    far from the known draws.
    """
    lacking = np.isnan(known[0])
    paired = prior[rng.integers(len(prior), size=len(known))]
    near = _fitted(np.where(lacking, paired, known), _N_COMPONENTS, rng)
    far = _fitted(prior, 1, rng)
    return near.mixed_with(far, _PRIOR_WEIGHT)


def _fitted(x: Array, n_components: int, rng: np.random.Generator) -> StudentMixture:
    if (fitted := mixture_of(x, n_components, rng)) is None:
        raise ModelError("pilot must have draws that vary in every direction")
    return fitted
