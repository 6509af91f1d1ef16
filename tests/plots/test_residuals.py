"""Innovations over time, their correlations and the predictions, as drawn."""

import numpy as np
import pytest
import xarray as xr

from pymc_statespace_filters import plot_filter_health, plot_residuals
from pymc_statespace_filters.errors import ModelError
from tests.plots.conftest import TIMES
from tests.plots.drawn import drawn


@pytest.fixture(scope="module")
def collection(diagnostics_with_inputs):
    return plot_residuals(diagnostics_with_inputs, backend="none")


def standardised(diagnostics):
    return diagnostics["filter_diagnostics"]["d_innovation"].values / [0.5, 2.0]


def test_innovations_are_divided_by_their_standard_deviations(collection, diagnostics):
    seen = drawn(collection, "seen", "innovation")
    z = standardised(diagnostics)
    np.testing.assert_array_equal(seen["speed"]["x"], TIMES)
    np.testing.assert_allclose(seen["speed"]["y"], z[:, 1])
    np.testing.assert_array_equal(seen["position"]["x"], np.delete(TIMES, 3))
    band = drawn(collection, "expected", "innovation")["speed"]
    assert (band["ymin"], band["ymax"]) == (-1.96, 1.96)


def heights(bars):
    return np.asarray(bars["y"]).reshape(-1, 3)[:, 1]


def test_autocorrelation_and_its_band(collection):
    seen = drawn(collection, "seen", "autocorrelation")["speed"]
    np.testing.assert_array_equal(np.asarray(seen["x"])[::3], np.arange(1, 11))
    np.testing.assert_allclose(heights(seen), -0.02 * np.arange(1, 11))
    for name, n in (("position", 40), ("speed", 41)):  # of one, an observation is missing
        band = drawn(collection, "expected", "autocorrelation")[name]
        np.testing.assert_allclose([-band["ymin"], band["ymax"]], 1.96 / np.sqrt(n))


def test_each_input_has_a_panel(collection, diagnostics_with_inputs):
    found = diagnostics_with_inputs["filter_diagnostics"]["d_input_correlation"]
    for name in ("force", "heat"):
        seen = drawn(collection, "seen", f"input_{name}")["position"]
        np.testing.assert_array_equal(np.asarray(seen["x"])[::3], np.arange(11))
        expected = found.sel(input=name, observable="position")
        np.testing.assert_allclose(heights(seen), expected)
        band = drawn(collection, "expected", f"input_{name}")["position"]
        np.testing.assert_allclose(band["ymax"], 1.96 / np.sqrt(40))


def test_a_system_without_inputs_has_three_panels(diagnostics):
    panels = plot_residuals(diagnostics, backend="none").viz["plot"]
    assert list(panels.data_vars) == ["innovation", "autocorrelation", "prediction"]


@pytest.mark.parametrize("has_record", [True, False])
def test_innovations_against_the_prediction(has_record, diagnostics):
    group = diagnostics["filter_diagnostics"].to_dataset()
    tree, predicted = {"filter_diagnostics": group}, group["d_residual"] + 7.0
    if has_record:
        predicted = xr.full_like(predicted, 3.0)
        record = group["d_innovation"] + predicted
        tree["observed_data"] = record.to_dataset(name="d")
    collection = plot_residuals(xr.DataTree.from_dict(tree), backend="none")
    seen = drawn(collection, "seen", "prediction")["speed"]
    np.testing.assert_allclose(seen["x"], predicted.sel(observable="speed"))
    np.testing.assert_allclose(seen["y"], standardised(diagnostics)[:, 1])
    band = drawn(collection, "expected", "prediction")["speed"]
    assert band["ymax"] == 1.96


def test_one_column_of_labelled_panels_for_each_observable(diagnostics_with_inputs):
    tree = diagnostics_with_inputs.copy(deep=True)
    tree["filter_diagnostics"]["d_innovation"].attrs["units"] = {"speed": "m/s"}
    tree["filter_diagnostics"]["d_time"].attrs["units"] = "s"
    axes = plot_residuals(tree).viz["figure"].item().axes
    left, right = axes[::2], axes[1::2]
    assert [len({one.get_position().x0 for one in column}) for column in (left, right)] == [1, 1]
    assert (left[0].get_title(), right[0].get_title()) == ("position", "speed")
    assert [(one.get_xlabel(), one.get_ylabel()) for one in right] == [
        ("time (s)", "standardised innovation"),
        ("lag (observations)", "autocorrelation"),
        ("lag of force (observations)", "correlation"),
        ("lag of heat (observations)", "correlation"),
        ("predicted speed (m/s)", "standardised innovation"),
    ]


def test_what_is_refused(diagnostics):
    with pytest.raises(ModelError, match=r"'filter_diagnostics': run psf.filter_diagnostics\("):
        plot_residuals(xr.DataTree())
    with pytest.raises(ModelError, match=r"var_name must be one of \['d'\], got 'e'"):
        plot_residuals(diagnostics, var_name="e")
    old = diagnostics["filter_diagnostics"].to_dataset()[["d_residual", "d_pit"]]
    with pytest.raises(ModelError, match=r"no innovations: run psf\.filter_diag"):
        plot_residuals(xr.DataTree.from_dict({"filter_diagnostics": old}))


@pytest.mark.parametrize("plot", [plot_residuals, plot_filter_health])
def test_what_has_no_value_has_no_panel(plot, diagnostics_with_inputs):
    group = diagnostics_with_inputs["filter_diagnostics"].to_dataset().copy(deep=True)
    for name in ("residual", "pit", "innovation", "autocorrelation", "input_correlation"):
        group[f"d_{name}"].loc[{"observable": "speed"}] = np.nan
    group["d_input_correlation"].loc[{"input": "heat"}] = np.nan
    collection = plot(xr.DataTree.from_dict({"filter_diagnostics": group}), backend="none")
    assert list(collection.data["observable"].values) == ["position"]
    assert "input_heat" not in collection.data
    assert all(collection.data[name].notnull().any() for name in collection.data)
    group["d_input_correlation"][:] = np.nan  # no input ever changes
    collection = plot(xr.DataTree.from_dict({"filter_diagnostics": group}), backend="none")
    assert not {"inputs", "input_force"} & set(collection.data)
    unseen = group.where(group["observable"] == "")
    with pytest.raises(ModelError, match="must be an observation to compare"):
        plot(xr.DataTree.from_dict({"filter_diagnostics": unseen}))
