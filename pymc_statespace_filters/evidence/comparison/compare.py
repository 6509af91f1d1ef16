"""Model probabilities from evidences (thesis, 3.1.2)."""

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import norm

from pymc_statespace_filters.errors import EvidenceWarning, ModelError
from pymc_statespace_filters.evidence.comparison.probabilities import (
    EvidenceLike,
    check_ci_prob,
    prior_weights,
    probabilities,
    select_evidences,
)
from pymc_statespace_filters.evidence.evidence import Evidence

# Kass and Raftery (1995), 3.2: twice the log Bayes factor at which each word begins.
STRENGTHS = {0.0: "barely worth mentioning", 2.0: "positive", 6.0: "strong", 10.0: "very strong"}

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DimensionCorrection:
    """The thesis's correction for the number of parameters, c = J^(k alpha / 2) (after Eq. 3.7).

    It is a prior over models, P(M) proportional to J^(-k alpha / 2), and no constant of nature: k
    is the number of free scalar variables, J the model's own number of observations.

    Parameters
    ----------
    exponent : float
        alpha. The thesis used 3; 1 is the penalty of the Bayesian information criterion, for flat
        priors.

    Raises
    ------
    ModelError
        If `exponent` is not a finite number.

    Examples
    --------
    >>> from pymc_statespace_filters import DimensionCorrection, Evidence
    >>> evidence = Evidence(-31.24, 0.02, "chib_jeliazkov", 3, 100, -24.1, "0c5f")
    >>> round(DimensionCorrection(exponent=3).log_prior(evidence), 3)
    -20.723
    """

    exponent: float = 3.0

    def __post_init__(self) -> None:
        if not (isinstance(self.exponent, int | float) and math.isfinite(self.exponent)):
            raise ModelError(f"exponent must be a finite number, got {self.exponent!r}")

    def log_prior(self, evidence: Evidence) -> float:
        """Return -ln c, what is added to the log-evidence."""
        if evidence.n_observations < 1:
            raise ModelError(
                "correction needs models with observed variables, "
                f"got n_observations={evidence.n_observations}"
            )
        return -0.5 * evidence.n_parameters * self.exponent * math.log(evidence.n_observations)


def compare_evidence(
    evidences: Mapping[str, EvidenceLike],
    *,
    prior: Mapping[str, float] | None = None,
    correction: DimensionCorrection | None = None,
    ci_prob: float = 0.95,
    estimator: str | None = None,
) -> pd.DataFrame:
    """Turn evidences into model probabilities, with what their errors leave open (Eq. 3.3).

    Parameters
    ----------
    evidences : mapping of str to Evidence, xarray.DataTree, or mapping of str to Evidence
        Rival models of one record. A DataTree gives its group ``evidence``; the third is what
        `estimate_evidence` returns.
    prior : mapping of str to float, optional
        Positive prior weight of every model, normalised here; equal by default.
    correction : DimensionCorrection, optional
        A further factor of the prior, reported as its own column.
    ci_prob : float
        Probability of the intervals.
    estimator : str, optional
        Whose evidences to compare, as ``"bridge"``, where the models have several.

    Returns
    -------
    pandas.DataFrame
        Index ``model``, most probable first. Columns:

        ``log_evidence``, ``se``
            As estimated, without prior and correction.
        ``correction``
            What it adds to the log-evidence.
        ``prob``, ``prob_low``, ``prob_high``
            With the central interval over normal errors of the log-evidences (50 000 fixed draws,
            so that the same evidences give the same table).
        ``log_bayes_factor``
            Log-evidence less that of the first row.
        ``n_parameters``, ``n_observations``
            k and J.
        ``bic``
            -2 max ln p(D|phi) + k ln J; missing if J = 0.
        ``undecided``
            The errors leave it open, at level `ci_prob`, whether this row or the first is more
            probable (for the first row: whether any other is).
        ``aic``
            -2 max ln p(D|phi) + 2 k.
        ``log_evidence_flat``
            What the log-evidence would be if each Uniform prior had the density one on the same
            support: the thesis's number (Eq. 3.7). It changes with the units of the parameters.
        ``prior``
            Weight of the model before correction; ``prob`` is in proportion to it.
        ``strength``
            Kass and Raftery's word for the evidence of the first row against this one: "barely
            worth mentioning", "positive", "strong" or "very strong" as twice the log Bayes factor
            passes 2, 6 and 10. The factor is taken at the weaker end of its interval, but not
            below 1, so that the word holds in spite of the errors. "negative" if the evidence
            favours this row, and only prior or correction put it below the first. Empty for the
            first row.
        ``warning``
            The number came with doubts, without an error, from an improper prior, or from chains
            that held a noise seed, whose own error ``se`` lacks.

        Where an estimator has no error (``se`` is NaN, as Laplace's), the probabilities are still
        those of the estimates; but all intervals are NaN, since each holds every evidence, what
        is compared with that model is undecided, and its ``strength`` that of the bare estimate.

    Raises
    ------
    ModelError
        If an argument is wrong, or a model has several evidences and none is chosen.
    DataMismatchError
        If the models were given different data.

    Warns
    -----
    EvidenceWarning
        If priors are improper: the probabilities then depend on the units of the parameters.

    References
    ----------
    R. E. Kass and A. E. Raftery, Bayes factors. Journal of the American Statistical Association
    90 (1995), 773-795.

    Examples
    --------
    >>> from pymc_statespace_filters import Evidence, compare_evidence
    >>> linear = Evidence(-41.0, 0.02, "chib_jeliazkov", 2, 100, -35.0, "0c5f")
    >>> cubic = Evidence(-39.0, 0.02, "chib_jeliazkov", 3, 100, -31.0, "0c5f")
    >>> table = compare_evidence({"linear": linear, "cubic": cubic})
    >>> table["prob"].round(3).to_dict()
    {'cubic': 0.881, 'linear': 0.119}
    >>> table.loc["linear", "strength"]
    'positive'
    """
    found = select_evidences(evidences, estimator)
    check_ci_prob(ci_prob)
    if not (correction is None or isinstance(correction, DimensionCorrection)):
        raise ModelError(f"correction must be a DimensionCorrection or None, got {correction!r}")
    names, rivals = list(found), list(found.values())
    weights = prior_weights(prior, names)
    _warn_of_improper(found)

    log_evidence = np.array([rival.log_evidence for rival in rivals])
    se = np.array([rival.se for rival in rivals])
    added = np.array([correction.log_prior(rival) if correction else 0.0 for rival in rivals])
    log_weight = log_evidence + added + np.log(weights)
    probs = probabilities(log_weight, se, ci_prob)
    best = int(np.argmax(log_weight))
    error = norm.ppf((1 + ci_prob) / 2) * np.hypot(se, se[best])  # of a difference from the best
    log_bayes_factor = log_evidence - log_evidence[best]
    table = pd.DataFrame(
        {
            "log_evidence": log_evidence,
            "se": se,
            "correction": added,
            "prob": probs.prob,
            "prob_low": probs.low,
            "prob_high": probs.high,
            "log_bayes_factor": log_bayes_factor,
            "n_parameters": [rival.n_parameters for rival in rivals],
            "n_observations": [rival.n_observations for rival in rivals],
            "bic": [_bic(rival) for rival in rivals],
            "undecided": _undecided(log_weight[best] - log_weight, error, best),
            "aic": [2 * (rival.n_parameters - rival.max_log_likelihood) for rival in rivals],
            "log_evidence_flat": [rival.log_evidence + rival.log_volume for rival in rivals],
            "prior": weights,
            "strength": _strength(-log_bayes_factor, error, best),
            "warning": [
                bool(rival.doubts or rival.improper or math.isnan(rival.se))
                or rival.noise == "held"
                for rival in rivals
            ],
        },
        index=pd.Index(names, name="model"),
    )
    return table.iloc[np.argsort(-log_weight, kind="stable")]


def _warn_of_improper(found: Mapping[str, Evidence]) -> None:
    improper = [f"{name!r} ({one.improper})" for name, one in found.items() if one.improper]
    if improper:
        warnings.warn(
            f"improper or unnormalised priors in {', '.join(improper)}: the model probabilities "
            "depend on the units of these parameters; give them proper priors",
            EvidenceWarning,
            stacklevel=3,
        )


def _undecided(behind: Array, error: Array, best: int) -> NDArray[np.bool_]:
    """Whether the interval of the log-odds against the best model contains zero, or is unknown."""
    undecided = ~(behind > error)
    undecided[best] = False
    undecided[best] = undecided.any()
    return undecided


def _strength(log_bayes_factor: Array, error: Array, best: int) -> list[str]:
    """Words for the evidence of the best model against each."""
    surely = np.maximum(log_bayes_factor - np.nan_to_num(error), 0)
    begun = np.searchsorted(list(STRENGTHS), 2 * surely, side="right") - 1
    words = [list(STRENGTHS.values())[i] for i in begun]
    return [
        "" if i == best else "negative" if log_bayes_factor[i] < 0 else word
        for i, word in enumerate(words)
    ]


def _bic(evidence: Evidence) -> float:
    """Schwarz's criterion; Eq. 3.2 of the thesis prints its penalty twice as large."""
    if evidence.n_observations < 1:
        return math.nan
    penalty = evidence.n_parameters * math.log(evidence.n_observations)
    return -2 * evidence.max_log_likelihood + penalty
