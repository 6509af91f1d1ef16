"""Arguments of the evidence that cannot be, as (call, argument, value, message)."""

import math
from dataclasses import replace
from functools import partial

import arviz as az
import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence import Evidence, compare_evidence
from pymc_statespace_filters.evidence.estimators.bridge import Bridge
from pymc_statespace_filters.evidence.estimators.chib_jeliazkov import ChibJeliazkov
from pymc_statespace_filters.evidence.estimators.importance import Importance

EVIDENCE = Evidence(-8.0, 0.05, "chib_jeliazkov", 2, 21, -5.0, "same")
RIVALS = {"a": EVIDENCE, "b": replace(EVIDENCE, log_evidence=-9.0)}
DRAWS = az.from_dict({"posterior": {"x": np.random.default_rng(1).normal(size=(2, 100))}})
LEVELS = np.zeros((2, 100))


def each(call, argument, values, message):
    """A row for each value."""
    return [(call, argument, value, message) for value in values]


def of_draws(call):
    """The call for these draws of a normal distribution."""

    def inside(**arguments):
        with pm.Model() as model:
            pm.Normal("x")
        return call(DRAWS, model, **arguments)

    return inside


NOT_POSITIVE = [0, -0.1, math.nan, math.inf, "small", True]
compare = partial(compare_evidence, RIVALS)
curves = partial(psf.prior_sensitivity, RIVALS, models={})
estimate, chib = of_draws(psf.estimate_evidence), of_draws(psf.chib_jeliazkov)
TABLE = [
    # tables of models and curves
    *each(
        compare,
        "model_prior",
        [{"a": 1}, {"a": 1, "b": 0}, {"a": 1, "b": -1}, {"a": 1, "c": 1}, [1, 1]],
        "model_prior must",
    ),
    *each(
        compare,
        "model_prior",
        [{"a": a, "b": b} for a, b in [(1e-320, 1e308), ("much", 1.0), (None, 1.0), (-1, 0)]],
        "model_prior must be positive and finite",
    ),
    *each(compare, "ci_prob", [0, 1, 95, None], "ci_prob must"),
    *each(
        compare_evidence,
        "evidences",
        [{}, [EVIDENCE], {"a": -8.0}, {"a": {"bridge": -8.0}}],
        "evidences",
    ),
    *each(curves, "ci_prob", [95], "ci_prob must"),
    *each(curves, "model_prior", [{"a": 1}], "model_prior must"),
    *each(partial(psf.prior_sensitivity, models={}), "evidences", [{"a": 3.0}], "evidences"),
    *each(partial(replace, EVIDENCE), "log_volume", [math.inf], "must be a finite number, got inf"),
    # estimators
    *(
        row
        for call in (chib, estimate)
        for row in each(call, "cores", [0, -1, 1.5, "two"], "cores must be an integer of at least")
    ),
    *each(chib, "n_proposals", [10, 500.0, "many"], "n_proposals must be an integer of at least 1"),
    *each(ChibJeliazkov, "n_blocks", [0, 1.5, True], "n_blocks must be an integer of at least 1"),
    *each(estimate, "target_se", [*NOT_POSITIVE, None], "target_se must be a positive number"),
    *(
        row
        for make in (ChibJeliazkov, Bridge, Importance)
        for row in each(make, "target_se", NOT_POSITIVE, "target_se must be a positive number")
    ),
    (estimate, "estimators", [], r"estimators must have at least one of \['chib_j.*got \[\]"),
    (
        estimate,
        "estimators",
        ["bridge", "harmonic_mean"],
        r"names among \['chib_j.* objects, got 'harmonic_mean'",
    ),
    *each(
        estimate,
        "estimators",
        ["prior_monte_carlo", ["bridge", "tempered_smc"]],
        "the estimator '.*' has gone: use the evidence of sample_smc, which needs no draws",
    ),
    *each(
        estimate,
        "estimators",
        ["laplace", "warp_bridge"],
        "the estimator '.*' has gone: use 'bridge'",
    ),
    (estimate, "estimators", 3, "or Estimator objects, got 3"),
    (estimate, "estimators", ["bridge", 3], "or Estimator objects, got 3"),
    (
        estimate,
        "estimators",
        ["bridge", Bridge()],
        "must have different names, got 'bridge' more than once",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("call", "argument", "value", "message"), TABLE)
def test_a_wrong_argument_is_named(call, argument, value, message):
    with pytest.raises(ModelError, match=message):
        call(**{argument: value})
