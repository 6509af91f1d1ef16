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
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import pymc as pm
import xarray as xr

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.evidence._means import (
    LogMean,
    log_mean_of_chains,
    log_mean_of_independent,
)
from pymc_statespace_filters.evidence._proposal import Proposal, choose_proposal
from pymc_statespace_filters.evidence.estimate import Estimate
from pymc_statespace_filters.evidence.posterior import Posterior
from pymc_statespace_filters.evidence.report import evidences_of
from pymc_statespace_filters.evidence.result import Evidence

MIN_PROPOSALS = 100
MIN_EFFECTIVE = 100  # with fewer effective terms the standard error is itself a guess
MAX_GAP = 4.0


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
    found = evidences_of(
        idata,
        model,
        {"chib_jeliazkov": ChibJeliazkov(n_proposals)},
        random_seed=random_seed,
        extend_inferencedata=extend_inferencedata,
        progressbar=progressbar,
    )
    return found["chib_jeliazkov"]


@dataclass(frozen=True)
class ChibJeliazkov:
    """The estimator behind `chib_jeliazkov` (Eq. 3.44).

    Each half of the chains fits the proposal under which the other half is averaged; the two
    estimates are averaged. Fitted to the very draws that it averages, q would overrate the
    ordinate, by as much as the standard error when the draws are few or sticky.

    Parameters
    ----------
    n_proposals : int, optional
        Draws from q(x*, .) for the denominators of both halves together.
    """

    n_proposals: int | None = None

    def __post_init__(self) -> None:
        given = self.n_proposals
        if given is not None and not (
            isinstance(given, int | np.integer) and given >= MIN_PROPOSALS
        ):
            raise ModelError(
                f"n_proposals must be an integer of at least {MIN_PROPOSALS}, got {given!r}"
            )

    def n_evaluations(self, posterior: Posterior) -> int:
        """The number of proposals."""
        return self.n_proposals or min(max(posterior.log_density.size, 1000), 5000)

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from draws and a log-density that can be evaluated."""
        n_draws = posterior.log_density.size
        n_proposals = self.n_evaluations(posterior)
        first, second = posterior.halves()
        folds = []
        for fitted, averaged in ((first, second), (second, first)):
            proposal = choose_proposal(fitted, n_proposals=n_proposals // 2, rng=rng)
            folds.append(_estimate_fold(proposal, averaged, n_proposals // 2, rng=rng))
        se = math.hypot(*(fold.se for fold in folds)) / 2
        gap = abs(folds[0].log_evidence - folds[1].log_evidence) / math.hypot(
            *(f.se for f in folds)
        )
        numerator = _effective(fold.numerator.n_effective for fold in folds)
        denominator = _effective(fold.denominator.n_effective for fold in folds)
        return Estimate(
            log_evidence=float(np.mean([fold.log_evidence for fold in folds])),
            se=se,
            settings={
                "scale": float(np.sqrt(folds[0].scale * folds[1].scale)),
                "n_draws": n_draws,
                "n_proposals": n_proposals,
                "n_effective_numerator": numerator,
                "n_effective_denominator": denominator,
                "zero_density": float(np.mean([fold.zero_density for fold in folds])),
            },
            doubts=tuple(_doubts(numerator, denominator, gap)),
        )


@dataclass(frozen=True)
class _Fold:
    """The estimate from one half of the draws."""

    log_evidence: float
    scale: float
    numerator: LogMean
    denominator: LogMean
    zero_density: float  # share of the proposals

    @property
    def se(self) -> float:
        return math.hypot(self.numerator.error, self.denominator.error)


def _estimate_fold(
    proposal: Proposal, posterior: Posterior, n_proposals: int, *, rng: np.random.Generator
) -> _Fold:
    # Numerator: the draws, with the log-densities that their chain stored.
    numerator = log_mean_of_chains(
        proposal.log_arriving(posterior.log_density) + proposal.log_q(posterior.draws)
    )

    # Denominator: draws from q(x*, .), with fresh log-densities.
    log_alpha = proposal.log_leaving(posterior.evaluate(proposal.sample(n_proposals, rng), rng))
    denominator = log_mean_of_independent(log_alpha)
    if np.isneginf(denominator.value):
        raise DataMismatchError(
            f"none of {n_proposals} proposals around the draws has a density: idata belongs to "
            "another model or to other data"
        )
    log_evidence = proposal.log_density - numerator.value + denominator.value
    impossible = float(np.isneginf(log_alpha).mean())
    return _Fold(log_evidence, proposal.scale, numerator, denominator, impossible)


def _effective(halves: Iterable[float]) -> float:
    """Effective number of the average of two independent means."""
    return 4 / sum(1 / number for number in halves)


def _doubts(n_draws: float, n_proposals: float, gap: float) -> Iterator[str]:
    """Reasons for doubt, from the effective numbers and the gap between halves in its errors."""
    if n_draws < MIN_EFFECTIVE:
        yield (
            f"the draws near its central point are worth {n_draws:.0f} independent "
            f"ones, fewer than {MIN_EFFECTIVE}: draw more"
        )
    if n_proposals < MIN_EFFECTIVE:
        yield (
            f"the proposals are worth {n_proposals:.0f} independent ones, fewer than "
            f"{MIN_EFFECTIVE}: raise n_proposals, or give the parameters a scale on which their "
            "posterior is nearer to a Gaussian"
        )
    if gap > MAX_GAP:
        yield f"the halves of the draws differ by {gap:.1f} of their standard errors"
