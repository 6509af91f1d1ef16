"""Log-evidences and their errors, as drawn."""

from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from pymc_statespace_filters import plot_evidence
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.evidence import store_evidence
from tests.plots.conftest import an_evidence
from tests.plots.drawn import drawn


def test_points_and_bars(table):
    collection = plot_evidence(table, backend="none")
    places = {"cubic": 2, "quintic": 1, "linear": 0}  # the most probable model on top
    for name, row in table.iterrows():
        point = drawn(collection, "point")[name]
        assert np.asarray(point["x"]).item() == row["log_evidence"]
        assert np.asarray(point["y"]).item() == places[name]
        for visual, count in (("one_se", 1), ("two_se", 2)):
            bar = np.asarray(drawn(collection, visual)[name]["x"])
            np.testing.assert_allclose(
                bar, row["log_evidence"] + count * row["se"] * np.array([-1, 1])
            )


def test_numbers_beside_the_points(table, estimates):
    text = drawn(plot_evidence(table, backend="none"), "text")
    assert text["cubic"]["string"] == "-5.00 ± 0.30"
    assert text["cubic"]["horizontal_align"] == "right"
    assert text["linear"]["horizontal_align"] == "left"
    assert drawn(plot_evidence(estimates, backend="none"), "text")["rough"]["string"] == "-5.30"


def test_a_small_error_is_not_written_as_none(table):
    collection = plot_evidence(table.assign(se=0.004), backend="none")
    assert drawn(collection, "text")["cubic"]["string"] == "-5.000 ± 0.004"


def test_numbers_at_the_axis_do_not_overlap():
    evidences = {"a": an_evidence(-4919.75, 0.004), "b": an_evidence(-4919.66, 0.004)}
    figure = plot_evidence(evidences).viz["figure"].item()
    figure.canvas.draw()
    (axes,) = figure.axes
    labels = axes.get_xticklabels()
    assert len(labels) > 2
    assert all(label.get_text()[1:].startswith("4919.") for label in labels)
    boxes = [label.get_window_extent() for label in labels]
    gaps = [right.x0 - left.x1 for left, right in pairwise(boxes)]
    assert min(gaps) > 5


def test_an_estimate_without_error_has_no_bar(estimates):
    collection = plot_evidence(estimates, backend="none")
    assert drawn(collection, "point")["rough"] is not None
    assert drawn(collection, "one_se")["rough"] is None
    assert drawn(collection, "one_se")["bridge"] is not None


def test_estimators_from_a_group(estimates):
    idata = xr.DataTree()
    for evidence in estimates.values():
        store_evidence(idata, evidence, {})
    one, other = (plot_evidence(given, backend="none") for given in (estimates, idata))
    for visual in ("point", "one_se"):
        for name in estimates:
            a, b = drawn(one, visual)[name], drawn(other, visual)[name]
            assert (a is None) == (b is None)
            if a is not None:
                np.testing.assert_array_equal(a["x"], b["x"])


@pytest.mark.parametrize(
    "given", [xr.DataTree(), {}, {"a": 3}, pd.DataFrame({"prob": [1.0]}), None]
)
def test_what_is_refused(given):
    with pytest.raises(ModelError, match="idata_or_table must be a table of compare_evidence"):
        plot_evidence(given)
