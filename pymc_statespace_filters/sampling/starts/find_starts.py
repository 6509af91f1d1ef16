"""``find_starts``: initial values of chains that lie in the posterior."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymc.model import Model, modelcontext
from pymc.pytensorf import compile as compile_pymc

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.progress import row_progress
from pymc_statespace_filters.pymc_model.density import ModelDensity
from pymc_statespace_filters.pymc_model.prior import ModelPrior
from pymc_statespace_filters.sampling.starts.annealing import Population, anneal
from pymc_statespace_filters.system.checks import check_count, check_random_seed

_N_POINTS = 256
_N_DRAWS = 8 * _N_POINTS  # most draws of the prior, if few have a positive likelihood
_TYPICAL_STAGES = 15  # for the progress bar

Array = NDArray[np.float64]


def find_starts(
    model: Model | None = None,
    *,
    chains: int = 4,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
) -> list[dict[str, np.ndarray]]:
    """Find initial values of chains in the posterior, however narrow it is.

    256 draws of the prior are led to the posterior through some ten to twenty distributions, from
    the prior times a small power of the likelihood to the posterior. The starts are points of this
    population. They lie in the modes that it has met, as often as these have mass. A chain that
    starts at a draw of the prior may stay for good on a ridge far from the posterior: a wrong
    frequency of an oscillator, for example.

    Parameters
    ----------
    model : pymc.Model, optional
        Default: the model of the ``with`` block. Its free variables must be continuous, and their
        priors proper.
    chains : int
        Number of starts, at most 256.
    random_seed : int or numpy.random.Generator, optional
    progressbar : bool
        Whether to show the progress, if it takes longer than two seconds.

    Returns
    -------
    list of dict
        For every chain the values of the free variables, as ``initvals`` of `sample_dram` and of
        ``pm.sample``.

    Raises
    ------
    ModelError
        If an argument is not as described, a prior cannot be drawn from, or no draw of the prior
        has a positive likelihood.

    Notes
    -----
    The cost is 3000 to 16 000 evaluations of the log-density, in threads: more, the narrower the
    posterior is. With an expensive filter, find the starts with the same model and a cheaper one,
    such as `EKF`.

    References
    ----------
    Del Moral, Doucet and Jasra (2006), Journal of the Royal Statistical Society B 68, 411-436.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> with pm.Model():
    ...     mu = pm.Normal("mu", 0, 1000)
    ...     y = pm.Normal("y", mu, 0.1, observed=[1.2, 1.1, 1.3, 1.2])
    ...     starts = psf.find_starts(random_seed=1, progressbar=False)
    ...     idata = psf.sample_dram(initvals=starts, random_seed=1, progressbar=False)
    >>> [bool(1.0 < start["mu"] < 1.4) for start in starts]
    [True, True, True, True]
    """
    model = modelcontext(model)
    check_count("chains", chains, 1)
    if chains > _N_POINTS:
        raise ModelError(f"chains must be at most {_N_POINTS}, got {chains}")
    rng = check_random_seed(random_seed)
    density, prior = ModelDensity(model), ModelPrior(model)

    def log_densities(x: Array) -> tuple[Array, Array]:
        seeds = rng.integers(np.iinfo(np.int64).max, size=(len(x), len(density.seed_names)))
        log_prior = prior.log_density(x)
        with np.errstate(invalid="ignore"):
            log_likelihood = density.evaluate(x, seeds) - log_prior
        return log_prior, np.where(np.isfinite(log_likelihood), log_likelihood, -np.inf)

    with row_progress(density.calls, enabled=progressbar) as announce:
        announce("Finding starts", 3 * _N_POINTS * _TYPICAL_STAGES)
        drawn = _drawn_population(prior, log_densities, rng)
        population = anneal(drawn, log_densities, _N_POINTS, rng)
    return _initial_values(model, population.x[rng.choice(_N_POINTS, chains, replace=False)])


def _drawn_population(
    prior: ModelPrior, log_densities: Any, rng: np.random.Generator
) -> Population:
    """Draws of the prior, more of them if few have a positive likelihood."""
    x = prior.sample(_N_POINTS, rng)
    population = Population(x, *log_densities(x))
    while np.isfinite(population.log_likelihood).sum() < _N_POINTS // 4:
        if len(population.x) >= _N_DRAWS:
            break
        x = prior.sample(_N_POINTS, rng)
        parts = zip(population, Population(x, *log_densities(x)), strict=True)
        population = Population(*map(np.concatenate, parts))
    if not np.isfinite(population.log_likelihood).any():
        raise ModelError(
            f"the likelihood is zero at all of {len(population.x)} draws of the prior: narrow the "
            "priors to plausible values"
        )
    return population


def _initial_values(model: Model, x: Array) -> list[dict[str, np.ndarray]]:
    """The values of the free variables at unconstrained points (m, k)."""
    values = [model.rvs_to_values[rv] for rv in model.free_RVs]
    outputs = model.replace_rvs_by_values(model.free_RVs)
    # Machine code would take seconds to compile.
    function = compile_pymc(values, outputs, mode="FAST_COMPILE")
    shapes = [np.shape(model.initial_point()[value.name]) for value in values]
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1]
    names = [rv.name for rv in model.free_RVs]
    starts = []
    for point in x:
        parts = zip(np.split(point, ends), shapes, strict=True)
        found = function(*(part.reshape(shape) for part, shape in parts))
        starts.append(dict(zip(names, map(np.asarray, found), strict=True)))
    return starts
