"""Summed scores over time, as drawn."""

import numpy as np
import pytest
import xarray as xr

from pymc_statespace_filters import plot_drift
from pymc_statespace_filters.diagnostics.constancy.table import DriftScan
from pymc_statespace_filters.errors import ModelError
from tests.plots.conftest import DRIFT_TIMES
from tests.plots.drawn import drawn


def test_sums_bands_and_turns(drift_scan):
    collection = plot_drift(drift_scan, backend="none")
    seen = drawn(collection, "sum", "cumulated")["gain"]
    np.testing.assert_array_equal(seen["x"], DRIFT_TIMES)
    np.testing.assert_allclose(seen["y"], -np.sin(np.pi * np.arange(50) / 49))
    band = drawn(collection, "constant", "cumulated")["a"]
    assert (set(band["y_bottom"]), set(band["y_top"])) == ({-0.6}, {0.6})
    turn = drawn(collection, "turn", "cumulated")
    assert [turn[name]["x"] for name in ("gain", "a")] == [[2.5], [0.3]]


def test_chosen_parameters(drift_scan):
    collection = plot_drift(drift_scan, parameters="a", backend="none")
    assert list(collection.viz["plot"]["parameter"].values) == ["a"]


def test_the_record_of_a_panel(drift_scan):
    rows = xr.DataArray(np.repeat(["A", "B"], 25), dims="row")
    paths = drift_scan.paths.rename_dims(time="row").reset_index("time")
    paths = paths.assign_coords(record=rows)
    scan = DriftScan(drift_scan.assign(record=["B", "A"]), paths=paths)
    first = drawn(plot_drift(scan, backend="none"), "sum", "cumulated")["gain"]
    np.testing.assert_array_equal(first["x"], DRIFT_TIMES[25:])
    other = plot_drift(scan, record="A", backend="none")
    np.testing.assert_array_equal(drawn(other, "sum", "cumulated")["a"]["x"], DRIFT_TIMES[:25])
    with pytest.raises(ModelError, match=r"record must be one of \['A', 'B'\], got 'C'"):
        plot_drift(scan, record="C")


def test_what_is_refused(drift_scan):
    with pytest.raises(ModelError, match="of which a part has no paths, got DataFrame"):
        plot_drift(drift_scan.iloc[:1])
    with pytest.raises(ModelError, match="parameters"):
        plot_drift(drift_scan, parameters="b")
    with pytest.raises(ModelError, match="record must be None without a panel, got 'A'"):
        plot_drift(drift_scan, record="A")


def test_a_parameter_without_scores_has_no_panel(drift_scan):
    """As one at a bound."""
    paths = drift_scan.paths.copy(deep=True)
    paths["cumulated"].loc["a"] = np.nan
    scan = DriftScan(drift_scan, paths=paths)
    assert list(drawn(plot_drift(scan, backend="none"), "sum")) == ["gain"]
    with pytest.raises(ModelError, match=r"parameters must be among \['gain'\], got \['a'\]"):
        plot_drift(scan, parameters="a")
    nothing = DriftScan(drift_scan, paths=paths.where(False))
    with pytest.raises(ModelError, match="scores of none"):
        plot_drift(nothing)
