"""Model probabilities: Eq. 3.3 by hand, intervals, the correction, and what is refused."""

import math

import arviz as az
import numpy as np
import pytest

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.evidence import DimensionCorrection, Evidence, compare_evidence
from pymc_statespace_filters.evidence.result import store_evidence

COLUMNS = [
    "log_evidence",
    "se",
    "correction",
    "prob",
    "prob_low",
    "prob_high",
    "log_bayes_factor",
    "n_parameters",
    "n_observations",
    "bic",
    "undecided",
]


def evidence(log_evidence, se=0.05, k=2, observations=21, data="same", max_log_likelihood=-5.0):
    return Evidence(log_evidence, se, "chib_jeliazkov", k, observations, max_log_likelihood, data)


def test_columns_and_order():
    table = compare_evidence({"a": evidence(-9), "b": evidence(-7), "c": evidence(-8)})
    assert list(table.columns) == COLUMNS
    assert table.index.name == "model"
    assert list(table.index) == ["b", "c", "a"]
    assert table["undecided"].dtype == bool


def test_probabilities_and_bayes_factors():
    table = compare_evidence({"a": evidence(-9), "b": evidence(-7), "c": evidence(-8)})
    total = math.exp(-2) + 1 + math.exp(-1)
    np.testing.assert_allclose(
        table["prob"], [1 / total, math.exp(-1) / total, math.exp(-2) / total]
    )
    np.testing.assert_allclose(table["log_bayes_factor"], [0, -1, -2])
    assert (table["correction"] == 0).all()


def test_very_small_evidences_do_not_underflow():
    table = compare_evidence({"a": evidence(-90_000.0), "b": evidence(-90_001.0)})
    np.testing.assert_allclose(table["prob"], [1 / (1 + math.exp(-1)), 1 / (1 + math.e)])


def test_prior_probabilities():
    table = compare_evidence({"a": evidence(-8), "b": evidence(-8)}, prior={"a": 3, "b": 1})
    np.testing.assert_allclose(table.loc[["a", "b"], "prob"], [0.75, 0.25])
    assert table.loc["b", "log_bayes_factor"] == 0


def test_correction_of_the_thesis_with_its_own_number_of_observations():
    """J = 21: the factor between models of 3 and 4 parameters is 21^1.5 = 96.23, not 101^1.5."""
    rivals = {"m2": evidence(-8, k=3), "m3": evidence(-6, k=4)}
    table = compare_evidence(rivals, correction=DimensionCorrection(exponent=3))
    assert table.loc["m2", "correction"] == pytest.approx(-4.5 * math.log(21))
    odds = table.loc["m3", "prob"] / table.loc["m2", "prob"]
    assert odds == pytest.approx(math.exp(2) / 96.2341, rel=1e-5)
    assert list(table.index) == ["m2", "m3"]
    assert table.loc["m3", "log_bayes_factor"] == pytest.approx(2)  # of the evidences alone
    assert table.loc["m3", "log_evidence"] == -6


def test_bic_has_one_k_ln_j():
    table = compare_evidence({"a": evidence(-8, k=3, max_log_likelihood=-5)})
    assert table.loc["a", "bic"] == pytest.approx(10 + 3 * math.log(21))
    assert math.isnan(compare_evidence({"a": evidence(-8, observations=0)}).loc["a", "bic"])


def test_intervals_are_those_of_a_logistic_normal():
    """Two models: the log-odds are normal, so the interval is known."""
    rivals = {"a": evidence(-8, se=0.3), "b": evidence(-9, se=0.4)}
    row = compare_evidence(rivals, ci_prob=0.9).loc["a"]
    half = 1.6448536 * 0.5
    assert row["prob_low"] == pytest.approx(1 / (1 + math.exp(-1 + half)), abs=3e-3)
    assert row["prob_high"] == pytest.approx(1 / (1 + math.exp(-1 - half)), abs=3e-3)


def test_intervals_hold_the_probability_and_are_reproducible():
    rivals = {"a": evidence(-8, se=0.3), "b": evidence(-9, se=0.0), "c": evidence(-30, se=2)}
    table = compare_evidence(rivals)
    assert (table["prob_low"] <= table["prob"]).all()
    assert (table["prob"] <= table["prob_high"]).all()
    assert table.equals(compare_evidence(rivals))
    sure = compare_evidence({"a": evidence(-8, se=0), "b": evidence(-9, se=0)})
    np.testing.assert_allclose(sure["prob_low"], sure["prob_high"])


@pytest.mark.parametrize(
    ("gap", "se", "undecided"),
    [
        (0.1, 0.05, False),
        (0.1, 0.06, False),
        (0.1, 0.08, True),
        (0.0, 0.0, True),
        (0.1, 0.0, False),
    ],
)
def test_undecided_is_when_the_interval_of_the_odds_holds_one(gap, se, undecided):
    """At 95 per cent: 1.96 sqrt(2) se = 0.139, 0.166, 0.222 ... against the gap."""
    gap = gap if se == 0 else gap * 2
    rivals = {"a": evidence(-8, se=se), "b": evidence(-8 - gap, se=se), "far": evidence(-99, se=se)}
    table = compare_evidence(rivals)
    assert list(table["undecided"]) == [undecided, undecided, False]


def test_groups_are_accepted():
    idata = az.from_dict({"posterior": {"x": np.zeros((1, 4))}})
    stored = evidence(-8)
    store_evidence(idata, stored, {"scale": 1.0})
    table = compare_evidence({"a": idata, "b": evidence(-9)})
    assert table.loc["a", "log_evidence"] == -8
    assert table.equals(compare_evidence({"a": stored, "b": evidence(-9)}))


def test_an_idata_without_the_group_says_what_to_call():
    idata = az.from_dict({"posterior": {"x": np.zeros((1, 4))}})
    with pytest.raises(ModelError, match=r"'a' has no group 'evidence': call chib_jeliazkov"):
        compare_evidence({"a": idata})


def test_an_idata_with_two_estimators_is_ambiguous():
    idata = az.from_dict({"posterior": {"x": np.zeros((1, 4))}})
    store_evidence(idata, evidence(-8), {"scale": 1.0})
    store_evidence(idata, Evidence(-8.0, 0.1, "bridge", 2, 21, -5.0, "same"), {"n_iterations": 7})
    assert list(idata["evidence"]["estimator"].values) == ["chib_jeliazkov", "bridge"]
    with pytest.raises(ModelError, match="several estimators"):
        compare_evidence({"a": idata})


def test_different_data_raise_and_name_the_models():
    rivals = {"a": evidence(-8), "b": evidence(-9, data="other"), "c": evidence(-9)}
    with pytest.raises(DataMismatchError, match=r"'a', 'c' \| 'b'$"):
        compare_evidence(rivals)


@pytest.mark.parametrize(
    "prior", [{"a": 1}, {"a": 1, "b": 0}, {"a": 1, "b": -1}, {"a": 1, "c": 1}, [1, 1]]
)
def test_bad_priors(prior):
    with pytest.raises(ModelError, match="prior must"):
        compare_evidence({"a": evidence(-8), "b": evidence(-9)}, prior=prior)


@pytest.mark.parametrize("ci_prob", [0, 1, 95, None])
def test_bad_ci_prob(ci_prob):
    with pytest.raises(ModelError, match="ci_prob must"):
        compare_evidence({"a": evidence(-8)}, ci_prob=ci_prob)


def test_bad_correction():
    with pytest.raises(ModelError, match="correction must"):
        compare_evidence({"a": evidence(-8)}, correction=3)
    with pytest.raises(ModelError, match="n_observations=0"):
        compare_evidence({"a": evidence(-8, observations=0)}, correction=DimensionCorrection())
    with pytest.raises(ModelError, match="exponent must be a finite number, got nan"):
        DimensionCorrection(exponent=float("nan"))


@pytest.mark.parametrize("evidences", [{}, [evidence(-8)], {"a": -8.0}])
def test_bad_evidences(evidences):
    with pytest.raises(ModelError, match="evidences"):
        compare_evidence(evidences)
