r"""Chib and Jeliazkov's estimate of the evidence, made after the draws (thesis, 3.3.2).

At any point x* of the unconstrained space, with f = log prior + log likelihood and a symmetric q,

.. math::

    \ln p(D) = f(x^*) - \ln \frac{E_{x \sim p(x|D)}[\alpha(x, x^*)\, q(x, x^*)]}
                                {E_{x \sim q(x^*, \cdot)}[\alpha(x^*, x)]},
    \qquad \alpha(x, y) = \min(1, e^{f(y) - f(x)})

(Eqs. 3.4, 3.38, 3.44). The draws need only come from the posterior, whatever kernel made them; q is
this file's own: N(x*, s^2 C), C the covariance of the draws. On a Gaussian posterior the relative
variances of the two means, per independent term, are [1 + 1/(s^2 (s^2 + 2))]^(k/2) - 1 and [1 +
s^4/(1 + 2 s^2)]^(k/2) - 1, mirror images about s = 1; autocorrelation enlarges the first and so
asks for a wider q, and s is chosen from the draws for the smallest sum.

Differences from the source. The denominator's draws come from q(x*, .), where Eq. 3.40 reads as if
they came from the posterior. Proposals without density stay in its mean, as zeros. Constraints are
handled by transforms, with their Jacobian in f, instead of a folded q.

With a noisy likelihood f(x_s) is the estimate that the chain stored, f of a proposal is a fresh
one, and f(x*) is one constant in both means. Detailed balance of the chain on (x, noise) makes the
identity exact for the evidence of the expected likelihood, whatever the constant: it bears on the
error only.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import pymc as pm
import xarray as xr
from pymc.progress_bar import create_simple_progress

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.evidence._proposal import (
    Proposal,
    choose_proposal,
    log_mean_of_chains,
    log_mean_of_independent,
)
from pymc_statespace_filters.evidence.data import data_fingerprint, observation_count
from pymc_statespace_filters.evidence.diagnostics import warn_if_doubtful
from pymc_statespace_filters.evidence.posterior import (
    ModelDensity,
    Posterior,
    noise_was_moved,
    posterior_of,
)
from pymc_statespace_filters.evidence.result import Evidence, store_evidence

MIN_PROPOSALS = 100
N_BATCHES = 50
PATIENCE = 2.0  # seconds without a progress bar


def chib_jeliazkov(
    idata: xr.DataTree,
    model: pm.Model | None = None,
    *,
    n_proposals: int | None = None,
    random_seed: int | np.random.Generator | None = None,
    extend_inferencedata: bool = True,
    progressbar: bool = True,
) -> Evidence:
    """Estimate the evidence of a model from draws of its posterior (thesis, 3.3.2 and Eq. 3.44).

    Parameters
    ----------
    idata : xarray.DataTree
        Posterior draws by any sampler (NUTS, nutpie, DRAM, ...), warm-up removed. If `model` has a
        noisy likelihood, ``sample_stats`` must hold ``lp`` or the noise seed of each draw, as DRAM
        leaves them.
    model : pymc.Model, optional
        The model that was sampled; by default that of the ``with`` block. Everything in it counts:
        priors, observed variables, Potentials.
    n_proposals : int, optional
        Evaluations of the log-density around a central point; by default as many as there are
        draws, at least 1000 and at most 5000.
    random_seed : int or numpy.random.Generator, optional
        For the proposals and the noise of their likelihoods.
    extend_inferencedata : bool
        Also store the result as the group ``evidence`` of `idata`.
    progressbar : bool
        Show one if the evaluations take more than two seconds.

    Returns
    -------
    Evidence
        Its `se` counts the autocorrelation of the draws and the proposals' own error. If the chains
        held one noise seed (``noise="held"``), this is the evidence under that seed and `se` lacks
        the error of the filter. With a noisy likelihood `max_log_likelihood` is an average of fresh
        estimates at a central point; else it is the largest of the draws.

    Raises
    ------
    ModelError
        If a free variable is discrete, or the draws are too few or do not vary.
    DataMismatchError
        If the draws lack free variables of the model or belong to another model or to other data.

    Warns
    -----
    EvidenceWarning
        If few terms dominate a mean, or the chains disagree.

    Examples
    --------
    One parameter, three observations, and draws from the posterior that is known:

    >>> import arviz as az
    >>> import numpy as np
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> normals = np.random.default_rng(1).standard_normal((4, 1000))
    >>> idata = az.from_dict({"posterior": {"mu": 4 / 13 + normals / np.sqrt(3.25)}})
    >>> with pm.Model():
    ...     mu = pm.Normal("mu", 0, 2)
    ...     _ = pm.Normal("y", mu, 1, observed=[0.3, -0.4, 1.1])
    ...     evidence = psf.chib_jeliazkov(idata, random_seed=2)
    >>> abs(evidence.log_evidence - (-4.6154)) < 4 * evidence.se < 0.1
    True
    """
    density = ModelDensity(pm.modelcontext(model), moved=noise_was_moved(idata))
    posterior, noise = posterior_of(idata, density)
    n_draws = posterior.log_density.size
    if n_proposals is None:
        n_proposals = min(max(n_draws, 1000), 5000)
    if not isinstance(n_proposals, int | np.integer) or n_proposals < MIN_PROPOSALS:
        raise ModelError(
            f"n_proposals must be an integer of at least {MIN_PROPOSALS}, got {n_proposals!r}"
        )

    rng = np.random.default_rng(random_seed)
    is_slow = n_proposals * _seconds_per_evaluation(posterior) > PATIENCE
    bar = create_simple_progress(progressbar and is_slow)
    with bar:
        task = bar.add_task("Evaluating proposals", completed=0, total=n_proposals)
        found = estimate(
            posterior,
            n_proposals=n_proposals,
            rng=rng,
            progress=lambda count: bar.advance(task, advance=count),
        )
    warn_if_doubtful(
        posterior,
        found.log_evidence,
        gap=found.gap,
        n_effective_draws=found.n_effective_numerator,
        n_effective_proposals=found.n_effective_denominator,
    )

    evidence = Evidence(
        log_evidence=found.log_evidence,
        se=found.se,
        estimator="chib_jeliazkov",
        n_parameters=posterior.draws.shape[-1],
        n_observations=observation_count(density.model),
        max_log_likelihood=_max_log_likelihood(found, posterior, density),
        data_fingerprint=data_fingerprint(density.model),
        noise=noise,
    )
    if extend_inferencedata:
        settings = {
            "scale": found.scale,
            "n_draws": n_draws,
            "n_proposals": n_proposals,
            "n_effective_numerator": found.n_effective_numerator,
            "n_effective_denominator": found.n_effective_denominator,
            "zero_density": found.zero_density,
        }
        store_evidence(idata, evidence, settings)
    return evidence


@dataclass(frozen=True)
class Estimate:
    """The log-evidence, its standard error, and how it came about.

    An effective number is the inverse squared relative error of a mean: so many independent terms
    of relative variance one would be as good.
    """

    log_evidence: float
    se: float
    scale: float  # geometric mean over the halves
    n_effective_numerator: float
    n_effective_denominator: float
    zero_density: float  # share of the proposals
    proposals: tuple[Proposal, ...]
    gap: float = 0.0  # between the halves, in standard errors of their difference


def estimate(
    posterior: Posterior,
    *,
    n_proposals: int,
    rng: np.random.Generator,
    progress: Callable[[int], None] = lambda count: None,
) -> Estimate:
    """Estimate the log-evidence from draws and a log-density that can be evaluated (Eq. 3.44).

    Each half of the chains fits the proposal under which the other half is averaged; the two
    estimates are averaged. Fitted to the very draws that it averages, q would overrate the
    ordinate, by as much as the standard error when the draws are few or sticky.

    Parameters
    ----------
    posterior : Posterior
        Draws, their stored log-densities, and the function that evaluates more.
    n_proposals : int
        Draws from q(x*, .) for the denominators of both halves together.
    rng : numpy.random.Generator
        For those draws and for the noise of their log-densities.
    progress : callable
        Told after each batch how many proposals it had.

    Returns
    -------
    Estimate
    """
    first, second = posterior.halves()
    folds = []
    for fitted, averaged in ((first, second), (second, first)):
        proposal = choose_proposal(fitted, n_proposals=n_proposals // 2, rng=rng)
        folds.append(
            _estimate_fold(proposal, averaged, n_proposals // 2, rng=rng, progress=progress)
        )
    return Estimate(
        log_evidence=float(np.mean([fold.log_evidence for fold in folds])),
        se=math.hypot(*(fold.se for fold in folds)) / 2,
        scale=float(np.sqrt(folds[0].scale * folds[1].scale)),
        n_effective_numerator=_effective(fold.n_effective_numerator for fold in folds),
        n_effective_denominator=_effective(fold.n_effective_denominator for fold in folds),
        zero_density=float(np.mean([fold.zero_density for fold in folds])),
        proposals=(*folds[0].proposals, *folds[1].proposals),
        gap=(folds[0].log_evidence - folds[1].log_evidence) / math.hypot(folds[0].se, folds[1].se),
    )


def _estimate_fold(
    proposal: Proposal,
    posterior: Posterior,
    n_proposals: int,
    *,
    rng: np.random.Generator,
    progress: Callable[[int], None],
) -> Estimate:
    # Numerator: the draws, with the log-densities that their chain stored.
    numerator = log_mean_of_chains(
        proposal.log_arriving(posterior.log_density) + proposal.log_q(posterior.draws)
    )

    # Denominator: draws from q(x*, .), with fresh log-densities.
    batches = []
    for batch in np.array_split(proposal.sample(n_proposals, rng), min(n_proposals, N_BATCHES)):
        batches.append(proposal.log_leaving(posterior.evaluate(batch, rng)))
        progress(len(batch))
    log_alpha = np.concatenate(batches)
    denominator = log_mean_of_independent(log_alpha)
    if np.isneginf(denominator.value):
        raise DataMismatchError(
            f"none of {n_proposals} proposals around the draws has a density: idata belongs to "
            "another model or to other data"
        )

    return Estimate(
        log_evidence=proposal.log_density - numerator.value + denominator.value,
        se=float(np.hypot(numerator.error, denominator.error)),
        scale=proposal.scale,
        n_effective_numerator=numerator.error**-2,
        n_effective_denominator=denominator.error**-2,
        zero_density=float(np.isneginf(log_alpha).mean()),
        proposals=(proposal,),
    )


def _effective(halves: Iterable[float]) -> float:
    """Effective number of the average of two independent means."""
    return 4 / sum(1 / number for number in halves)


def _max_log_likelihood(found: Estimate, posterior: Posterior, density: ModelDensity) -> float:
    if posterior.is_noisy:  # the largest of many noisy values would be the luckiest
        points = np.stack([proposal.point for proposal in found.proposals])
        values = np.array([proposal.log_density for proposal in found.proposals])
    else:
        points = posterior.draws.reshape(-1, posterior.draws.shape[-1])
        values = posterior.log_density.ravel()
    return float((values - density.log_prior(points)).max())


def _seconds_per_evaluation(posterior: Posterior) -> float:
    start = perf_counter()
    posterior.evaluate(posterior.draws[0, :3], np.random.default_rng(0))
    return (perf_counter() - start) / 3
