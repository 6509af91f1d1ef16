"""The public function: whether a parameter drifts, as a Bayes factor."""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.stats import norm

from ...compiler.native.compilation import COMPILATION
from ...errors import EvidenceWarning, warn
from ...progress import row_progress
from ...pymc_model.density import ModelDensity
from ...pymc_model.inspection import given_model
from ...pymc_model.posterior_draws import noise_was_moved, populations_of, posterior_group
from ...statistics.importance import (
    MIN_EFFECTIVE,
    LogMean,
    disagreement,
    largest_good_k,
    log_mean,
    log_mean_of_draws,
    pareto_k,
)
from ...system.checks import check_ci_prob, check_random_seed
from ..checks import check_convergence
from ..comparison.scaled_prior import UNCHANGED, UNKNOWN, ScaledPrior
from ..comparison.selection import prior_weights, probabilities
from ..comparison.width_curves import curves_of_models, dataset_of_curves, width_factors
from ..posterior_of_draws import build_posterior, reproducing_seeds
from .drift_table import DriftTable, sentences
from .marginal import ConstantModel
from .strengths import chosen_strengths

MODELS = ["constant", "drifting"]

Array = NDArray[np.float64]


def drift_evidence(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    var_names: str | Iterable[str] | None = None,
    model_prior: Mapping[str, float] | None = None,
    widths: ArrayLike | None = None,
    ci_prob: float = 0.95,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool = True,
) -> pd.DataFrame:
    r"""Compute the Bayes factor for drift, from draws of the model in which a parameter drifts.

    The constant model is that with the strength of the drift at zero,
    ``pm.do(model, {"beta_strength": 0.0})``: the priors of all other variables stay, and those that
    a strength of zero makes irrelevant, such as the rate of an `OrnsteinUhlenbeck`, have no
    influence. It needs no draws of its own: its evidence over that of the drifting model is an
    importance-weighted marginal density estimate (Chen 1994).

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws of the drifting model, from any sampler. Of a noisy filter, ``sample_stats``
        must hold the log-density ``lp`` or the noise seed of each draw; DRAM stores both.
    model : pymc.Model, optional
        The drifting model; by default that of the ``with`` block.
    var_names : str or iterable of str, optional
        The strengths: free variables with zero as the lower end or in the middle of their support.
        By default those of the drifting parameters of the model's systems. A strength that is a
        vector is zero as a whole.
    model_prior : mapping of str to float, optional
        Prior weights of ``"constant"`` and ``"drifting"``; equal by default.
    widths : array_like of float, optional
        Factors of the prior's width as of `prior_sensitivity`, for the curves in ``widths``.
    ci_prob : float
        Probability of the intervals.
    random_seed : int or numpy.random.Generator, optional
        Of the noise of a filter whose seeds were not stored.
    progressbar : bool
        Whether to show a progress bar if the evaluations take more than two seconds.

    Returns
    -------
    pandas.DataFrame
        A row for each strength, the others drifting, most probable drift first; with several, a
        last row for all of them together. Index ``strength``. Its display shows the first five
        columns:

        ``prob``, ``prob_low``, ``prob_high``
            Probability of drift, and its central interval under a normal error of the Bayes factor.
        ``log_bayes_factor``, ``se``
            Log-evidence of the drifting model minus that of the constant one, and its standard
            error; NaN if few terms decide.
        ``undecided``
            Whether the error leaves open, at level `ci_prob`, which of both is more probable.
        ``pareto_k``, ``n_effective``
            Shape of the upper tail of the averaged terms, and their effective number: the inverse
            square of ``se``.
        ``prior``
            Prior probability of drift.
        ``doubts``
            Reasons why the error may be larger; empty if there are none.

        Its attribute ``widths`` is a Dataset with the same along the dimension ``width``, the
        factor by which the priors of the row's strengths are scaled: `plot_prior_sensitivity`
        draws it. Values are NaN where the draws do not determine them.

    Raises
    ------
    ModelError
        If an argument is invalid, or the prior of a strength is improper or has another support.
    DataMismatchError
        If the draws belong to another model or other data, or the likelihood estimates of the chain
        cannot be recovered.

    Warns
    -----
    EvidenceWarning
        If few terms decide, as where the data exclude a constant parameter by far, or if the chains
        disagree.

    Notes
    -----
    Each draw takes an evaluation of the likelihood for each row.

    The likelihood depends on the *square* of the strength, so that the null hypothesis is at the
    boundary of the support; the draws of a strength are on the log scale, where zero is at minus
    infinity, so that a density fitted to them has no value at zero.

    References
    ----------
    M.-H. Chen (1994). Importance-weighted marginal Bayesian posterior density estimation. Journal
    of the American Statistical Association 89, 818-824.

    Examples
    --------
    A random walk in noise: does the mean of the data drift?

    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> mean = psf.StateSpaceModel(
    ...     transition=lambda x, q, mu_strength: [x[0] + mu_strength * q[0]],
    ...     process_noise=[[1.0]],
    ...     observation=lambda x: [x[0]],
    ...     observation_noise=[[1.0]],
    ...     initial_mean=lambda mu: [mu],
    ...     initial_cov=[[0.0]],
    ... )
    >>> with pm.Model() as model:
    ...     mu = pm.Normal("mu", 0, 2)
    ...     strength = pm.HalfNormal("mu_strength", 1)
    ...     d = psf.StateSpace(
    ...         "d", mean, psf.EKF(), steps=range(6), observed=[0.3, -0.4, 1.1, 0.2, 0.6, -0.1]
    ...     )
    ...     idata = psf.sample_dram(random_seed=1, progressbar=False)
    ...     table = psf.drift_evidence(idata, var_names="mu_strength", random_seed=2)
    >>> table["log_bayes_factor"].round(1).to_dict()
    {'mu_strength': -0.7}
    """
    model = given_model(model)
    check_ci_prob(ci_prob)
    factors, rng = width_factors(widths), check_random_seed(random_seed)
    prior = prior_weights(model_prior, MODELS)
    posterior_group(idata)  # fails early, before anything is compiled
    names = chosen_strengths(model, var_names)
    sets = [(name,) for name in names] + ([tuple(names)] if len(names) > 1 else [])
    log_terms, of_chains = _log_terms(idata, model, sets, rng, progressbar)
    population = populations_of(idata)
    means = {one: log_mean_of_draws(terms, population) for one, terms in log_terms.items()}
    doubts = {
        one: [*_doubts(one, terms, means[one], population is not None)]
        for one, terms in log_terms.items()
    }
    table = _table(log_terms, means, doubts, prior, ci_prob)
    for name, row in table.iterrows():
        if row["doubts"]:
            warn(f"drift of {name}: {row['doubts']}", EvidenceWarning)
    if of_chains:
        warn(f"drift: {'; '.join(of_chains)}", EvidenceWarning)
    known = {one: None if doubts[one] else terms for one, terms in log_terms.items()}
    curves = _by_width(model, idata, known, factors, np.log(prior), ci_prob)
    others = [rv.name for rv in model.free_RVs if rv.name not in names]
    return DriftTable(table, widths=curves, sentences=[*sentences(table, others, ci_prob)])


def _log_terms(
    idata: xr.DataTree,
    model: pm.Model,
    sets: list[tuple[str, ...]],
    rng: np.random.Generator,
    progressbar: bool,
) -> tuple[dict[tuple[str, ...], Array], list[str]]:
    """The terms (chain, draw) of the mean for each set of strengths; whether the chains agree."""
    found = {}
    with COMPILATION:
        moved = noise_was_moved(idata)
        density = ModelDensity(model, moved=moved)
        posterior, _ = build_posterior(idata, density)
        seeds = reproducing_seeds(idata, density)
        for names in sets:
            constant = ConstantModel(model, names, moved=moved)
            with row_progress(constant.density.calls, enabled=progressbar) as announce:
                announce(f"without {', '.join(names)}", posterior.log_density.size)
                found[names] = constant.log_terms(posterior, seeds, rng)
    return found, list(check_convergence(posterior, idata))


def _doubts(
    names: tuple[str, ...], log_terms: Array, mean: LogMean, are_populations: bool
) -> Iterator[str]:
    """Why the mean of the terms is unknown."""
    tail = pareto_k(log_terms)
    if mean.n_effective < MIN_EFFECTIVE or not tail <= largest_good_k(log_terms.size):
        zeros = ", ".join(f"{name!r}: 0.0" for name in names)
        yield (
            f"few draws are near those of the constant model (Pareto k {tail:.2f}, "
            f"{mean.n_effective:.0f} effective terms): draw more, or sample "
            f"pm.do(model, {{{zeros}}}) too and compare both by psf.compare_evidence"
        )
    elif not are_populations and (reason := disagreement(log_terms)):
        yield reason


def _by_width(
    model: pm.Model,
    idata: xr.DataTree,
    log_terms: Mapping[tuple[str, ...], Array | None],
    widths: Array,
    log_prior: Array,
    ci_prob: float,
) -> xr.Dataset:
    """The probability of drift for strengths whose priors are scaled together.

    ``log_terms`` has the terms (chain, draw) of the mean Z_0 / Z_1 for each set of strengths, or
    None where that mean is unknown; ``log_prior`` (2,) is that of constant and drifting. The
    evidence of the constant model is one, at all widths.
    """
    fields: dict[str, list[Array]] = {}
    for names, terms in log_terms.items():
        value, drifting = np.nan, [UNKNOWN] * len(widths)
        if terms is not None:
            value = -log_mean(terms)
            drifting = ScaledPrior(model, names).curve(idata, widths, log_terms=terms)
        found = curves_of_models(
            np.array([0.0, value]),
            np.zeros(2),
            log_prior,
            [[UNCHANGED] * len(widths), drifting],
            ci_prob,
        )
        found["log_bayes_factor"] = found.pop("log_evidence")
        for name, (_, of_drift) in found.items():
            fields.setdefault(name, []).append(of_drift)
    return dataset_of_curves(
        {name: np.array(rows) for name, rows in fields.items()},
        [f"drift, {', '.join(names)}" for names in log_terms],
        widths,
        ci_prob=ci_prob,
    )


def _table(
    log_terms: Mapping[tuple[str, ...], Array],
    means: Mapping[tuple[str, ...], LogMean],
    doubts: Mapping[tuple[str, ...], list[str]],
    prior: Array,
    ci_prob: float,
) -> pd.DataFrame:
    rows = []
    for names, mean in means.items():
        factor, se = -mean.value, np.nan if doubts[names] else mean.error
        log_weight = np.array([0.0, factor]) + np.log(prior)
        prob, low, high = (
            each[1] for each in probabilities(log_weight, np.array([0.0, se]), ci_prob)
        )
        margin = norm.ppf((1 + ci_prob) / 2) * se
        rows.append(
            {
                "strength": ", ".join(names),
                "prob": prob,
                "prob_low": low,
                "prob_high": high,
                "log_bayes_factor": factor,
                "se": se,
                "undecided": not abs(log_weight[1] - log_weight[0]) > margin,
                "pareto_k": pareto_k(log_terms[names]),
                "n_effective": mean.n_effective,
                "prior": prior[1],
                "doubts": "; ".join(doubts[names]),
            }
        )
    single = rows[: sum(len(names) == 1 for names in means)]
    ordered = sorted(single, key=lambda row: -row["prob"]) + rows[len(single) :]
    return pd.DataFrame(ordered).set_index("strength")
