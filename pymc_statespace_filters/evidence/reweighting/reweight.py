"""The public function: draws of an approximate posterior, corrected by an unbiased filter."""

import json
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from ...compiler.native.compilation import COMPILATION
from ...errors import EvidenceWarning, FilterWarning, ModelError, warn
from ...facts import in_words
from ...filters.protocol import Filter
from ...filters.written import short_form
from ...parallel.cpu_affinity import cores_set_to
from ...progress import row_progress
from ...pymc_model.density import ModelDensity
from ...pymc_model.in_step import shared_by_ranks
from ...pymc_model.other_filter import model_of_draws
from ...pymc_model.posterior_draws import MIN_DRAWS, noise_was_moved, posterior_group
from ...statistics.importance import MIN_EFFECTIVE, largest_good_k, pareto_k
from ...system.checks import check_count, check_random_seed, is_integer
from ..evidence_facts import CorrectingFilter
from ..exact_density import ExactDensity
from ..posterior_of_draws import build_posterior
from .correction import MOST_ESTIMATES, Correction, correct, seeds_needed
from .result import reweighted_tree

# Nats, and the share of the draws below which their spread costs too much: it does not where the
# approximate posterior is only too wide.
MAX_SPREAD, LEAST_LEFT = 2.0, 0.2
MAX_BEYOND = 0.05  # share of the posterior where there are no draws


@shared_by_ranks
def reweight(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    filter: Filter,
    n_draws: int | None = None,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
    cores: int | None = None,
    comm: Any = None,
) -> xr.DataTree:
    r"""Correct draws of an approximate posterior by an unbiased filter.

    Draws with a fast filter (`EKF`, `EnKF`) have the bias of that filter. Weighted by
    :math:`\hat L(\theta) / L_a(\theta)`, the unbiased estimate of the likelihood over the
    likelihood that the chain used, they represent the exact posterior, however noisy the estimate
    is (Vihola, Helske and Franks 2020).

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws of the model, from any sampler. Of a noisy filter, ``sample_stats`` must
        hold the log-density ``lp`` or the noise seed of each draw; DRAM stores both.
    model : pymc.Model, optional
        The model that was sampled, with its filter; by default that of the ``with`` block. Every
        observed StateSpace variable gets the new filter; the records of a panel have one weight
        together.
    filter : filter
        Unbiased, as `BootstrapPF` and `GuidedPF`, or exact for the system, as `GridFilter`.
    n_draws : int, optional
        Number of draws that are weighted, evenly from every chain, and of draws returned; by
        default all, or as many as 32 000 estimates allow.
    random_seed : int or numpy.random.Generator, optional
        Of the noise of the filter, of further points and of the resampling.
    progressbar, cores, comm
        As of `estimate_evidence`.

    Returns
    -------
    xarray.DataTree
        None on ranks that do not get it.

        ``posterior`` : draws of the exact posterior, resampled by the weights, with equal weights
        now; variables of the model. ``sample_stats`` : as of a chain with the new filter, the
        log-density ``lp`` and the noise seed ``NAME_seed`` of every draw, so that states and
        evidences of the model with that filter can be computed.

        ``weighted_posterior`` : all points along the dimension ``sample``: the draws, chain by
        chain (``is_draw``), and the further points. ``log_weight`` has the raw weights, whose mean
        is the evidence; ``weight`` has them Pareto-smoothed and with the sum one, as ``az.extract``
        takes them.

        Of the attributes,

        * ``n_draws``, how many draws were weighted, and ``n_seeds``, how many estimates of each
          were averaged;
        * ``log_weight_sd``, the spread of the log-weights of the draws in nats; ``pareto_k`` of all
          weights; ``effective_size``, the number of independent draws that know the mean of every
          variable as well;
        * ``beyond_draws`` and its standard error ``beyond_draws_se``, the share of the exact
          posterior where there are no draws;
        * ``log_evidence`` of the exact model, and ``log_evidence_change``, the same minus that of
          the model with its own filter; standard errors with the suffix ``_se``;
        * ``filter``, ``exact`` and ``filter_check``, as of `sample_dram`.

    Raises
    ------
    ModelError
        If the filter is biased, cannot treat the system or is that of the model; or if another
        argument is invalid.
    DataMismatchError
        If the draws belong to another model or other data, or the likelihood estimates of the chain
        cannot be recovered.
    TypeError
        If no model is given, by argument or ``with`` block.

    Warns
    -----
    FilterWarning
        If the new filter is found to be off at the result, by the check that `sample_dram` makes at
        its end (`check_filter`): weights do not show that a `GuidedPF` is too low. ``exact`` is
        then 0.
    EvidenceWarning
        If the log-weights spread by more than 2 nats and are worth less than a fifth of the draws,
        if few weights decide (Pareto k or effective size), or if more than a twentieth of the exact
        posterior lies where there are no draws. The message says what helps.

    Notes
    -----
    Weights of draws look perfect where the draws have missed a mode. A search with the exact
    likelihood and a quarter as many further points, from a density much wider than the draws,
    therefore look for what is missing. Draws and points are one sample, with weights relative to
    the mixture of their densities, and the result contains both.

    The filter is evaluated once at each draw and further point, or up to 16 times if the noise of
    one estimate would decide the weights, and about 600 times more. The check of the filter takes
    four CPU seconds at most, or a tenth of the time of the rest.

    References
    ----------
    M. Vihola, J. Helske and J. Franks (2020). Importance sampling type estimators based on
    approximate marginal Markov chain Monte Carlo. Scandinavian Journal of Statistics 47, 1339-1376.

    T. Hesterberg (1995). Weighted average importance sampling and defensive mixture distributions.
    Technometrics 37, 185-194.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> system = psf.StateSpaceModel(
    ...     transition=lambda x, q, a: [a * x[0] + q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0] + 0.1 * x[0] ** 2],
    ...     observation_noise=[[0.5]],
    ...     initial_mean=[0.0],
    ...     initial_cov=[[1.0]],
    ... )
    >>> with pm.Model() as model:
    ...     a = pm.Uniform("a", -1, 1)
    ...     d = psf.StateSpace(
    ...         "d", system, psf.EKF(), steps=[1, 2, 3, 4], observed=[0.3, 1.2, 2.0, 1.1]
    ...     )
    ...     approximate = psf.sample_dram(500, tune=500, random_seed=1, progressbar=False)
    >>> exact = psf.reweight(approximate, model, filter=psf.BootstrapPF(100), random_seed=2)
    >>> exact["posterior"]["a"].shape
    (4, 500)
    >>> bool(exact.attrs["pareto_k"] < 0.7), bool(exact.attrs["log_weight_sd"] < 1)
    (True, True)
    """
    model = model_of_draws(model, idata)
    rng, began = check_random_seed(random_seed), time.process_time()
    with cores_set_to(None if cores is None else check_count("cores", cores, 1)), COMPILATION:
        exact = ExactDensity(model, filter)
        density = ModelDensity(model, moved=noise_was_moved(idata))
        posterior, _ = build_posterior(idata, density)
        n_seeds = seeds_needed(posterior, exact.evaluate, exact.n_noisy, rng)
        rows = _rows(idata, n_draws, MOST_ESTIMATES // n_seeds)
        kept, seeds_of_point = posterior.at(np.s_[:, rows]), (n_seeds, exact.n_noisy)
        with row_progress(exact, enabled=progressbar) as announce:
            found = correct(posterior, kept, exact.evaluate, seeds_of_point, rng, announce)
        draws = posterior_group(idata).isel(draw=rows)
        tree = reweighted_tree(idata, draws, found, exact, rng)
        own = np.random.default_rng(rng.integers(2**63))
        seconds = time.process_time() - began
        tree.attrs |= (attrs := _attributes(found, exact))
        off = in_words(CorrectingFilter(tree, model, filter, seconds, own))
    if off:  # by which the weights are as they are
        warn(off, FilterWarning)
        return tree
    for problem in _problems(attrs, filter):
        warn(problem, EvidenceWarning)
    return tree


def _rows(idata: xr.DataTree, n_draws: int | None, default: int) -> np.ndarray:
    """The draws of every chain that are weighted."""
    posterior = posterior_group(idata)
    n_chains, length = posterior.sizes["chain"], posterior.sizes["draw"]
    least, most = n_chains * MIN_DRAWS, n_chains * length
    if n_draws is None:
        n_draws = min(most, max(least, default))
    if not is_integer(n_draws) or not least <= n_draws <= most:
        raise ModelError(
            f"n_draws must be an integer from {least} to {most}, the number of draws, or None, got "
            f"{n_draws!r}"
        )
    return np.linspace(0, length - 1, n_draws // n_chains).round().astype(int)


def _attributes(found: Correction, exact: ExactDensity) -> dict[str, Any]:
    pooled, beyond = found.pooled, found.beyond_draws
    evidence, change = pooled.log_evidence(), pooled.log_evidence_change()
    return {
        "filter": json.dumps(dict.fromkeys(exact.names, short_form(exact.filter))),
        "exact": int(exact.is_exact),
        "n_draws": pooled.n_draws,
        "log_weight_sd": found.spread,
        "pareto_k": pareto_k(pooled.log_weights),
        "effective_size": pooled.effective_size(found.x),
        "n_seeds": found.log_estimates.shape[1],
        "beyond_draws": beyond[0],
        "beyond_draws_se": beyond[1],
        "log_evidence": evidence.value,
        "log_evidence_se": evidence.error,
        "log_evidence_change": change.value,
        "log_evidence_change_se": change.error,
    }


def _problems(attrs: dict[str, Any], filter: Filter) -> Iterator[str]:
    """What makes the weights unreliable, each with its remedy."""
    name = short_form(filter)
    instead = (
        f"sample the model with {name} instead, by psf.sample_dram with these draws as pilot= and "
        "a fast filter as screen="
    )
    n_draws, n_effective = attrs["n_draws"], attrs["effective_size"]
    if attrs["log_weight_sd"] > MAX_SPREAD and n_effective < LEAST_LEFT * n_draws:
        yield (
            f"the log-weights of the draws spread by {attrs['log_weight_sd']:.1f} nats, above "
            f"{MAX_SPREAD:g}: the filter of the draws is too far from {name}, or its estimates are "
            f"too noisy, for weights to make up for it. Give {name} more particles; if that does "
            f"not help, {instead}"
        )
    elif n_effective < MIN_EFFECTIVE or not attrs["pareto_k"] <= largest_good_k(n_draws):
        yield (
            f"few weights decide the exact posterior: it has {n_effective:.0f} "
            f"effective draws, and the Pareto k of the weights is {attrs['pareto_k']:.2f}. Weight "
            f"more draws; if that does not help, {instead}"
        )
    if attrs["beyond_draws"] > MAX_BEYOND:
        yield (
            f"{attrs['beyond_draws']:.0%} ± {attrs['beyond_draws_se']:.0%} of the exact posterior "
            "lies where there are no draws: the approximate posterior lacks a mode or a tail, or "
            f"its chains have missed one. The result contains what was found there; {instead}"
        )
