"""Model probabilities from evidences (thesis, 3.1.2)."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, overload

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from scipy.stats import norm

from ...errors import EvidenceWarning, ModelError, warn
from ...former_names import former_names
from ...system.checks import check_ci_prob
from ..evidence import Evidence
from .by_row import compare_rows
from .comparison_sentences import needs_warning, sentences, step_error_columns
from .evidence_table import EvidenceTable
from .selection import EvidenceLike, prior_weights, probabilities, select_evidences

# Kass and Raftery (1995), section 3.2: lower limits of twice the log Bayes factor.
STRENGTHS = {0.0: "barely worth mentioning", 2.0: "positive", 6.0: "strong", 10.0: "very strong"}

Array = NDArray[np.float64]


@overload
def compare_evidence(
    evidences: Mapping[str, EvidenceLike], *, by: Literal["model"] = ..., **settings: Any
) -> EvidenceTable: ...


@overload
def compare_evidence(
    evidences: Mapping[str, EvidenceLike], *, by: Literal["row"], **settings: Any
) -> xr.Dataset: ...


@former_names  # type: ignore[misc]  # overloads name a few arguments
def compare_evidence(
    evidences: Mapping[str, EvidenceLike],
    *,
    by: Literal["model", "row"] = "model",
    model_prior: Mapping[str, float] | None = None,
    ci_prob: float = 0.95,
    estimator: str | None = None,
    step_errors: Mapping[str, pd.DataFrame] | None = None,
) -> EvidenceTable | xr.Dataset:
    """Compare models by their evidences: probabilities, Bayes factors and criteria (Eq. 3.3).

    Parameters
    ----------
    evidences : mapping of str to Evidence, xarray.DataTree, or mapping of str to Evidence
        One entry per model, all of the same data: an `Evidence`, a DataTree with the group
        ``evidence``, or the result of `estimate_evidence`.
    by : {"model", "row"}
        Whether the models are compared once, or after each row of the data, the others with the
        first. "row" takes results of `sample_smc` with ``data="sequential"``, or of `extend`, of at
        least two models of the same rows; it has no `estimator` and no `step_errors`.
    model_prior : mapping of str to float, optional
        Positive prior weight of every model, normalised here; equal by default.
    ci_prob : float
        Probability of the intervals.
    estimator : str, optional
        Estimator whose evidences are compared, such as ``"importance"``, if the models have
        several. By default "bridge"; of a model that has no such estimate, or doubts about it
        alone, the one with the smallest standard error, of those without ``doubts`` if there are
        any. "chib_jeliazkov" is taken where there is no other. Estimates that disagree with the
        one that is taken are a warning about it.
    step_errors : mapping of str to pandas.DataFrame, optional
        Tables of `step_error` by model, for the columns ``step_error`` and ``step_error_se``.

    Returns
    -------
    pandas.DataFrame or xarray.Dataset
        Index ``model``, most probable first. Its display shows the first five columns, and below
        them sentences: which estimator was chosen, what is undecided, how AIC and BIC disagree with
        the evidence, and the reason of each warning. ``table.to_string()`` shows all columns:

        ``prob``, ``prob_low``, ``prob_high``
            Probability, and its central interval under normal errors of the log-evidences (from
            50 000 fixed draws, so that the same evidences give the same table).
        ``log_evidence``, ``se``
            As estimated, without the prior of the model.
        ``log_bayes_factor``
            Log-evidence minus that of the first row.
        ``n_parameters``, ``n_observations``
            k and J.
        ``bic``
            -2 max ln p(D|phi) + k ln J; missing if J = 0.
        ``undecided``
            Whether the errors leave open, at level `ci_prob`, which of this row and the first is
            more probable (for the first row: whether any other is more probable).
        ``aic``
            -2 max ln p(D|phi) + 2 k.
        ``log_evidence_flat``
            The log-evidence with the density of each Uniform prior replaced by one on the same
            support: the thesis's number (Eq. 3.7). It depends on the units of the parameters.
        ``prior``
            Prior weight of the model; ``prob`` is proportional to it.
        ``strength``
            Kass and Raftery's category of the evidence for the first row against this one: "barely
            worth mentioning", "positive", "strong" or "very strong", with limits at 2, 6 and 10 of
            twice the log Bayes factor. The factor is taken at the weaker end of its interval, but
            not below 1, so that the category is conservative. "negative" if the evidence favours
            this row, and only the prior places it below the first. Empty for the first row.
        ``warning``
            Whether the evidence has ``doubts``, other estimates that disagree with it, no standard
            error, an improper prior, or chains that held a noise seed, whose error ``se`` excludes.
        ``max_log_likelihood``
            The largest log-likelihood found, as in `Evidence`.
        ``approximate``
            Whether the likelihood is a filter's approximation, neither exact nor unbiased; missing
            where this is unknown.
        ``step_error``, ``step_error_se``
            With `step_errors`: the change of the log-evidence if the integration step is halved,
            and its standard error; NaN for models that are not named there.

        If an evidence has no standard error (``se`` is NaN), the probabilities
        are those of the estimates, and all intervals are NaN, because each depends on every
        evidence. Comparisons with that model are undecided, and its ``strength`` ignores errors.

        By row, a Dataset along ``model`` and ``row``: ``score_difference``, of
        log p(d_j | d_1 .. d_{j-1}) with the parameters integrated out, and its sum so far,
        ``log_bayes_factor``, each with its standard error ``_se``; ``probability``, with the ends
        ``probability_low`` and ``probability_high`` of its interval. The errors of scores are
        correlated: their sum has the error of the evidence, not that of independent numbers. For
        the sum over other rows see ``score_deviation`` of `sample_smc`.

    Raises
    ------
    ModelError
        If an argument is invalid; if no estimator is chosen and none of several estimates of a
        model has a standard error.
    DataMismatchError
        If the models belong to different data.

    Warns
    -----
    EvidenceWarning
        If priors are improper, so that the probabilities depend on the units of the parameters.

    References
    ----------
    R. E. Kass and A. E. Raftery, Bayes factors. Journal of the American Statistical Association
    90 (1995), 773-795.

    Examples
    --------
    >>> from pymc_statespace_filters import compare_evidence
    >>> from pymc_statespace_filters.evidence import Evidence
    >>> linear = Evidence(-41.0, 0.02, "chib_jeliazkov", 2, 100, -35.0, "0c5f")
    >>> cubic = Evidence(-39.0, 0.02, "chib_jeliazkov", 3, 100, -31.0, "0c5f")
    >>> table = compare_evidence({"linear": linear, "cubic": cubic})
    >>> table["prob"].round(3).to_dict()
    {'cubic': 0.881, 'linear': 0.119}
    >>> table.loc["linear", "strength"]
    'positive'
    >>> table
            prob prob_low prob_high log_evidence     se
    model
    cubic  0.881    0.875     0.887      -39.000  0.020
    linear 0.119    0.113     0.125      -41.000  0.020
    Further columns, shown by .to_string(): log_bayes_factor, n_parameters,
      n_observations, bic, undecided, aic, log_evidence_flat, prior, strength,
      warning, max_log_likelihood, approximate.
    """
    if by not in ("model", "row"):
        raise ModelError(f"by must be 'model' or 'row', got {by!r}")
    check_ci_prob(ci_prob)
    if by == "row":
        if estimator is not None or step_errors is not None:
            raise ModelError("estimator and step_errors must be None by row")
        return compare_rows(evidences, model_prior, ci_prob)
    found, how_chosen = select_evidences(evidences, estimator)
    weights = prior_weights(model_prior, list(found))
    _warn_of_improper(found)
    table = _columns(found, weights, ci_prob)
    if step_errors is not None:
        table = table.join(step_error_columns(step_errors, list(found)))
    in_order = {name: found[name] for name in table.index}
    said = [how_chosen] if how_chosen else []
    return EvidenceTable(table, sentences=[*said, *sentences(table, in_order, ci_prob)])


def _columns(found: Mapping[str, Evidence], weights: Array, ci_prob: float) -> pd.DataFrame:
    """All columns, most probable model first, for prior weights of the models."""
    models = list(found.values())
    log_evidence = np.array([one.log_evidence for one in models])
    se = np.array([one.se for one in models])
    log_weight = log_evidence + np.log(weights)
    probs = probabilities(log_weight, se, ci_prob)
    best = int(np.argmax(log_weight))
    error = norm.ppf((1 + ci_prob) / 2) * np.hypot(se, se[best])  # of a difference from the best
    log_bayes_factor = log_evidence - log_evidence[best]
    table = pd.DataFrame(
        {
            "prob": probs.prob,
            "prob_low": probs.low,
            "prob_high": probs.high,
            "log_evidence": log_evidence,
            "se": se,
            "log_bayes_factor": log_bayes_factor,
            "n_parameters": [one.n_parameters for one in models],
            "n_observations": [one.n_observations for one in models],
            "bic": [_bic(one) for one in models],
            "undecided": _undecided(log_weight[best] - log_weight, error, best),
            "aic": [2 * (one.n_parameters - one.max_log_likelihood) for one in models],
            "log_evidence_flat": [one.log_evidence + one.log_volume for one in models],
            "prior": weights,
            "strength": _strength(-log_bayes_factor, error, best),
            "warning": [needs_warning(one) for one in models],
            "max_log_likelihood": [one.max_log_likelihood for one in models],
            "approximate": _approximate(models),
        },
        index=pd.Index(found, name="model"),
    )
    return table.iloc[np.argsort(-log_weight, kind="stable")]


def _approximate(models: Sequence[Evidence]) -> pd.api.extensions.ExtensionArray | list[bool]:
    """Whether each likelihood is an approximation; missing where it is unknown."""
    known = [one.approximate for one in models if one.approximate is not None]
    if len(known) == len(models):
        return known
    return pd.array([one.approximate for one in models], dtype="boolean")


def _warn_of_improper(found: Mapping[str, Evidence]) -> None:
    improper = [f"{name!r} ({one.improper})" for name, one in found.items() if one.improper]
    if improper:
        warn(
            f"improper or unnormalised priors in {', '.join(improper)}: the model probabilities "
            "depend on the units of these parameters; give them proper priors",
            EvidenceWarning,
        )


def _undecided(behind: Array, error: Array, best: int) -> NDArray[np.bool_]:
    """Whether the interval of the log-odds against the best model contains zero, or is unknown."""
    undecided = ~(behind > error)
    undecided[best] = False
    undecided[best] = undecided.any()
    return undecided


def _strength(log_bayes_factor: Array, error: Array, best: int) -> list[str]:
    """Category of the evidence for the best model against each."""
    weaker_end = np.maximum(log_bayes_factor - np.nan_to_num(error), 0)
    category = np.searchsorted(list(STRENGTHS), 2 * weaker_end, side="right") - 1
    words = [list(STRENGTHS.values())[i] for i in category]
    return [
        "" if i == best else "negative" if log_bayes_factor[i] < 0 else word
        for i, word in enumerate(words)
    ]


def _bic(evidence: Evidence) -> float:
    """Schwarz's criterion; in Eq. 3.2 of the thesis the penalty is twice as large."""
    if evidence.n_observations < 1:
        return math.nan
    penalty = evidence.n_parameters * math.log(evidence.n_observations)
    return -2 * evidence.max_log_likelihood + penalty
