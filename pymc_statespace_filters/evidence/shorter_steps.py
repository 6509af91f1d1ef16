"""What a shorter integration step would change: the log-likelihood and the log-evidence."""

from collections.abc import Iterator, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable
from scipy.special import logsumexp, softmax

from ..errors import EvidenceWarning, warn
from ..progress import row_progress
from ..pymc_model.checked_model import checked_model
from ..pymc_model.density import RowFunction, check_free_variables
from ..pymc_model.posterior_draws import MIN_DRAWS, populations_of, unconstrained_draws
from ..pymc_model.step_refinement import densities_by_halvings, step_lengths
from ..statistics.importance import (
    MAX_PARETO_K,
    MIN_EFFECTIVE,
    log_mean_of_draws,
    mcse,
    normalised,
    pareto_k,
)
from ..system.checks import check_count, check_random_seed

N_SEEDS = 8  # of a noisy likelihood, at every draw
MAX_NOISE = 0.1  # relative variance of the ratio of means over these seeds

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
        says.

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
    draws, population = unconstrained_draws(idata, model), populations_of(idata)
    n_chains, length = draws.shape[:2]
    each = min(length, max(1, n_draws // n_chains))
    rows = np.linspace(0, length - 1, each).round().astype(int)
    if population is not None:
        population = population[:, rows]
    graphs = densities_by_halvings(model, halvings)
    coarse, *finer = _log_densities(model, graphs, draws[:, rows], rng, progressbar=progressbar)
    dt = pd.Index(max(step_lengths(model)) * 0.5 ** np.arange(1, halvings + 1), name="dt")
    changes = [_change(coarse, fine, population) for fine in finer]
    for text in (*_zeros(coarse, finer), *chain.from_iterable(map(_doubts, dt, changes))):
        warn(text, EvidenceWarning)
    return pd.DataFrame([one[: len(COLUMNS)] for one in changes], dt, COLUMNS)


def _log_densities(
    model: pm.Model,
    graphs: Sequence[TensorVariable],
    draws: Array,
    rng: np.random.Generator,
    *,
    progressbar: bool,
) -> list[Array]:
    """Log-densities (chain, draw, seed) at the draws by each of the graphs, with the same seeds."""
    functions = [RowFunction(model, graph) for graph in graphs]
    n_seeds = N_SEEDS if functions[0].seed_names else 1
    x = np.repeat(draws.reshape(-1, draws.shape[-1]), n_seeds, axis=0)
    seeds = functions[0].fresh_seeds(len(x), rng)
    found = []
    for halvings, function in enumerate(functions):
        with row_progress(function.calls, enabled=progressbar) as announce:
            announce(f"step halved {halvings} times" if halvings else "step as it is", len(x))
            found.append(function.evaluate(x, seeds).reshape(*draws.shape[:2], n_seeds))
    return found


class _Change(NamedTuple):
    """A row of the table, and what tells whether it can be believed."""

    log_lik_change: float
    log_lik_se: float
    log_evidence_change: float
    log_evidence_se: float
    log_ratio: Array  # (chain, draw)
    noise: float  # variance of the log-ratio of a draw, due to the noise


def _change(coarse: Array, fine: Array, population: NDArray[np.int64] | None) -> _Change:
    """From log-densities (chain, draw, seed)."""
    log_ratio = _log_ratio(coarse, fine)
    known = np.isfinite(log_ratio)
    if not known.any():
        return _Change(np.nan, np.nan, np.nan, np.nan, log_ratio, np.nan)
    of_log, of_ratio, noise = _biases(coarse[known], fine[known])
    change, ratio = log_ratio[known], log_mean_of_draws(log_ratio, population)
    # A draw without a likelihood by its own step is none of the posterior.
    share = np.isfinite(coarse).any(axis=-1).mean()
    return _Change(
        float((change - of_log).mean()),
        mcse(np.where(known, log_ratio, change.mean()), population) / known.mean() ** 0.5,
        ratio.value - float(np.log(share) + normalised(change) @ of_ratio),
        ratio.error,
        log_ratio,
        float(noise.mean()),
    )


def _log_ratio(coarse: Array, fine: Array) -> Array:
    """Log of the ratio of the means over the seeds; minus infinity where it is not known."""
    with np.errstate(invalid="ignore"):  # zero by zero
        found = logsumexp(fine, axis=-1) - logsumexp(coarse, axis=-1)
    return np.where(np.isfinite(found), found, -np.inf)


def _biases(coarse: Array, fine: Array) -> tuple[Array, Array, Array]:
    """Of first order in the number of seeds, from log-densities (draw, seed).

    Of the log of the ratio of their means; of that ratio, relative to it; and the variance of both.
    """
    n_seeds = coarse.shape[-1]
    below, above = (softmax(logs, axis=-1) * n_seeds - 1.0 for logs in (coarse, fine))
    pairs = n_seeds * max(n_seeds - 1, 1)
    of_log = (below**2 - above**2).sum(axis=-1) / (2 * pairs)
    of_ratio = (below * (below - above)).sum(axis=-1) / pairs
    return of_log, of_ratio, ((below - above) ** 2).sum(axis=-1) / pairs


def _zeros(coarse: Array, finer: Sequence[Array]) -> Iterator[str]:
    without = [~np.isfinite(logs).any(axis=-1) for logs in (coarse, *finer)]
    if (n_failed := int(np.any(without, axis=0).sum())) > 0:
        yield (
            f"the likelihood is zero at {n_failed} of {without[0].size} draws with the model's "
            "step or with a shorter one: log_lik_change leaves them out, and log_evidence_change "
            "counts those without a likelihood by the shorter step as zero"
        )


def _doubts(dt: float, change: _Change) -> Iterator[str]:
    if not np.isfinite(change.log_ratio).any():
        return  # which `_zeros` has said
    if change.noise > MAX_NOISE:
        yield (
            f"the estimates of the likelihood are too noisy for log_evidence_change at dt = {dt:g}:"
            f" the ratio of their means over {N_SEEDS} seeds has a relative variance of "
            f"{change.noise:.2g} at a draw, and a bias that is not removed exactly. Give the model "
            "a filter with more particles, or GuidedPF; the draws can stay"
        )
        return
    tail, error = pareto_k(change.log_ratio), change.log_evidence_se
    if tail > MAX_PARETO_K or not error <= MIN_EFFECTIVE**-0.5:
        yield (
            f"few draws decide log_evidence_change at dt = {dt:g} (Pareto k = {tail:.2g}, "
            f"standard error {error:.2g}): the posterior with the shorter step lies elsewhere, or "
            "the draws are too few. Take the shorter step in the model and sample again; if "
            "log_lik_change is small, raise n_draws"
        )
