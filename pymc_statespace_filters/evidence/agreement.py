"""Whether several estimates of one evidence agree, and what it means if they do not."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.stats import chi2

from pymc_statespace_filters.evidence.evidence import Evidence

# One false alarm in a thousand sets of estimates, and none over what no choice depends on.
LEVEL = 0.001
NEGLIGIBLE = 0.05  # nats
_SMALLEST_ERROR = 1e-6  # an estimate may be exact

FROM_PRIOR = ("prior_monte_carlo", "tempered_smc")


@dataclass(frozen=True)
class Agreement:
    """What several estimates of one evidence say of each other.

    Attributes
    ----------
    p_value : float
        Of estimates as far apart as these, if their errors are what they say: Cochran's chi-square
        test of homogeneity, as if they were independent. Estimates from the same draws err
        together, so that they would be nearer to each other. 1 if fewer than two have an error.
    difference : float
        Between the largest and the smallest estimate, in nats.
    reading : str
        The likely cause and what to do, empty if they agree.
    """

    p_value: float
    difference: float
    reading: str

    def __bool__(self) -> bool:
        return not self.reading


def agreement_of(evidences: Mapping[str, Evidence]) -> Agreement:
    """Compare estimates of one evidence; those without an error take no part.

    Parameters
    ----------
    evidences : mapping of str to Evidence
        By the name of the estimator.

    Returns
    -------
    Agreement
    """
    judged = {name: e for name, e in evidences.items() if np.isfinite(e.se)}
    if len(judged) < 2:
        return Agreement(1.0, 0.0, "")
    values = np.array([e.log_evidence for e in judged.values()])
    weights = 1 / np.maximum([e.se for e in judged.values()], _SMALLEST_ERROR) ** 2
    mean = np.average(values, weights=weights)
    p_value = float(chi2.sf((weights * (values - mean) ** 2).sum(), len(values) - 1))
    difference = float(np.ptp(values))
    agree = p_value >= LEVEL or difference <= NEGLIGIBLE
    return Agreement(p_value, difference, "" if agree else _reading(judged))


def _reading(evidences: Mapping[str, Evidence]) -> str:
    """The likely cause, from which estimates are apart."""
    low, high = max(combinations(evidences.values(), 2), key=_distance)
    if low.log_evidence > high.log_evidence:
        low, high = high, low
    apart = f"{high.estimator} is {high.log_evidence - low.log_evidence:.2f} above {low.estimator}"
    independent = [e.estimator in FROM_PRIOR for e in (low, high)]
    if independent == [False, True]:
        cause = (
            "the chains have probably not visited all of the posterior, a mode or a tail is "
            "missing: run more chains, longer, from dispersed starts"
        )
    elif independent == [True, False]:
        cause = (
            f"{low.estimator} has probably missed a narrow peak, which the draws have found: trust "
            "it less the narrower the posterior is in its prior"
        )
    elif all(independent):
        cause = "the posterior is too narrow in its prior for prior_monte_carlo"
    else:
        cause = (
            "the draws are too few, or the posterior is far from the shape that the estimators "
            "fit to it (several modes, heavy tails): run longer, and let tempered_smc decide, "
            "which needs no draws"
        )
    return f"{apart}; {cause}"


def _distance(pair: tuple[Evidence, Evidence]) -> float:
    one, other = pair
    return abs(one.log_evidence - other.log_evidence) / float(np.hypot(one.se, other.se))
