"""What a shorter integration step would change: the log-likelihood and the log-evidence."""

import warnings
from collections.abc import Callable
from functools import partial

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from numpy.typing import NDArray
from scipy.special import logsumexp

from ..errors import EvidenceWarning
from ..importance import MAX_PARETO_K, MIN_EFFECTIVE, mcse, pareto_k
from ..progress import row_progress
from ..pymc_model.checked_model import checked_model
from ..pymc_model.density import RowFunction, check_free_variables
from ..pymc_model.posterior_draws import MIN_DRAWS, populations_of, unconstrained_draws
from ..pymc_model.step_refinement import densities_by_halvings, step_lengths
from ..system.checks import check_count, check_random_seed

N_SEEDS = 8  # of a noisy likelihood, at every draw
MAX_CORRECTION = 0.1  # nats, of the bias of a ratio of means over these seeds

COLUMNS = ("log_lik_change", "log_lik_se", "log_evidence_change", "log_evidence_se")

Array = NDArray[np.float64]


def step_error(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    halvings: int = 1,
    n_draws: int = 200,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
) -> pd.DataFrame:
    r"""How much log-likelihood and log-evidence change if the integration step is halved.

    The likelihoods with the model's step and with shorter ones are compared at the same draws of
    the posterior, each with the filter of its variable. The estimates of noisy filters share the
    path of the process noise, so that they differ by little more than the step makes.

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws of the model with its own step, from any sampler.
    model : pymc.Model, optional
        Default: the model of the context. At least one of its StateSpace variables has an
        integrator; the steps of all of them are halved.
    halvings : int
        How many times the step is halved, one row for each.
    n_draws : int
        Number of draws used, evenly from every chain; all if there are fewer.
    random_seed : None, int or numpy.random.Generator
        Of the noise of particle and ensemble filters.
    progressbar : bool
        Whether to show a progress bar if it takes longer than two seconds.

    Returns
    -------
    pandas.DataFrame
        One row per halving. Changes are from the model's own step, in nats, positive if the
        shorter step has more.

        ``dt`` (index)
            Length of the shorter substep; the longest, if integrators differ.
        ``log_lik_change``, ``log_lik_se``
            Change of the log-likelihood, averaged over the posterior, and its standard error.
        ``log_evidence_change``, ``log_evidence_se``
            Change of the log-evidence, and its standard error.

        The standard errors count that there are finitely many draws, which are correlated, and
        finitely many noise seeds.

    Raises
    ------
    ModelError
        If the model has no integrator, or a filter cannot treat the system with shorter steps.
    DataMismatchError
        If idata does not belong to the model.

    Warns
    -----
    EvidenceWarning
        If the likelihood is zero at some draws with either step; if few draws decide the change of
        the log-evidence, or the estimates are too noisy for it, so that its error is larger than it
        says (NaN where nothing can be said).

    Notes
    -----
    The change of the log-evidence is :math:`\log E[L'(\theta) / L(\theta)]` over the posterior with
    the model's own step, where :math:`L'` is the likelihood with the shorter one. Where both are
    estimated, the ratio at a draw is that of the means over eight seeds, without the bias of first
    order in their number (jackknife). The seeds are fresh: those of the chain belong to estimates
    that were accepted, which are too high on average. The posterior of the parameters that a chain
    with a noisy, unbiased likelihood draws from is exact, so that nothing else is needed. Draws of
    chains that held one noise seed are those of that seed's posterior.

    A change far below its standard error, or far below one nat, says that the step is short enough.
    With an integrator of weak order one, the error of a step is about twice the change by halving
    it; see ``halvings=2``, which should show 1.5 times the change of the first halving.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=psf.EulerMaruyama(lambda x, a: [-a * x[0]], [[0.6]], dt=0.1),
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[0.08]],
    ...     initial_mean=[1.0],
    ...     initial_cov=[[0.5]],
    ... )
    >>> with pm.Model() as model:
    ...     a = pm.HalfNormal("a", 1)
    ...     d = psf.StateSpace("d", system, psf.EKF(), steps=[0, 5, 10], observed=[1.1, 0.7, 0.9])
    ...     idata = psf.sample_dram(500, tune=500, chains=2, random_seed=1, progressbar=False)
    >>> table = psf.step_error(idata, model)
    >>> table.index.name, list(table.index)
    ('dt', [0.05])
    >>> bool(abs(table["log_evidence_change"].item()) < 0.05)
    True
    """
    model = checked_model(model, idata, any_filter=True)
    check_free_variables(model)
    check_count("halvings", halvings, 1)
    check_count("n_draws", n_draws, MIN_DRAWS)
    rng = check_random_seed(random_seed)
    draws = unconstrained_draws(idata, model)
    n_chains, length = draws.shape[:2]
    each = min(length, max(1, n_draws // n_chains))
    rows = np.linspace(0, length - 1, each).round().astype(int)
    draws, population = draws[:, rows], populations_of(idata)
    if population is not None:
        population = population[:, rows]
    functions = [RowFunction(model, graph) for graph in densities_by_halvings(model, halvings)]
    coarse, *finer = _at_draws(functions, draws, rng, progressbar)
    row_of = partial(_changes, coarse=coarse, shape=draws.shape[:2], population=population)
    found = [row_of(fine, jackknife=True) for fine in finer]
    lengths = max(step_lengths(model)) * 0.5 ** np.arange(1, halvings + 1)
    table = pd.DataFrame(found, index=pd.Index(lengths, name="dt"))
    plain = [row_of(fine, jackknife=False) for fine in finer]
    corrections = np.abs(table - pd.DataFrame(plain, index=table.index))["log_evidence_change"]
    _warn_of_failures(finer, coarse)
    for (dt, row), fine, correction in zip(table.iterrows(), finer, corrections, strict=True):
        log_ratio = _log_ratio(fine, coarse)
        if not np.isfinite(log_ratio).any():
            continue  # which `_warn_of_failures` has said
        if correction <= MAX_CORRECTION:
            _warn_of_weights(dt, row["log_evidence_se"], log_ratio)
        else:
            _warn_of_noise(dt)
    return table


def _at_draws(
    functions: list[RowFunction], draws: Array, rng: np.random.Generator, progressbar: bool
) -> list[Array]:
    """Log-densities (draws, seeds) by each of the functions, with the same seeds for all."""
    x = draws.reshape(-1, draws.shape[-1])
    n_seeds = N_SEEDS if functions[0].seed_names else 1
    x = np.repeat(x, n_seeds, axis=0)
    size = (len(x), len(functions[0].seed_names))
    seeds = rng.integers(np.iinfo(np.int64).max, size=size)
    found = []
    for halvings, one in enumerate(functions):
        with row_progress(one.calls, enabled=progressbar) as announce:
            announce(f"step halved {halvings} times" if halvings else "step as it is", len(x))
            found.append(one.evaluate(x, seeds).reshape(-1, n_seeds))
    return found


def _changes(
    fine: Array,
    coarse: Array,
    shape: tuple[int, int],
    population: NDArray[np.int64] | None,
    *,
    jackknife: bool,
) -> dict[str, float]:
    """A row of the table from log-densities (draws, seeds); ``shape`` is (chains, draws)."""
    usable = np.isfinite(coarse).any(axis=1)  # the others are no draws of the posterior
    log_ratio = np.where(usable, _log_ratio(fine, coarse), np.nan)
    peak = np.nanmax(log_ratio, initial=-np.inf)
    if peak == -np.inf:
        return dict.fromkeys(COLUMNS, np.nan)

    def ratio(some_fine: Array, some_coarse: Array) -> Array:
        return np.exp(_log_ratio(some_fine, some_coarse) - peak)

    change, weight = log_ratio, np.exp(log_ratio - peak)
    if jackknife:
        change = _jackknifed(_log_ratio, fine, coarse, log_ratio)
        weight = _jackknifed(ratio, fine, coarse, weight)
    change = np.where(np.isfinite(change), change, np.nan).reshape(shape)
    weight, mean = weight.reshape(shape), float(np.nanmean(weight))
    numbers = [np.nanmean(change), _standard_error(change, population), np.nan, np.nan]
    if mean > 0:  # not where the corrections of large noise outweigh the ratios
        numbers[2:] = np.log(mean) + peak, _standard_error(weight, population) / mean
    return dict(zip(COLUMNS, map(float, numbers), strict=True))


def _log_ratio(fine: Array, coarse: Array) -> Array:
    """Log of the ratio of the means over the seeds, (draws,); NaN for zero by zero."""
    with np.errstate(invalid="ignore"):
        return logsumexp(fine, axis=1) - logsumexp(coarse, axis=1)


def _jackknifed(
    statistic: Callable[[Array, Array], Array], fine: Array, coarse: Array, whole: Array
) -> Array:
    """A statistic of the seeds without its bias of first order in their number."""
    n_seeds = fine.shape[1]
    if n_seeds == 1:
        return whole
    others = [np.delete(np.arange(n_seeds), i) for i in range(n_seeds)]
    with np.errstate(invalid="ignore", over="ignore"):
        parts = np.mean([statistic(fine[:, o], coarse[:, o]) for o in others], axis=0)
        corrected = n_seeds * whole - (n_seeds - 1) * parts
    return np.where(np.isfinite(parts), corrected, whole)


def _standard_error(values: Array, population: NDArray[np.int64] | None) -> float:
    """Of the mean of correlated values (chain, draw), those that are NaN left out."""
    known = np.isfinite(values)
    filled = np.where(known, values, np.nanmean(values))
    if np.ptp(filled) == 0.0:  # such as by an integrator that is exact
        return 0.0
    return mcse(filled, population) / known.mean() ** 0.5


def _warn_of_failures(finer: list[Array], coarse: Array) -> None:
    without = [~np.isfinite(logs).any(axis=1) for logs in (coarse, *finer)]
    if (n_failed := int(np.any(without, axis=0).sum())) > 0:
        _warn(
            f"the likelihood is zero at {n_failed} of {len(coarse)} draws with the model's step or "
            "with a shorter one: log_lik_change leaves them out, and log_evidence_change counts "
            "those without a likelihood by the shorter step as zero"
        )


def _warn_of_weights(dt: float, error: float, log_ratio: Array) -> None:
    tail = pareto_k(np.where(np.isfinite(log_ratio), log_ratio, -np.inf))
    if tail > MAX_PARETO_K or not error <= MIN_EFFECTIVE**-0.5:
        _warn(
            f"few draws decide log_evidence_change at dt = {dt:g} (Pareto k = {tail:.2g}, "
            f"standard error {error:.2g}): the posterior with the shorter step lies elsewhere, or "
            "the draws are too few. Take the shorter step in the model and sample again; if "
            "log_lik_change is small, raise n_draws"
        )


def _warn_of_noise(dt: float) -> None:
    """Warn that the bias which the jackknife removes is large, because then some of it is left."""
    _warn(
        f"the estimates of the likelihood are too noisy for log_evidence_change at dt = {dt:g}: "
        f"the ratio of their means over {N_SEEDS} seeds has a bias above {MAX_CORRECTION:g} nats, "
        "which is not removed exactly. Give the model a filter with more particles, or GuidedPF; "
        "the draws can stay"
    )


def _warn(text: str) -> None:
    warnings.warn(text, EvidenceWarning, stacklevel=4)
