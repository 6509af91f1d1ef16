"""Sensitivity of model probabilities to the width of the priors."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import ArrayLike

from ...errors import EvidenceWarning, ModelError, warn
from ...pymc_model.posterior_draws import check_one_model, unconstrained_draws
from ...system.checks import check_ci_prob
from .compare import compare_evidence
from .scaled_prior import ReweightedEvidence, ScaledPrior
from .selection import EvidenceLike
from .width_curves import curves_of_models, dataset_of_curves, width_factors

MOSTLY = 0.5  # fraction of the widths other than 1 from which a curve is mostly unknown


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
    idatas, priors = _draws_and_priors(evidences, models, var_names)
    found = _width_curves(idatas, priors, factors.tolist(), may_leave_out=not var_names)
    if found.left_out:
        warn(found.note, EvidenceWarning)
    log_evidence, se, prior = (table[name].to_numpy() for name in ("log_evidence", "se", "prior"))
    return dataset_of_curves(
        curves_of_models(log_evidence, se, np.log(prior), list(found.points.values()), ci_prob),
        priors,
        factors,
        ci_prob=ci_prob,
        left_out=found.left_out,
        unknown=found.unknown,
        width_note=found.note,
    )


def _draws_and_priors(
    evidences: Mapping[str, EvidenceLike],
    models: Mapping[str, pm.Model],
    var_names: str | Iterable[str] | None,
) -> tuple[dict[str, xr.DataTree], dict[str, ScaledPrior]]:
    """The draws of each model, and the priors that are scaled."""
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
    return idatas, {
        name: ScaledPrior(models[name], [one for one in free[name] if not chosen or one in chosen])
        for name in names
    }


class _WidthCurves(NamedTuple):
    """The curves of all models, and what is said of them: see `prior_sensitivity`."""

    points: dict[str, list[ReweightedEvidence]]
    left_out: str
    unknown: str
    note: str


def _width_curves(
    idatas: Mapping[str, xr.DataTree],
    priors: Mapping[str, ScaledPrior],
    widths: Sequence[float],
    *,
    may_leave_out: bool,
) -> _WidthCurves:
    """Reweight the draws of each model to every width of its priors.

    One parameter that the data leave undetermined, or whose posterior reaches the end of its prior,
    makes the evidence unknown under almost every width, although the other priors could be varied.
    If ``may_leave_out``, priors that do so in one model keep their width in all models, because a
    parameter that models share is to have the same prior in them.
    """
    points = {name: one.curve(idatas[name], widths) for name, one in priors.items()}
    spoiling = {
        name: _spoiling(idatas[name], priors[name], widths)
        for name, curve in points.items()
        if _is_mostly_unknown(curve, widths)
    }
    blamed = list(dict.fromkeys(prior for of_model in spoiling.values() for prior in of_model))
    rest = {name: [p for p in one.names if p not in blamed] for name, one in priors.items()}
    leaves_out = may_leave_out and bool(blamed) and any(rest.values())
    became = "keeps its width" if leaves_out else "leaves most widths unknown"
    notes = [f"The prior of {prior} {became}: {_reasons(spoiling, prior)}." for prior in blamed]
    unknown = [] if leaves_out else list(blamed)
    if leaves_out:
        points = {name: one.curve(idatas[name], widths, rest[name]) for name, one in priors.items()}
    for name, curve in points.items():
        if _is_mostly_unknown(curve, widths) and (leaves_out or not spoiling[name]):
            unknown.append(f"several parameters of {name!r} together")
            notes.append(
                f"The draws of {name!r} do not determine the evidence when its priors are scaled "
                "together: name fewer of them in var_names."
            )
    left_out = ", ".join(blamed if leaves_out else [])
    return _WidthCurves(points, left_out, ", ".join(unknown), " ".join(notes))


def _spoiling(idata: xr.DataTree, priors: ScaledPrior, widths: Sequence[float]) -> dict[str, str]:
    """The priors that are unknown at most widths if they alone are scaled, with the reasons."""
    alone = {name: priors.curve(idata, widths, [name]) for name in priors.names}
    return {
        name: Counter(one.reason for one in curve if not one.is_reliable).most_common(1)[0][0]
        for name, curve in alone.items()
        if _is_mostly_unknown(curve, widths)
    }


def _is_mostly_unknown(points: Sequence[ReweightedEvidence], widths: Sequence[float]) -> bool:
    others = [one for one, width in zip(points, widths, strict=True) if width != 1]
    unknown = sum(not one.is_reliable for one in others)
    return bool(others) and unknown >= MOSTLY * len(others)


def _reasons(spoiling: Mapping[str, Mapping[str, str]], prior: str) -> str:
    """Why a prior spoils curves, and those of which models."""
    models: dict[str, list[str]] = {}
    for name, of_model in spoiling.items():
        if prior in of_model:
            models.setdefault(of_model[prior], []).append(repr(name))
    return "; ".join(f"in {', '.join(names)} {why}" for why, names in models.items())
