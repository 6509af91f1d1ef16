"""The evidence of models over the width of their priors, and the priors that spoil the curves.

One parameter that the data leave undetermined, or whose posterior reaches the end of its prior,
makes the evidence unknown under almost every width, although the other priors could be varied.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import pymc as pm
import xarray as xr

from ...importance import MIN_EFFECTIVE
from .scaled_prior import MAX_BEYOND, MAX_PARETO_K, UNCHANGED, ReweightedEvidence, ScaledPrior

MOSTLY = 0.5  # fraction of the widths other than 1 from which a curve is mostly unknown


class WidthCurve(NamedTuple):
    """The reweighted evidence of a model at every width.

    ``spoiling`` are the priors that alone are unknown at most widths, each with the reason, and
    ``is_unknown`` is whether most of the curve is.
    """

    points: list[ReweightedEvidence]
    spoiling: dict[str, str]
    is_unknown: bool


class WidthCurves(NamedTuple):
    """The curves of all models, and what is said of them: see `prior_sensitivity`."""

    points: dict[str, list[ReweightedEvidence]]
    left_out: str
    unknown: str
    note: str


def width_curves(
    models: Mapping[str, pm.Model],
    posteriors: Mapping[str, xr.Dataset],
    scaled: Mapping[str, Sequence[str]],
    widths: Sequence[float],
    *,
    may_leave_out: bool,
) -> WidthCurves:
    """Reweight the draws of each model to every width of the priors of its variables ``scaled``.

    If ``may_leave_out``, priors that spoil the curve of one model keep their width in all models,
    because a parameter that models share is to have the same prior in them.
    """

    def curves(names: Mapping[str, Sequence[str]]) -> dict[str, WidthCurve]:
        return {
            name: _width_curve(model, posteriors[name], names[name], widths)
            for name, model in models.items()
        }

    found = curves(scaled)
    spoiling = list(dict.fromkeys(prior for curve in found.values() for prior in curve.spoiling))
    rest = {name: [one for one in given if one not in spoiling] for name, given in scaled.items()}
    leaves_out = may_leave_out and bool(spoiling) and any(rest.values())
    became = "keeps its width" if leaves_out else "leaves most widths unknown"
    notes = [f"The prior of {prior} {became}: {_reasons(found, prior)}." for prior in spoiling]
    unknown = [] if leaves_out else list(spoiling)
    if leaves_out:
        found = curves(rest)
    for name, curve in found.items():
        if curve.is_unknown and not curve.spoiling:
            unknown.append(f"several parameters of {name!r} together")
            notes.append(
                f"The draws of {name!r} do not determine the evidence when its priors are scaled "
                "together: name fewer of them in var_names."
            )
    return WidthCurves(
        {name: curve.points for name, curve in found.items()},
        ", ".join(spoiling if leaves_out else []),
        ", ".join(unknown),
        " ".join(notes),
    )


def _reasons(curves: Mapping[str, WidthCurve], prior: str) -> str:
    """Why a prior spoils curves, and those of which models."""
    models: dict[str, list[str]] = {}
    for name, curve in curves.items():
        if prior in curve.spoiling:
            models.setdefault(curve.spoiling[prior], []).append(repr(name))
    return "; ".join(f"in {', '.join(names)} {why}" for why, names in models.items())


def _width_curve(
    model: pm.Model, posterior: xr.Dataset, names: Sequence[str], widths: Sequence[float]
) -> WidthCurve:
    """One model; if most is unknown, the priors are varied one by one to find those to blame."""

    def curve(scaled: Sequence[str]) -> list[ReweightedEvidence]:
        if not scaled:
            return [UNCHANGED] * len(widths)
        priors = ScaledPrior(model, scaled)
        return [priors.reweighted(posterior, width) for width in widths]

    points = curve(names)
    if not _is_mostly_unknown(points, widths):
        return WidthCurve(points, {}, is_unknown=False)
    alone = {name: curve([name]) for name in names} if len(names) > 1 else {names[0]: points}
    unknown = {name: one for name, one in alone.items() if _is_mostly_unknown(one, widths)}
    return WidthCurve(points, {name: _reason(one) for name, one in unknown.items()}, True)


def _is_mostly_unknown(points: Sequence[ReweightedEvidence], widths: Sequence[float]) -> bool:
    others = [one for one, width in zip(points, widths, strict=True) if width != 1]
    unknown = sum(not one.is_reliable for one in others)
    return bool(others) and unknown >= MOSTLY * len(others)


def _reason(points: Sequence[ReweightedEvidence]) -> str:
    """The most frequent reason why a reweighted evidence is unknown."""
    reasons = Counter(_reason_of(one) for one in points if not one.is_reliable)
    return reasons.most_common(1)[0][0]


def _reason_of(point: ReweightedEvidence) -> str:
    if point.beyond > MAX_BEYOND:
        return "the posterior reaches the end of the support, and no draws lie beyond it"
    if point.pareto_k > MAX_PARETO_K:
        return "the posterior is nearly as wide as the prior"
    return f"fewer than {MIN_EFFECTIVE:g} effective draws lie under a scaled prior"
