"""Model probabilities: Eq. 3.3 by hand, intervals, and what is refused."""

import math
from dataclasses import replace

import arviz as az
import numpy as np
import pytest

from pymc_statespace_filters.errors import DataMismatchError, EvidenceWarning, ModelError
from pymc_statespace_filters.evidence import Evidence, compare_evidence
from pymc_statespace_filters.evidence.evidence import store_evidence

COLUMNS = [
    "prob",
    "prob_low",
    "prob_high",
    "log_evidence",
    "se",
    "log_bayes_factor",
    "n_parameters",
    "n_observations",
    "bic",
    "undecided",
    "aic",
    "log_evidence_flat",
    "prior",
    "strength",
    "warning",
    "max_log_likelihood",
    "approximate",
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


def test_very_small_evidences_do_not_underflow():
    table = compare_evidence({"a": evidence(-90_000.0), "b": evidence(-90_001.0)})
    np.testing.assert_allclose(table["prob"], [1 / (1 + math.exp(-1)), 1 / (1 + math.e)])


def test_prior_probabilities():
    table = compare_evidence({"a": evidence(-8), "b": evidence(-8)}, model_prior={"a": 3, "b": 1})
    np.testing.assert_allclose(table.loc[["a", "b"], "prob"], [0.75, 0.25])
    assert table.loc["b", "log_bayes_factor"] == 0


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


def test_what_the_prior_decides_is_not_undecided():
    rivals = {"a": evidence(-8, se=0.1), "b": evidence(-8, se=0.1)}
    assert compare_evidence(rivals)["undecided"].all()
    assert not compare_evidence(rivals, model_prior={"a": 99, "b": 1})["undecided"].any()


def test_groups_are_accepted():
    idata = az.from_dict({"posterior": {"x": np.zeros((1, 4))}})
    stored = evidence(-8)
    store_evidence(idata, stored, {"scale": 1.0})
    table = compare_evidence({"a": idata, "b": evidence(-9)})
    assert table.loc["a", "log_evidence"] == -8
    assert table.equals(compare_evidence({"a": stored, "b": evidence(-9)}))


def test_an_idata_without_the_group_says_what_to_call():
    idata = az.from_dict({"posterior": {"x": np.zeros((1, 4))}})
    with pytest.raises(ModelError, match=r"'a' has no group 'evidence': call estimate_evidence"):
        compare_evidence({"a": idata})


def bridge(log_evidence):
    return replace(evidence(log_evidence), estimator="bridge")


def both(log_evidence):
    """What `estimate_evidence` leaves, in the draws and in hand."""
    estimates = {e.estimator: e for e in (evidence(log_evidence), bridge(log_evidence + 0.5))}
    idata = az.from_dict({"posterior": {"x": np.zeros((1, 4))}})
    for one in estimates.values():
        store_evidence(idata, one, {})
    return idata, estimates


def test_one_of_several_estimators_is_chosen():
    (stored, _), (_, in_hand) = both(-8), both(-9)
    table = compare_evidence({"a": stored, "b": in_hand}, estimator="bridge")
    assert list(table["log_evidence"]) == [-7.5, -8.5]
    table = compare_evidence({"a": stored, "b": in_hand}, estimator="chib_jeliazkov")
    assert list(table["log_evidence"]) == [-8, -9]


def test_an_estimator_that_a_model_lacks():
    for given in both(-8):
        assert list(compare_evidence({"a": given})["log_evidence"]) == [-7.5]
        with pytest.raises(ModelError, match=r"one of \['chib_.*those of 'a', got 'rough'"):
            compare_evidence({"a": given}, estimator="rough")
    with pytest.raises(ModelError, match=r"those of 'b', got 'chib_jeliazkov'"):
        compare_evidence({"a": evidence(-8), "b": bridge(-8)}, estimator="chib_jeliazkov")
    # Different estimators for different models are nobody's mistake.
    assert len(compare_evidence({"a": evidence(-8), "b": bridge(-8)})) == 2


def test_aic_and_the_integral_under_a_density_of_one():
    table = compare_evidence({"a": replace(evidence(-8, k=3), log_volume=4.5)})
    assert table.loc["a", "aic"] == 10 + 6
    assert table.loc["a", "log_evidence_flat"] == -3.5


@pytest.mark.parametrize(
    ("twice", "word"),
    [
        (0.0, "barely worth mentioning"),
        (1.99, "barely worth mentioning"),
        (2.01, "positive"),
        (5.99, "positive"),
        (6.01, "strong"),
        (9.99, "strong"),
        (10.01, "very strong"),
        (900.0, "very strong"),
    ],
)
def test_words_of_kass_and_raftery(twice, word):
    table = compare_evidence({"a": evidence(-8, se=0), "b": evidence(-8 - twice / 2, se=0)})
    assert table["strength"].to_dict() == {"a": "", "b": word}


def test_words_hold_in_spite_of_the_errors():
    """2 ln B = 7 +- 2 * 1.96 * 0.5: from strong down to positive; an error alone is no evidence."""
    rivals = {
        "a": evidence(-8, se=0.3),
        "b": evidence(-11.5, se=0.4),
        "c": evidence(-8.1, se=2),
        "unknown": evidence(-11.5, se=math.nan),
    }
    words = compare_evidence(rivals)["strength"]
    assert words["b"] == "positive"
    assert words["c"] == "barely worth mentioning"
    assert words["unknown"] == "strong"
    assert compare_evidence(rivals, ci_prob=0.5)["strength"]["b"] == "strong"


def test_evidence_that_the_prior_outweighs_is_negative():
    table = compare_evidence(
        {"a": evidence(-8), "b": evidence(-10)}, model_prior={"a": 1, "b": 100}
    )
    assert table["strength"].to_dict() == {"b": "", "a": "negative"}
    assert table["prior"].to_dict() == pytest.approx({"b": 100 / 101, "a": 1 / 101})


def test_without_an_error_the_intervals_are_unknown():
    rivals = {"a": evidence(-8), "b": evidence(-9, se=math.nan), "c": evidence(-30)}
    table = compare_evidence(rivals)
    known = compare_evidence(rivals | {"b": evidence(-9)})
    np.testing.assert_array_equal(table["prob"], known["prob"])
    assert table[["prob_low", "prob_high"]].isna().all(axis=None)
    assert table["undecided"].to_dict() == {"a": True, "b": True, "c": False}
    # If it is the best, nothing is decided.
    best = compare_evidence(rivals | {"b": evidence(-7, se=math.nan)})
    assert best["undecided"].all()


def test_what_deserves_a_look_is_marked():
    rivals = {
        "sound": evidence(-8),
        "doubtful": replace(evidence(-9), doubts="the chains disagree"),
        "rough": evidence(-10, se=math.nan),
    }
    marked = compare_evidence(rivals)["warning"]
    assert marked.to_dict() == {"sound": False, "doubtful": True, "rough": True}
    assert marked.dtype == bool


def test_improper_priors_are_named_once():
    rivals = {
        "a": replace(evidence(-8), improper="beta"),
        "b": evidence(-9),
        "c": replace(evidence(-9), improper="beta, gamma"),
    }
    with pytest.warns(EvidenceWarning) as said:
        table = compare_evidence(rivals)
    assert len(said) == 1
    assert "in 'a' (beta), 'c' (beta, gamma):" in str(said[0].message)
    assert said[0].filename == __file__
    assert table["warning"].to_dict() == {"a": True, "b": False, "c": True}


def test_different_data_raise_and_name_the_models():
    rivals = {"a": evidence(-8), "b": evidence(-9, data="other"), "c": evidence(-9)}
    with pytest.raises(DataMismatchError, match=r"'a', 'c' \| 'b'$"):
        compare_evidence(rivals)


def test_the_largest_prior_weights_are_equal():
    prior = {"a": 1e308, "b": 1e308}
    table = compare_evidence({"a": evidence(-9), "b": evidence(-9)}, model_prior=prior)
    np.testing.assert_allclose(table["prob"], 0.5)


def test_evidence_under_a_held_seed_is_marked():
    """Its error lacks that of the filter."""
    table = compare_evidence({"a": replace(evidence(-9), noise="held"), "b": evidence(-7)})
    assert table["warning"].to_dict() == {"a": True, "b": False}
