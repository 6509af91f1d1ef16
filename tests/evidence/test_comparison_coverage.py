"""The intervals of a table of models hold the exact values as often as they say.

Three regressions of one record, whose evidences are known. Each replication has draws of its own,
so that the evidences are as noisy as a user's. The prior weights make the three models equally
probable: there, an interval of a probability is widest.

200 replications. A count of an exactly calibrated table leaves its bounds (110 to 161 at 68 %, 176
to 199 at 95 %) at most once in ten thousand times, so that one of the 30 counts of an estimator
does so at most once in 300 times; the seeds are fixed.

Measured on 2026-11-24, the coverage of the log-evidences, probabilities and log Bayes factors
(smallest to largest of the three of each; standard errors of the log-evidences up to 0.036):

========================== ===== ============== ============== ==============
estimator, sd of the noise level log-evidence   probability    Bayes factor
========================== ===== ============== ============== ==============
bridge, 0                  68 %  61.5 to 68.5 % 62.0 to 67.0 % 60.0 to 66.5 %
bridge, 0                  95 %  91.0 to 96.5 % 93.5 to 97.0 % 94.0 to 95.5 %
bridge, 1                  68 %  61.0 to 73.0 % 59.5 to 67.0 % 61.5 to 71.0 %
bridge, 1                  95 %  92.5 to 95.5 % 92.0 to 95.0 % 93.0 to 95.5 %
importance, 0              68 %  65.5 to 66.5 % 64.0 to 70.0 % 66.0 to 69.5 %
importance, 0              95 %  93.5 to 96.0 % 94.5 to 96.0 % 93.5 to 96.5 %
importance, 1              68 %  67.5 to 73.0 % 69.0 to 71.5 % 69.0 to 70.5 %
importance, 1              95 %  95.5 to 97.5 % 95.0 to 97.0 % 95.5 to 98.0 %
========================== ===== ============== ============== ==============
"""

from functools import cache

import numpy as np
import pytest
from scipy.special import logit
from scipy.stats import binom, norm

from pymc_statespace_filters.evidence import Evidence, compare_evidence
from tests.evidence.calibration import CALIBRATED, CORRELATION
from tests.evidence.targets import Regression

pytestmark = pytest.mark.slow

RUNS = 200
ERROR_RATE = 1e-4  # of each count
LEVELS = (0.68, 0.95)
SIZES = (2, 3, 4)  # parameters of the models
SHAPE = (4, 500)  # of the draws


@cache
def targets():
    return [Regression(k, 20, np.random.default_rng([68, k])) for k in SIZES]


@cache
def evidences(name, noise_sd):
    """Estimates and their standard errors, each of shape (run, model)."""
    found = [
        [
            CALIBRATED[name].estimate(
                target.posterior(
                    SHAPE,
                    np.random.default_rng([95, run, target.n_normals]),
                    correlation=CORRELATION,
                    noise_sd=noise_sd,
                ),
                rng=np.random.default_rng([96, run, target.n_normals]),
            )
            for target in targets()
        ]
        for run in range(RUNS)
    ]
    return tuple(
        np.array([[getattr(one, field) for one in row] for row in found])
        for field in ("log_evidence", "se")
    )


def exact():
    return np.array([target.log_evidence for target in targets()])


def counts(estimates, errors, level):
    """How often each interval at a level holds the exact value, and each verdict is right."""
    names = [f"k={k}" for k in SIZES]
    truth = exact()
    weights = np.exp(-(truth - truth.max()))  # equally probable, all three
    half = norm.ppf((1 + level) / 2)
    held = {}

    def count(what, holds):
        held[what] = held.get(what, 0) + int(holds)

    for values, ses in zip(estimates, errors, strict=True):
        models = {
            name: Evidence(value, se, "bridge", k, 20, -9.0, "same")
            for name, value, se, k in zip(names, values, ses, SIZES, strict=True)
        }
        prior = dict(zip(names, weights, strict=True))
        table = compare_evidence(models, model_prior=prior, ci_prob=level).loc[names]
        for i, (name, row) in enumerate(table.iterrows()):
            count(f"ln Z, {name}", abs(row["log_evidence"] - truth[i]) < half * row["se"])
            count(f"prob, {name}", row["prob_low"] < 1 / 3 < row["prob_high"])
        for i, j in ((0, 1), (0, 2), (1, 2)):
            pair = [names[i], names[j]]
            two = compare_evidence(
                {name: models[name] for name in pair},
                model_prior={name: prior[name] for name in pair},
                ci_prob=level,
            ).loc[pair]
            between = f"{pair[0]} against {pair[1]}"
            # The first model's log-odds without the prior: the log Bayes factor.
            prior_odds = np.log(weights[i] / weights[j])
            low, high = logit(two[["prob_low", "prob_high"]].iloc[0]) - prior_odds
            count(f"ln B, {between}", low < truth[i] - truth[j] < high)
            # Neither is the more probable one, so that every decision is wrong.
            count(f"undecided, {between}", two["undecided"].all())
            difference = two["log_bayes_factor"].iloc[0] - two["log_bayes_factor"].iloc[1]
            error = half * np.hypot(*two["se"])
            count(f"difference, {between}", abs(difference - (truth[i] - truth[j])) < error)
    return held


def bounds(level):
    return binom.ppf([ERROR_RATE / 2, 1 - ERROR_RATE / 2], RUNS, level)


def outside(held, level):
    """The counts that an exactly calibrated table would hardly give."""
    low, high = bounds(level)
    return {what: n for what, n in held.items() if not low <= n <= high}


def guesses(reported):
    """Exact values with normal errors, and standard errors too small or large by a factor."""
    sd = np.array([0.02, 0.1, 0.3])
    normals = np.random.default_rng(97).standard_normal((RUNS, len(SIZES)))
    return exact() + sd * normals, np.broadcast_to(reported * sd, normals.shape)


@pytest.mark.parametrize("level", LEVELS)
def test_normal_errors_are_covered(level):
    assert outside(counts(*guesses(1.0), level), level) == {}


@pytest.mark.parametrize(("reported", "level"), [(0.65, 0.68), (0.65, 0.95), (1.5, 0.68)])
def test_wrong_errors_are_found(reported, level):
    """Every interval is too short or too long, and each is found to be."""
    held = counts(*guesses(reported), level)
    assert len(outside(held, level)) > len(held) / 2


# The standard error falls with the square root of draws and proposals: 2000 draws are few.
@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("noise_sd", [0.0, 1.0])
@pytest.mark.parametrize("name", ["bridge", "importance"])
def test_intervals_hold_the_exact_values(name, noise_sd, level):
    held = counts(*evidences(name, noise_sd), level)
    assert outside(held, level) == {}, {what: n / RUNS for what, n in held.items()}
