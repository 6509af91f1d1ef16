"""Which of several estimates of one evidence is taken, and whether the others agree with it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.stats import chi2

from .evidence import Evidence

# One false alarm in a thousand sets of estimates; none for differences too small to matter.
LEVEL = 0.001
NEGLIGIBLE = 0.05  # nats
_SMALLEST_ERROR = 1e-6  # avoids division by zero: an estimate may be exact

# Bridge sampling uses all draws at once, Chib and Jeliazkov's ordinate those near one point.
ESTIMATE, CHECK = "bridge", "chib_jeliazkov"


@dataclass(frozen=True)
class Agreement:
    """Agreement of several estimates of one evidence; true if they agree.

    Attributes
    ----------
    p_value : float
        Of Cochran's chi-square test of homogeneity, which treats the estimates as independent.
        Estimates from the same draws have correlated errors: they differ by less than independent
        ones, and the test is conservative. An error that they have in common is part of the
        standard error of each, and no difference shows it. 1 if fewer than two estimates have a
        standard error.
    difference : float
        Largest minus smallest estimate, in nats.
    diagnosis : str
        The likely cause of a disagreement and its remedy; empty if the estimates agree.
    """

    p_value: float
    difference: float
    diagnosis: str

    def __bool__(self) -> bool:
        return not self.diagnosis


def chosen_estimator(evidences: Mapping[str, Evidence]) -> str:
    """The estimator whose estimate is taken; the others check it.

    That is "bridge", unless it has no standard error, or doubts that another estimator has not;
    "chib_jeliazkov" only where there is no other.
    """

    def uncertainty(name: str) -> tuple[bool, bool, bool, bool, float]:
        one = evidences[name]
        return math.isnan(one.se), name == CHECK, bool(one.doubts), name != ESTIMATE, one.se

    return min(evidences, key=uncertainty)


def assess_agreement(evidences: Mapping[str, Evidence]) -> Agreement:
    """Compare estimates of one evidence; those without a standard error are ignored."""
    compared = {name: e for name, e in evidences.items() if np.isfinite(e.se)}
    if len(compared) < 2:
        return Agreement(1.0, 0.0, "")
    values = np.array([e.log_evidence for e in compared.values()])
    weights = 1 / np.maximum([e.se for e in compared.values()], _SMALLEST_ERROR) ** 2
    mean = np.average(values, weights=weights)
    p_value = float(chi2.sf((weights * (values - mean) ** 2).sum(), len(values) - 1))
    difference = float(np.ptp(values))
    agree = p_value >= LEVEL or difference <= NEGLIGIBLE
    return Agreement(p_value, difference, "" if agree else _diagnose(compared))


def _diagnose(evidences: Mapping[str, Evidence]) -> str:
    """State the likely cause, judged from the pair furthest apart in units of its error."""
    low, high = max(combinations(evidences.values(), 2), key=_distance)
    if low.log_evidence > high.log_evidence:
        low, high = high, low
    gap = f"{high.estimator} is {high.log_evidence - low.log_evidence:.2f} above {low.estimator}"
    cause = _doubtful(low, high) or (
        "the draws are too few, or the posterior is far from the shape that the estimators fit to "
        "it (several modes, heavy tails): draw more, and compare with the evidence of sample_smc, "
        "which starts from the prior; a narrow mode that both have missed remains unknown"
    )
    return f"{gap}; {cause}"


def _doubtful(*pair: Evidence) -> str:
    """That the error of one of two estimates is in doubt, first of all that of the check."""
    check, other = sorted(pair, key=lambda one: one.estimator != CHECK)
    for one, doubts_of_other in ((check, other.doubts), (other, check.doubts)):
        if own := [doubt for doubt in one.doubts.split("; ") if doubt not in doubts_of_other]:
            return f"the error of {one.estimator} is in doubt: {'; '.join(own)}"
    return ""


def _distance(pair: tuple[Evidence, Evidence]) -> float:
    one, other = pair
    return abs(one.log_evidence - other.log_evidence) / float(np.hypot(one.se, other.se))
