"""Sensitivity of model probabilities to the correction's exponent and the priors' width.

The model probabilities of the thesis depend strongly on its correction for the number of parameters
(after Eq. 3.7), and on the priors. These curves show both.
"""

import warnings
from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd
import pymc as pm
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from ...errors import EvidenceWarning, ModelError
from ...pymc_model.posterior_draws import unconstrained_draws
from .compare import DimensionCorrection, compare_evidence
from .scaled_prior import ReweightedEvidence, WidthCurves, width_curves
from .selection import EvidenceLike, check_ci_prob, prior_weights, probabilities

EXPONENTS = np.linspace(0, 4, 41)
WIDTHS = np.geomspace(0.25, 4, 17)
REQUIRED_COLUMNS = ("log_evidence", "se", "n_parameters", "n_observations", "prior")

Array = NDArray[np.float64]


def prior_sensitivity(
    evidences: Mapping[str, EvidenceLike] | pd.DataFrame,
    *,
    exponents: ArrayLike | None = None,
    models: Mapping[str, pm.Model] | None = None,
    widths: ArrayLike | None = None,
    var_names: str | Iterable[str] | None = None,
    prior: Mapping[str, float] | None = None,
    ci_prob: float = 0.95,
    estimator: str | None = None,
) -> xr.Dataset:
    r"""Compute model probabilities as functions of the correction's exponent and the priors' width.

    The width of priors is varied by reweighting the draws, without new likelihood evaluations. A
    prior p scaled by the factor w becomes :math:`p_w(\phi) = p(c + (\phi - c)/w)/w`, and the
    evidence :math:`Z_w = Z\, E[p_w(\phi)/p(\phi)]`, where the mean is over the posterior. The
    centre c is zero if the support begins or ends at zero (scales, most Uniform priors of a
    stiffness), the end of any other half-line, and otherwise PyMC's support point (usually the
    mean). A prior that depends on other variables is scaled conditionally on them.

    Parameters
    ----------
    evidences : mapping as for `compare_evidence`, or its table
        For widths, a mapping of DataTrees with the posterior draws and the group ``evidence``. Of a
        table, the evidences and the column ``prior`` are used, not the correction.
    exponents : array_like of float, optional
        Values of alpha in `DimensionCorrection`, one-dimensional; 0 (no correction) to 4 by
        default.
    models : mapping of str to pymc.Model, optional
        The model of each DataTree, required to vary the width.
    widths : array_like of float, optional
        Positive factors w, one-dimensional; 0.25 to 4 by default.
    var_names : str or iterable of str, optional
        The free variables whose priors are scaled, in the models that have them. By default all,
        except those that alone would leave half of the widths or more unknown.
    prior, ci_prob, estimator
        As for `compare_evidence`.

    Returns
    -------
    xarray.Dataset
        ``prob``, ``prob_low`` and ``prob_high``, dims (model, exponent). With `models` also, with
        dims (model, width) and without correction: ``width_prob``, ``width_prob_low``,
        ``width_prob_high``; ``width_log_evidence`` and its standard error ``width_se``, which
        includes that of the reweighting; and the diagnostics ``width_n_effective`` (effective
        number of draws after reweighting), ``width_pareto_k`` (tail of the weights) and
        ``width_beyond`` (below).

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
        a probability, an angle, a simplex or a covariance.
    DataMismatchError
        If the models belong to different data, or the draws to another model.

    Warns
    -----
    EvidenceWarning
        If a prior is left out.

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> from pymc_statespace_filters.evidence import Evidence
    >>> linear = Evidence(-41.0, 0.02, "bridge", 2, 100, -35.0, "0c5f")
    >>> cubic = Evidence(-39.0, 0.02, "bridge", 3, 100, -31.0, "0c5f")
    >>> curves = psf.prior_sensitivity({"linear": linear, "cubic": cubic}, exponents=[0, 1, 3])
    >>> curves["prob"].sel(model="cubic").values.round(3)
    array([0.881, 0.425, 0.007])

    One mean, with the prior scaled to twice its width; the exact log-evidence is then -5.27:

    >>> import arviz as az
    >>> import numpy as np
    >>> import pymc as pm
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
    table = _table(evidences, prior, estimator)
    alphas, factors = _grid("exponents", exponents, EXPONENTS), _grid("widths", widths, WIDTHS)
    if not (factors > 0).all():
        raise ModelError(f"widths must be positive, got {widths!r}")
    if models is None and not (widths is None and var_names is None):
        raise ModelError(
            "models must be given with widths or var_names: the pm.Model of each idata"
        )
    names = list(table.index)
    curves = models and _width_curves(evidences, models, names, var_names, factors)
    found = _over_exponents(table, alphas, ci_prob)
    if not curves:
        return found.assign_attrs(ci_prob=ci_prob)
    if curves.left_out:
        warnings.warn(curves.note, EvidenceWarning, stacklevel=2)
    return found.merge(_over_widths(table, curves.points, factors, ci_prob)).assign_attrs(
        ci_prob=ci_prob,
        width_left_out=curves.left_out,
        width_unknown=curves.unknown,
        width_note=curves.note,
    )


def _over_exponents(table: pd.DataFrame, exponents: Array, ci_prob: float) -> xr.Dataset:
    corrections = [DimensionCorrection(exponent) for exponent in exponents.tolist()]
    added = [[c.log_prior(row) for c in corrections] for row in table.itertuples()]
    log_evidence = table["log_evidence"].to_numpy()[:, np.newaxis] + np.array(added)
    se = np.repeat(table["se"].to_numpy()[:, np.newaxis], len(exponents), axis=1)
    return _curves("exponent", exponents, table, log_evidence, se, ci_prob)


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
    curves = _curves("width", widths, table, log_evidence, se, ci_prob)
    fields = {
        "log_evidence": log_evidence,
        "se": se,
        "n_effective": n_effective,
        "pareto_k": pareto_k,
        "beyond": beyond,
    }
    curves = curves.assign({name: (("model", "width"), field) for name, field in fields.items()})
    return curves.rename({name: f"width_{name}" for name in curves.data_vars})


def _curves(
    dim: str, points: Array, table: pd.DataFrame, log_evidence: Array, se: Array, ci_prob: float
) -> xr.Dataset:
    """Probabilities and intervals for log-evidences and errors (model, point)."""
    log_weight = log_evidence + np.log(table["prior"].to_numpy())[:, np.newaxis]
    of_points = [
        probabilities(weights, errors, ci_prob)
        for weights, errors in zip(log_weight.T, se.T, strict=True)
    ]
    prob, low, high = np.moveaxis(np.array(of_points), 0, -1)
    dims = ("model", dim)
    return xr.Dataset(
        {"prob": (dims, prob), "prob_low": (dims, low), "prob_high": (dims, high)},
        coords={"model": list(table.index), dim: points},
    )


def _grid(name: str, given: ArrayLike | None, default: Array) -> Array:
    if given is None:
        return default
    try:
        grid = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        grid = np.empty(0)
    if grid.ndim != 1 or grid.size == 0 or not np.isfinite(grid).all():
        raise ModelError(f"{name} must be one-dimensional finite numbers, got {given!r}")
    return grid


def _table(
    evidences: Mapping[str, EvidenceLike] | pd.DataFrame,
    prior: Mapping[str, float] | None,
    estimator: str | None,
) -> pd.DataFrame:
    """The table of `compare_evidence`, with the models in the given order."""
    if not isinstance(evidences, pd.DataFrame):
        return compare_evidence(evidences, prior=prior, estimator=estimator).loc[list(evidences)]
    if missing := [column for column in REQUIRED_COLUMNS if column not in evidences]:
        raise ModelError(
            f"evidences must be a table of compare_evidence, got one without the columns {missing}"
        )
    if estimator is not None:
        raise ModelError(f"estimator must not be given with a table, got {estimator!r}")
    if prior is None:
        return evidences
    return evidences.assign(prior=prior_weights(prior, list(evidences.index)))


def _width_curves(
    evidences: Mapping[str, EvidenceLike] | pd.DataFrame,
    models: Mapping[str, pm.Model],
    names: list[str],
    var_names: str | Iterable[str] | None,
    widths: Array,
) -> WidthCurves:
    """For each model, the evidence under its scaled priors."""
    if not (
        isinstance(models, Mapping)
        and set(models) == set(names)
        and all(isinstance(model, pm.Model) for model in models.values())
    ):
        raise ModelError(f"models must map exactly the names {names} to pm.Model, got {models!r}")
    given = {} if isinstance(evidences, pd.DataFrame) else evidences
    idatas = {name: one for name, one in given.items() if isinstance(one, xr.DataTree)}
    if without := [name for name in names if name not in idatas]:
        raise ModelError(
            f"evidences must be DataTrees with draws to vary widths, got none of {without}"
        )
    free = {name: [rv.name for rv in models[name].free_RVs] for name in names}
    chosen = [var_names] if isinstance(var_names, str) else list(var_names or [])
    if unknown := [one for one in chosen if not any(one in of_model for of_model in free.values())]:
        raise ModelError(f"var_names must be free variables of the models, {free}, got {unknown}")
    for name in names:  # check that draws and model match
        unconstrained_draws(idatas[name], models[name])
    return width_curves(
        models,
        {name: idatas[name]["posterior"].to_dataset() for name in names},
        {name: [one for one in free[name] if not chosen or one in chosen] for name in names},
        widths.tolist(),
        may_leave_out=not chosen,
    )
