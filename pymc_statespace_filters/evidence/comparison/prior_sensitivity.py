"""Sensitivity of model probabilities to the width of the priors."""

import warnings
from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from ...errors import EvidenceWarning, ModelError
from ...former_names import former_names
from ...pymc_model.posterior_draws import check_one_model, unconstrained_draws
from .compare import compare_evidence
from .scaled_prior import ReweightedEvidence, WidthCurves, width_curves
from .selection import EvidenceLike, check_ci_prob, probabilities

WIDTHS = np.geomspace(0.25, 4, 17)

Array = NDArray[np.float64]


@former_names(
    prior="give model_prior=",
    exponents="give compare_evidence a model_prior for each exponent",
)
def prior_sensitivity(
    evidences: Mapping[str, EvidenceLike],
    *,
    models: Mapping[str, pm.Model],
    widths: ArrayLike | None = None,
    var_names: str | Iterable[str] | None = None,
    model_prior: Mapping[str, float] | None = None,
    ci_prob: float = 0.95,
    estimator: str | None = None,
) -> xr.Dataset:
    r"""Compute model probabilities as functions of the width of the priors.

    The width is varied by reweighting the draws, without new likelihood evaluations. A
    prior p scaled by the factor w becomes :math:`p_w(\phi) = p(c + (\phi - c)/w)/w`, and the
    evidence :math:`Z_w = Z\, E[p_w(\phi)/p(\phi)]`, where the mean is over the posterior. The
    centre c is zero if the support begins or ends at zero (scales, most Uniform priors of a
    stiffness), the end of any other half-line, and otherwise PyMC's support point (usually the
    mean). A prior that depends on other variables is scaled conditionally on them.

    Parameters
    ----------
    evidences : mapping of str to xarray.DataTree
        Posterior draws of each model, with the group ``evidence``.
    models : mapping of str to pymc.Model
        The model of each DataTree.
    widths : array_like of float, optional
        Positive factors w, one-dimensional; 0.25 to 4 by default.
    var_names : str or iterable of str, optional
        The free variables whose priors are scaled, in the models that have them. By default all,
        except those that alone would leave half of the widths or more unknown.
    model_prior, ci_prob, estimator
        As for `compare_evidence`.

    Returns
    -------
    xarray.Dataset
        With dims (model, width): ``width_prob``, ``width_prob_low``, ``width_prob_high``;
        ``width_log_evidence`` and its standard error ``width_se``, which includes that of the
        reweighting; and the diagnostics ``width_n_effective`` (effective number of draws after
        reweighting), ``width_pareto_k`` (tail of the weights) and ``width_beyond`` (below).

        Values are NaN where the reweighting is unreliable: if the effective number of draws is
        below 100, if the Pareto shape k is above 0.5 (the posterior is nearly as wide as the prior,
        and the mean of the weights has no standard error), or if more than 2 per cent of the
        evidence may lie outside the bounds of the original prior, where there are no draws.
        ``width_beyond`` is an upper bound of that part, from the draws in the outermost 5 per cent
        of a bounded support, provided that likelihood and prior do not increase outwards from
        there. Where one evidence is NaN, the probabilities of all models are.

        The attribute ``width_left_out`` names the priors that keep their width, in all models,
        because the draws of one do not determine the evidence under another width.
        ``width_unknown`` names those that leave most widths unknown although they are scaled,
        because `var_names` asks for it or there are no others. ``width_note`` gives the reasons.

    Raises
    ------
    ModelError
        If an argument is invalid, or a prior cannot be scaled: it is improper, or the variable is
        a probability, an angle, a simplex or a covariance; or if draws are those of
        `select_terms`.
    DataMismatchError
        If the models belong to different data, or the draws to another model.

    Warns
    -----
    EvidenceWarning
        If a prior is left out.

    Examples
    --------
    One mean, with the prior scaled to twice its width; the exact log-evidence is then -5.27:

    >>> import arviz as az
    >>> import numpy as np
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> normals = np.random.default_rng(1).standard_normal((4, 1000))
    >>> idata = az.from_dict({"posterior": {"mu": 4 / 13 + normals / np.sqrt(3.25)}})
    >>> with pm.Model() as model:
    ...     mu = pm.Normal("mu", 0, 2)
    ...     _ = pm.Normal("y", mu, 1, observed=[0.3, -0.4, 1.1])
    ...     _ = psf.chib_jeliazkov(idata, random_seed=2)
    >>> curves = psf.prior_sensitivity({"mean": idata}, models={"mean": model}, widths=[1, 2])
    >>> curves["width_log_evidence"].sel(model="mean").values.round(1)
    array([-4.6, -5.3])
    """
    check_ci_prob(ci_prob)
    table = compare_evidence(evidences, model_prior=model_prior, estimator=estimator)
    table = table.loc[list(evidences)]
    factors = width_factors(widths)
    curves = _width_curves(evidences, models, var_names, factors)
    if curves.left_out:
        warnings.warn(curves.note, EvidenceWarning, stacklevel=3)
    return _over_widths(table, curves.points, factors, ci_prob).assign_attrs(
        ci_prob=ci_prob,
        width_left_out=curves.left_out,
        width_unknown=curves.unknown,
        width_note=curves.note,
    )


def _over_widths(
    table: pd.DataFrame,
    of_models: Mapping[str, list[ReweightedEvidence]],
    widths: Array,
    ci_prob: float,
) -> xr.Dataset:
    found = [of_models[name] for name in table.index]
    known = np.array([[one.is_reliable for one in of_model] for of_model in found])
    ratio, error, n_effective, pareto_k, beyond = np.moveaxis(np.array(found), -1, 0)
    log_evidence = np.where(known, table["log_evidence"].to_numpy()[:, np.newaxis] + ratio, np.nan)
    se = np.where(known, np.hypot(table["se"].to_numpy()[:, np.newaxis], error), np.nan)
    log_weight = log_evidence + np.log(table["prior"].to_numpy())[:, np.newaxis]
    of_widths = [
        probabilities(weights, errors, ci_prob)
        for weights, errors in zip(log_weight.T, se.T, strict=True)
    ]
    prob, low, high = np.moveaxis(np.array(of_widths), 0, -1)
    fields = {
        "prob": prob,
        "prob_low": low,
        "prob_high": high,
        "log_evidence": log_evidence,
        "se": se,
        "n_effective": n_effective,
        "pareto_k": pareto_k,
        "beyond": beyond,
    }
    return xr.Dataset(
        {f"width_{name}": (("model", "width"), field) for name, field in fields.items()},
        coords={"model": list(table.index), "width": widths},
    )


def width_factors(widths: ArrayLike | None) -> Array:
    """Check the widths of priors; by default those of `WIDTHS`."""
    if widths is None:
        return WIDTHS
    try:
        factors = np.asarray(widths, dtype=np.float64)
    except (TypeError, ValueError):
        factors = np.empty(0)
    if factors.ndim != 1 or factors.size == 0 or not np.isfinite(factors).all():
        raise ModelError(f"widths must be one-dimensional finite numbers, got {widths!r}")
    if not (factors > 0).all():
        raise ModelError(f"widths must be positive, got {widths!r}")
    return factors


def _width_curves(
    evidences: Mapping[str, EvidenceLike],
    models: Mapping[str, pm.Model],
    var_names: str | Iterable[str] | None,
    widths: Array,
) -> WidthCurves:
    """For each model, the evidence under its scaled priors."""
    names = list(evidences)
    if not (
        isinstance(models, Mapping)
        and set(models) == set(names)
        and all(isinstance(model, pm.Model) for model in models.values())
    ):
        raise ModelError(f"models must map exactly the names {names} to pm.Model, got {models!r}")
    idatas = {name: one for name, one in evidences.items() if isinstance(one, xr.DataTree)}
    if without := [name for name in names if name not in idatas]:
        raise ModelError(f"evidences must be DataTrees with draws, got none of {without}")
    free = {name: [rv.name for rv in models[name].free_RVs] for name in names}
    chosen = [var_names] if isinstance(var_names, str) else list(var_names or [])
    if unknown := [one for one in chosen if not any(one in of_model for of_model in free.values())]:
        raise ModelError(f"var_names must be free variables of the models, {free}, got {unknown}")
    for name in names:  # check that draws and model match
        check_one_model(idatas[name], models[name])
        unconstrained_draws(idatas[name], models[name])
    return width_curves(
        models,
        {name: idatas[name] for name in names},
        {name: [one for one in free[name] if not chosen or one in chosen] for name in names},
        widths.tolist(),
        may_leave_out=not chosen,
    )
