"""The table of `compare_evidence` as it is shown, and which of several estimates it takes."""

import copy
import math
import pickle
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence import Evidence, compare_evidence
from pymc_statespace_filters.evidence.comparison.evidence_table import EvidenceTable


def evidence(log_evidence, se=0.05, k=2, max_log_likelihood=-5.0, **fields):
    one = Evidence(log_evidence, se, "bridge", k, 100, max_log_likelihood, "same")
    return replace(one, **fields)


# The evidence and both criteria choose "cubic".
CLEAR = {
    "linear": evidence(-41.0, k=2, max_log_likelihood=-35.0),
    "cubic": evidence(-39.0, k=3, max_log_likelihood=-31.0),
}
COLUMNS_SENTENCE = (
    "Further columns, shown by .to_string(): log_bayes_factor, n_parameters, n_observations, "
    "bic, undecided, aic, log_evidence_flat, prior, strength, warning, "
    "max_log_likelihood, approximate."
)


def said(evidences, **keywords):
    """The sentences below the columns, unwrapped."""
    table = compare_evidence(evidences, **keywords)
    lines = repr(table).splitlines()[len(table) + 2 :]
    return "\n".join(lines).replace("\n  ", " ").split("\n")


def test_only_the_main_columns_are_shown_and_nothing_else_if_nothing_applies():
    lines = repr(compare_evidence(CLEAR)).splitlines()
    assert lines[0].split() == ["prob", "prob_low", "prob_high", "log_evidence", "se"]
    assert lines[2].split() == ["cubic", "0.881", "0.865", "0.895", "-39.000", "0.050"]
    assert said(CLEAR) == [COLUMNS_SENTENCE]


def test_it_fits_into_80_columns_with_the_longest_sentences():
    doubtful = {"a" * 30: evidence(-40.0, doubts="the chains disagree " * 20)}
    text = repr(compare_evidence(CLEAR | doubtful))
    assert max(map(len, text.splitlines())) <= 80


def test_probabilities_that_rounding_would_make_certain_and_what_is_unknown():
    text = repr(compare_evidence({"a": evidence(-8, se=0), "b": evidence(-20, se=0)}))
    assert text.splitlines()[2].split()[:2] == ["a", ">0.999"]
    assert text.splitlines()[3].split()[:2] == ["b", "<0.001"]
    text = repr(compare_evidence({"a": evidence(-8), "b": evidence(-9, se=math.nan)}))
    assert text.splitlines()[3].split() == "b 0.269 unknown unknown -9.000 unknown".split()


def test_a_warning_is_said_with_its_models():
    disagree = "the chains disagree (R-hat 1.31)"
    said_of = said(
        {
            "a": evidence(-8, doubts=disagree),
            "b": evidence(-19, doubts=disagree),
            "c": evidence(-29, se=math.nan, estimator="rough"),
            "d": evidence(-39, noise="held"),
            "e": evidence(-49, doubts="EKF() is 5 nats low. Use UKF()."),
        }
    )
    warnings = [text for text in said_of if text.startswith("Warning")]
    assert warnings == [
        "Warning for 'a' and 'b' (bridge): the chains disagree (R-hat 1.31).",
        "Warning for 'c' (rough): the estimate has no standard error, so that no interval is "
        "known.",
        "Warning for 'd' (bridge): the chains held one noise seed, and se excludes the error of "
        "the filter.",
        "Warning for 'e' (bridge): EKF() is 5 nats low. Use UKF().",
    ]


def test_criteria_that_choose_another_model_are_explained_by_the_priors():
    """Penalties of 9 and 3 nats, where BIC's are k ln(100) / 2 = 6.9 and 4.6."""
    rivals = {
        "narrow": evidence(-40, k=2, max_log_likelihood=-37),
        "wide": evidence(-41, k=3, max_log_likelihood=-32),
    }
    assert said(rivals)[0] == (
        "AIC and BIC choose 'wide', the evidence 'narrow': the priors penalise 'wide' by 2.1 nats "
        "more and 'narrow' by 1.6 nats less than BIC's k/2 ln J does; the wider a prior, the "
        "larger its penalty."
    )
    # BIC agrees with the evidence: what differs is AIC's penalty.
    rivals["wide"] = replace(rivals["wide"], max_log_likelihood=-35)
    assert said(rivals)[0] == (
        "AIC chooses 'wide', the evidence 'narrow': AIC penalises each parameter by 1 nat, the "
        "priors penalise 'wide' by 6.0 for 3 and 'narrow' by 3.0 for 2; the wider a prior, the "
        "larger its penalty."
    )


def test_what_is_undecided_is_said():
    close = {"a": evidence(-8), "b": evidence(-8.01), "far": evidence(-20)}
    assert said(close, ci_prob=0.9)[0] == (
        "Undecided at 90 %: whether 'a' or 'b' is more probable: smaller errors, from more draws "
        "or a smaller target_se, would decide."
    )
    close["c"] = evidence(-8.02)
    assert "which of 'a', 'b' and 'c' is the most probable:" in said(close)[0]
    # No remedy where there is no error to reduce.
    tie = {"a": evidence(-8, se=0), "b": evidence(-8, se=0)}
    assert said(tie)[0] == "Undecided at 95 %: whether 'a' or 'b' is more probable."


def test_an_approximate_likelihood_is_said_and_an_unknown_one_is_missing():
    rivals = {"a": evidence(-8, approximate=True), "b": evidence(-20, approximate=False)}
    table = compare_evidence(rivals)
    assert table["approximate"].to_dict() == {"a": True, "b": False}
    assert table["approximate"].dtype == bool
    assert said(rivals)[0].startswith("The likelihood of 'a' is a filter's approximation")
    unknown = compare_evidence(rivals | {"b": evidence(-20)})["approximate"]
    assert unknown["a"]
    assert unknown["b"] is pd.NA


def test_pickles_and_copies_show_the_same_and_results_are_plain(tmp_path):
    table = compare_evidence(CLEAR)
    for other in (pickle.loads(pickle.dumps(table)), copy.copy(table), copy.deepcopy(table)):
        assert isinstance(other, EvidenceTable)
        assert repr(other) == repr(table)
        pd.testing.assert_frame_equal(other, table)
    # What the sentences say may be wrong for these.
    for plain in (table.iloc[:1], table[["prob"]], table.assign(prob=0.5), table.sort_index()):
        assert type(plain) is pd.DataFrame
    table.to_csv(tmp_path / "table.csv")
    read = pd.read_csv(tmp_path / "table.csv", index_col="model")
    assert list(read.columns) == list(table.columns)
    np.testing.assert_allclose(read["prob"], table["prob"])


def test_html_has_the_same_columns_and_sentences():
    html = compare_evidence({"<a>": evidence(-8, doubts="R-hat > 1")})._repr_html_()
    assert html.count("<th>") == 6 + 6 + 1  # columns, the line of the index, a model
    assert "Warning for &#x27;&lt;a&gt;&#x27; (bridge): R-hat &gt; 1." in html
    assert f"<p>{COLUMNS_SENTENCE}</p>" in html


def several(log_evidence, **estimates):
    """Estimates of one model by several estimators, at these distances and with these errors."""
    return {
        name: evidence(log_evidence + away, se=se, estimator=name)
        for name, (away, se) in estimates.items()
    }


def test_bridge_is_the_estimate_and_the_others_check_it():
    rivals = {
        "a": several(-8, chib_jeliazkov=(0.02, 0.005), bridge=(0.0, 0.01)),
        "b": several(-9, bridge=(0.0, 0.02), importance=(0.01, 0.001)),
    }
    assert list(compare_evidence(rivals)["log_evidence"]) == [-8, -9]
    assert said(rivals)[0] == "Log-evidences by bridge."
    with_one = rivals | {"c": evidence(-20, estimator="rough")}
    assert said(with_one)[0] == "Log-evidences of 'a', 'b' by bridge."
    # An error about which there are doubts is not the smallest, but for that of the check.
    for name in rivals:
        rivals[name]["bridge"] = replace(rivals[name]["bridge"], doubts="few terms")
    assert list(compare_evidence(rivals)["log_evidence"]) == [-8, -8.99]
    assert said(rivals)[0] == "Log-evidences of 'a' by bridge, of 'b' by importance."


def test_an_estimate_without_an_error_is_neither_tested_nor_taken_if_there_is_another():
    rivals = {"a": several(-8, rough=(-3.0, math.nan), chib_jeliazkov=(0.0, 0.01))}
    assert list(compare_evidence(rivals)["log_evidence"]) == [-8]
    unknown = {"a": several(-8, rough=(0.0, math.nan), mine=(0.0, math.nan))}
    with pytest.raises(ModelError, match=r"'a' has .* none of them with a standard error: .*mine"):
        compare_evidence(unknown)


def test_estimates_that_disagree_are_a_warning_with_the_cause():
    rivals = {"a": evidence(-9), "b": several(-8, bridge=(-2.0, 0.01), importance=(0.0, 0.01))}
    table = compare_evidence(rivals)
    assert table["log_evidence"].to_dict() == {"a": -9, "b": -10}
    assert table["warning"].to_dict() == {"a": False, "b": True}
    assert said(rivals)[1].startswith(
        "Warning for 'b' (bridge): importance is 2.00 above bridge; the draws are too few, or the "
        "posterior is far from the shape"
    )
    # One that is doubtful itself says little about the other.
    rivals["b"] = several(-10, bridge=(0.0, 0.2), chib_jeliazkov=(4.6, 0.9))
    rivals["b"]["chib_jeliazkov"] = replace(
        rivals["b"]["chib_jeliazkov"], doubts="the chains disagree; 3 effective draws"
    )
    rivals["b"]["bridge"] = replace(rivals["b"]["bridge"], doubts="the chains disagree")
    assert said(rivals)[1].startswith(
        "Warning for 'b' (bridge): the chains disagree; chib_jeliazkov is 4.60 above bridge; the "
        "error of chib_jeliazkov is in doubt: 3 effective draws."
    )
