"""Probabilities, their intervals and the mark of what is undecided, as drawn."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from pymc_statespace_filters import compare_evidence, plot_model_probabilities
from pymc_statespace_filters.errors import ModelError
from tests.plots.drawn import drawn


def test_points_and_intervals(table):
    collection = plot_model_probabilities(table, backend="none")
    for name, row in table.iterrows():
        bar = drawn(collection, "interval")[name]["x"]
        np.testing.assert_array_equal(bar, [row["prob_low"], row["prob_high"]])
        text = drawn(collection, "text")[name]
        assert text["x"].item() == row["prob"]


def test_undecided_models_have_open_marks_and_a_word(table):
    assert dict(table["undecided"]) == {"cubic": True, "quintic": True, "linear": False}
    collection = plot_model_probabilities(table, backend="none")
    for name, undecided in table["undecided"].items():
        marked, plain = (drawn(collection, kind)[name] for kind in ("undecided", "decided"))
        assert (marked is None, plain is None) == (not undecided, undecided)
        mark = marked or plain
        assert mark["x"].item() == table.loc[name, "prob"]
        assert mark["facecolor"] == ("B0" if undecided else "C0")
        assert ("undecided" in drawn(collection, "text")[name]["string"]) == undecided


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
def test_the_number(prob, text):
    one = pd.DataFrame(
        {"prob": [prob], "prob_low": [prob], "prob_high": [prob], "undecided": [False]}, index=["a"]
    )
    collection = plot_model_probabilities(one, backend="none")
    assert drawn(collection, "text")["a"]["string"] == text


def test_the_ends_of_a_narrow_interval_are_seen(rivals):
    precise = {name: replace(one, se=0.01) for name, one in rivals.items()}
    table = compare_evidence(precise)
    collection = plot_model_probabilities(table, backend="none")
    row = table.loc["cubic"]
    ends = drawn(collection, "ends")["cubic"]
    low, high = row["prob_low"], row["prob_high"]
    assert high - low < 0.02
    np.testing.assert_array_equal(ends["x"], [low, low, np.nan, high, high])
    np.testing.assert_allclose(ends["y"], [1.88, 2.12, np.nan, 1.88, 2.12])
    expected = f"{row['prob']:.3f} ({low:.3f} to {high:.3f})"
    assert drawn(collection, "text")["cubic"]["string"] == expected


def test_the_legend_tells_what_the_bar_is(table):
    figure = plot_model_probabilities(table).viz["figure"].item()
    key = [text.get_text() for text in figure.legends[0].get_texts()]
    assert key == ["interval of the evidences' errors", "probability"]
    unknown = plot_model_probabilities(table.assign(prob_low=np.nan, prob_high=np.nan))
    key = [text.get_text() for text in unknown.viz["figure"].item().legends[0].get_texts()]
    assert key == ["probability"]


def test_unknown_intervals_are_not_drawn(table):
    unknown = table.assign(prob_low=np.nan, prob_high=np.nan)
    collection = plot_model_probabilities(unknown, backend="none")
    assert not {"interval", "ends"} & set(collection.viz.children)
    assert drawn(collection, "decided")["linear"] is not None


def test_what_is_refused():
    with pytest.raises(ModelError, match="table must be one of compare_evidence, got"):
        plot_model_probabilities(pd.DataFrame({"prob": [1.0]}))
