"""Evidences, probabilities of models and of terms, each in a row of its own, as drawn."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from pymc_statespace_filters import (
    compare_evidence,
    plot_designs,
    plot_evidence,
    plot_model_probabilities,
    plot_terms,
)
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.evidence import store_evidence
from tests.plots.conftest import DESIGNS, TERMS, an_evidence
from tests.plots.drawn import drawn


def test_log_evidences_with_bars_of_their_errors(table):
    collection = plot_evidence(table, backend="none")
    places = {"cubic": 2, "quintic": 1, "linear": 0}  # the most probable model on top
    for name, row in table.iterrows():
        point = drawn(collection, "point")[name]
        assert np.asarray(point["x"]).item() == row["log_evidence"]
        assert np.asarray(point["y"]).item() == places[name]
        for visual, count in (("one_se", 1), ("two_se", 2)):
            ends = row["log_evidence"] + count * row["se"] * np.array([-1, 1])
            np.testing.assert_allclose(drawn(collection, visual)[name]["x"], ends)


def test_numbers_beside_the_points(table, estimates):
    text = drawn(plot_evidence(table, backend="none"), "text")
    assert text["cubic"]["string"] == "-5.00 ± 0.30"
    assert (text["cubic"]["horizontal_align"], text["linear"]["horizontal_align"]) == (
        "right",
        "left",
    )
    precise = drawn(plot_evidence(table.assign(se=0.004), backend="none"), "text")
    assert precise["cubic"]["string"] == "-5.000 ± 0.004"  # and not 0.00
    collection = plot_evidence(estimates, backend="none")
    assert drawn(collection, "text")["rough"]["string"] == "-5.30"
    assert drawn(collection, "one_se")["rough"] is None
    assert drawn(collection, "one_se")["bridge"] is not None


def test_what_compare_evidence_takes_is_compared(estimates):
    given = {"one": {"bridge": estimates["bridge"]}, "two": {"bridge": estimates["bridge"]}}
    points, expected = (
        drawn(plot_evidence(models, backend="none"), "point")
        for models in (given, compare_evidence(given))
    )
    assert set(points) == {"one", "two"}
    assert points["one"]["x"] == expected["one"]["x"]


def test_estimators_from_a_group(estimates):
    idata = xr.DataTree()
    for evidence in estimates.values():
        store_evidence(idata, evidence, {})
    one, other = (
        drawn(plot_evidence(given, backend="none"), "point") for given in (estimates, idata)
    )
    assert {name: point["x"] for name, point in one.items()} == {
        name: point["x"] for name, point in other.items()
    }


def test_numbers_of_many_digits_do_not_overlap():
    evidences = {"a": an_evidence(-4919.75, 0.004), "b": an_evidence(-4919.66, 0.004)}
    figure = plot_evidence(evidences).viz["figure"].item()
    figure.canvas.draw()
    labels = figure.axes[0].get_xticklabels()
    assert len(labels) > 2
    assert all(label.get_text()[1:].startswith("4919.") for label in labels)
    boxes = [label.get_window_extent() for label in labels]
    assert min(right.x0 - left.x1 for left, right in pairwise(boxes)) > 5


def test_probabilities_with_their_intervals(table):
    collection = plot_model_probabilities(table, backend="none")
    assert dict(table["undecided"]) == {"cubic": True, "quintic": True, "linear": False}
    for name, row in table.iterrows():
        bar = drawn(collection, "interval")[name]["x"]
        np.testing.assert_array_equal(bar, [row["prob_low"], row["prob_high"]])
        marked, plain = (drawn(collection, kind)[name] for kind in ("undecided", "decided"))
        assert (marked is None, plain is None) == (not row["undecided"], row["undecided"])
        mark = marked or plain
        assert mark["x"].item() == row["prob"]
        assert mark["facecolor"] == ("B0" if row["undecided"] else "C0")
        assert ("undecided" in drawn(collection, "text")[name]["string"]) == row["undecided"]


@pytest.mark.parametrize(
    ("prob", "text"),
    [
        (0.4, "0.40"),
        (0.98765, "0.99"),
        (0.9975, "0.9975"),
        (0.0098, "0.01"),
        (7.6e-5, "8e-05"),
        (0.0, "< 1e-6"),
    ],
)
def test_a_probability_in_words(prob, text):
    one = pd.DataFrame(
        {"prob": [prob], "prob_low": [prob], "prob_high": [prob], "undecided": [False]}, index=["a"]
    )
    collection = plot_model_probabilities(one, backend="none")
    assert drawn(collection, "text")["a"]["string"] == text


def test_the_ends_of_a_narrow_interval_are_seen(rivals):
    table = compare_evidence({name: replace(one, se=0.01) for name, one in rivals.items()})
    collection = plot_model_probabilities(table, backend="none")
    prob, low, high = table.loc["cubic", ["prob", "prob_low", "prob_high"]]
    ends = drawn(collection, "ends")["cubic"]
    assert high - low < 0.02
    np.testing.assert_array_equal(ends["x"], [low, low, np.nan, high, high])
    np.testing.assert_allclose(ends["y"], [1.88, 2.12, np.nan, 1.88, 2.12])
    expected = f"{prob:.3f} ({low:.3f} to {high:.3f})"
    assert drawn(collection, "text")["cubic"]["string"] == expected


def test_the_key_tells_what_the_bar_is(table):
    unknown = table.assign(prob_low=np.nan, prob_high=np.nan)
    for given, labels in (
        (table, ["interval of the evidences' errors", "probability"]),
        (unknown, ["probability"]),
    ):
        collection = plot_model_probabilities(given)
        key = [text.get_text() for text in collection.viz["figure"].item().legends[0].get_texts()]
        assert key == labels
    assert not {"interval", "ends"} & set(collection.viz.children)
    assert "decided" in collection.viz.children


def test_probabilities_of_terms_with_errors_and_priors():
    collection = plot_terms(xr.DataTree.from_dict({"terms": TERMS}), backend="none")
    points = drawn(collection, "point", "inclusion")
    assert list(points) == ["k3", "k_f, k_h", "c2"]  # the most probable one on top
    assert [points[name]["y"] for name in points] == [2, 1, 0]
    bounds = drawn(collection, "interval", "inclusion")
    np.testing.assert_allclose(bounds["c2"]["x"], [0.1, 0.14])
    np.testing.assert_allclose(bounds["k3"]["x"], [0.94, 1.0])
    assert np.nanmax(drawn(collection, "prior", "inclusion")["k3"]["x"]) == 0.4
    assert drawn(collection, "text", "inclusion")["c2"]["string"] == "0.12 ± 0.01"


PART = xr.DataTree.from_dict({"terms": TERMS[["inclusion"]]})
NO_TABLE = "idata_or_table must be a table of compare_evidence"


@pytest.mark.parametrize(
    ("plot", "given", "match"),
    [(plot_evidence, given, NO_TABLE) for given in (xr.DataTree(), {}, {"a": 3}, None)]
    + [
        (plot_evidence, pd.DataFrame({"prob": [1.0]}), NO_TABLE),
        (plot_model_probabilities, pd.DataFrame({"prob": [1.0]}), "table must be one of compare_"),
        (plot_terms, TERMS, "found must be the result of select_terms, got Dataset"),
        (plot_terms, PART, r"got DataTree with the groups \['terms'\]"),
    ],
)
def test_what_is_refused(plot, given, match):
    with pytest.raises(ModelError, match=match):
        plot(given)


def test_designs_with_bounds_and_errors():
    collection = plot_designs(DESIGNS, backend="none")
    assert drawn(collection, "point")["long"]["x"].item() == 0.5
    np.testing.assert_allclose(drawn(collection, "two_se")["long"]["x"], [0.44, 0.56])
    np.testing.assert_allclose(
        drawn(collection, "bounds")["short"]["x"], [0.29] * 2 + [np.nan] + [0.31] * 2
    )
    assert drawn(collection, "text")["short"]["string"] == "0.300 ± 0.002"
    of_cubic = plot_designs(DESIGNS, of="cubic", backend="none")
    assert drawn(of_cubic, "point")["short"]["x"].item() == 1.25
    np.testing.assert_allclose(drawn(of_cubic, "two_se")["short"]["x"], [0.25, 2.25])


def test_designs_of_another_model_or_table():
    with pytest.raises(ModelError) as raised:
        plot_designs(DESIGNS, of="linear")
    assert str(raised.value) == "of must be one of the models ['cubic'], got 'linear'"
    with pytest.raises(ModelError) as raised:
        plot_designs({"low": 1.0})
    assert str(raised.value) == "table must be one of expected_information, got {'low': 1.0}"
