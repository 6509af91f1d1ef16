"""Model probabilities from evidences (thesis, 3.1.2)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from scipy.special import log_softmax
from scipy.stats import norm

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.evidence.result import Evidence, stored_evidence

N_NORMALS = 50_000

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
    evidences: Mapping[str, Evidence | xr.DataTree],
    *,
    prior: Mapping[str, float] | None = None,
    correction: DimensionCorrection | None = None,
    ci_prob: float = 0.95,
) -> pd.DataFrame:
    """Turn evidences into model probabilities, with what their errors leave open (Eq. 3.3).

    Parameters
    ----------
    evidences : mapping of str to Evidence or xarray.DataTree
        Rival models of one record. A DataTree gives its group ``evidence``.
    prior : mapping of str to float, optional
        Positive prior weight of every model, normalised here; equal by default.
    correction : DimensionCorrection, optional
        A further factor of the prior, reported as its own column.
    ci_prob : float
        Probability of the intervals.

    Returns
    -------
    pandas.DataFrame
        Index ``model``, most probable first. Columns: ``log_evidence`` and ``se`` (as estimated,
        without prior and correction); ``correction`` (what it adds); ``prob``; ``prob_low`` and
        ``prob_high``, the central interval over normal errors of the log-evidences (50 000 fixed
        draws, so that the same evidences give the same table); ``log_bayes_factor`` (log-evidence
        less that of the first row); ``n_parameters``; ``n_observations``; ``bic`` = -2 max ln
        p(D|phi) + k ln J, missing if J = 0; ``undecided``: the errors leave it open, at level
        `ci_prob`, whether this row or the first is more probable (for the first row: whether any
        other is).

    Raises
    ------
    ModelError
        If an argument is wrong.
    DataMismatchError
        If the models were given different data.

    Examples
    --------
    >>> from pymc_statespace_filters import Evidence, compare_evidence
    >>> linear = Evidence(-41.0, 0.02, "chib_jeliazkov", 2, 100, -35.0, "0c5f")
    >>> cubic = Evidence(-39.0, 0.02, "chib_jeliazkov", 3, 100, -31.0, "0c5f")
    >>> table = compare_evidence({"linear": linear, "cubic": cubic})
    >>> table["prob"].round(3).to_dict()
    {'cubic': 0.881, 'linear': 0.119}
    """
    found = _evidences(evidences)
    if not (isinstance(ci_prob, int | float) and 0 < ci_prob < 1):
        raise ModelError(f"ci_prob must be a number between 0 and 1, got {ci_prob!r}")
    if not (correction is None or isinstance(correction, DimensionCorrection)):
        raise ModelError(f"correction must be a DimensionCorrection or None, got {correction!r}")

    names = list(found)
    log_evidence = np.array([found[name].log_evidence for name in names])
    se = np.array([found[name].se for name in names])
    added = np.array([correction.log_prior(found[name]) if correction else 0.0 for name in names])
    log_weight = log_evidence + added + _log_prior(prior, names)

    prob = np.exp(log_softmax(log_weight))
    low, high = _intervals(log_weight, se, ci_prob)
    best = int(np.argmax(log_weight))
    table = pd.DataFrame(
        {
            "log_evidence": log_evidence,
            "se": se,
            "correction": added,
            "prob": prob,
            "prob_low": np.minimum(low, prob),
            "prob_high": np.maximum(high, prob),
            "log_bayes_factor": log_evidence - log_evidence[best],
            "n_parameters": [found[name].n_parameters for name in names],
            "n_observations": [found[name].n_observations for name in names],
            "bic": [_bic(found[name]) for name in names],
            "undecided": _undecided(log_weight, se, best, ci_prob),
        },
        index=pd.Index(names, name="model"),
    )
    return table.iloc[np.argsort(-log_weight, kind="stable")]


def _evidences(evidences: Mapping[str, Evidence | xr.DataTree]) -> dict[str, Evidence]:
    if not isinstance(evidences, Mapping) or not evidences:
        raise ModelError(
            "evidences must be a mapping of model names to Evidence or DataTree with at least one "
            f"entry, got {evidences!r}"
        )
    found = {}
    for name, given in evidences.items():
        if isinstance(given, xr.DataTree):
            given = stored_evidence(given, name)
        if not isinstance(given, Evidence):
            raise ModelError(
                f"evidences[{name!r}] must be an Evidence or a DataTree, got {given!r}"
            )
        found[name] = given

    by_data: dict[str, list[str]] = {}
    for name, evidence in found.items():
        by_data.setdefault(evidence.data_fingerprint, []).append(name)
    if len(by_data) > 1:
        groups = " | ".join(", ".join(map(repr, names)) for names in by_data.values())
        raise DataMismatchError(
            f"evidences of different data cannot be compared; models that share data: {groups}"
        )
    return found


def _log_prior(prior: Mapping[str, float] | None, names: list[str]) -> Array:
    if prior is None:
        return np.zeros(len(names))
    if not isinstance(prior, Mapping) or set(prior) != set(names):
        raise ModelError(f"prior must give a weight to exactly the models {names}, got {prior!r}")
    weights = np.array([prior[name] for name in names], dtype=np.float64)
    if not (np.isfinite(weights).all() and (weights > 0).all()):
        raise ModelError(f"prior must be positive and finite for every model, got {prior!r}")
    return np.log(weights / weights.sum())


def _intervals(log_weight: Array, se: Array, ci_prob: float) -> tuple[Array, Array]:
    """Central intervals of the probabilities under independent normal errors."""
    normals = np.random.default_rng(0).standard_normal((N_NORMALS, len(se)))
    probs = np.exp(log_softmax(log_weight + se * normals, axis=1))
    low, high = np.quantile(probs, [(1 - ci_prob) / 2, (1 + ci_prob) / 2], axis=0)
    return low, high


def _undecided(log_weight: Array, se: Array, best: int, ci_prob: float) -> NDArray[np.bool_]:
    """Whether the interval of the log-odds against the best model contains zero."""
    behind = log_weight[best] - log_weight
    undecided = behind <= norm.ppf((1 + ci_prob) / 2) * np.hypot(se, se[best])
    undecided[best] = False
    undecided[best] = undecided.any()
    return undecided


def _bic(evidence: Evidence) -> float:
    """Schwarz's criterion; Eq. 3.2 of the thesis prints its penalty twice as large."""
    if evidence.n_observations < 1:
        return math.nan
    penalty = evidence.n_parameters * math.log(evidence.n_observations)
    return -2 * evidence.max_log_likelihood + penalty
