"""Predicted observations, the end of the record and what came, as drawn."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.dates import ConciseDateFormatter

from pymc_statespace_filters import plot_forecast
from pymc_statespace_filters.errors import ModelError
from tests.plots.conftest import TIMES
from tests.plots.drawn import drawn


def test_bands_are_quantiles_of_predicted_observations(forecast):
    collection = plot_forecast(forecast, backend="none")
    for prob, tail in ((90, 0.05), (50, 0.25)):
        band = drawn(collection, f"band_{prob}")["speed"]
        np.testing.assert_array_equal(band["x"], TIMES[31:])
        np.testing.assert_allclose(band["y_bottom"], 99 * tail)
        np.testing.assert_allclose(band["y_top"], 99 * (1 - tail))
    assert drawn(collection, "end")["position"]["x"] == TIMES[30]


def test_so_much_of_the_record_is_drawn(forecast):
    data = drawn(plot_forecast(forecast, backend="none"), "data")
    np.testing.assert_allclose(data["speed"]["x"], TIMES[10:31])  # twice one second
    np.testing.assert_allclose(data["speed"]["y"], np.cos(TIMES[10:31]))
    nothing = plot_forecast(forecast, n_past=0, backend="none")
    assert "data" not in nothing.viz.children
    for n_past, first in ((3, 28), (100, 0)):
        data = drawn(plot_forecast(forecast, n_past=n_past, backend="none"), "data")
        np.testing.assert_allclose(data["position"]["x"], TIMES[first:31])


def test_of_a_short_forecast_ten_observations_are_drawn(forecast):
    predictions = forecast["predictions"].isel(d_time=slice(2)).to_dataset()
    short = xr.DataTree.from_dict(
        {"predictions": predictions, "observed_data": forecast["observed_data"].to_dataset()}
    )
    assert drawn(plot_forecast(short, backend="none"), "data")["speed"]["x"].size == 10


def test_what_came_is_drawn_after_the_end_of_the_record_alone(forecast):
    came = xr.DataArray(
        np.stack([TIMES, -TIMES], axis=1), coords=[("t", TIMES), ("observable", ["speed", "x"])]
    )
    truth = drawn(plot_forecast(forecast, truth=came, backend="none"), "truth")
    assert truth["position"] is None
    np.testing.assert_array_equal(truth["speed"]["x"], TIMES[31:])
    np.testing.assert_array_equal(truth["speed"]["y"], TIMES[31:])
    simulated = xr.Dataset(
        {"observations": (("obs", "observable"), came.values)},
        coords={"obs_time": ("obs", TIMES), "observable": ["speed", "position"]},
    )
    truth = drawn(plot_forecast(forecast, truth=simulated, backend="none"), "truth")
    np.testing.assert_array_equal(truth["position"]["y"], -TIMES[31:])


def test_what_came_is_drawn_at_dates(forecast):
    dates = np.datetime64("2024-01-01") + np.arange(TIMES.size).astype("m8[D]")
    dated = xr.DataTree.from_dict(
        {
            "predictions": forecast["predictions"].to_dataset().assign_coords(d_time=dates[31:]),
            "observed_data": forecast["observed_data"]
            .to_dataset()
            .assign_coords(d_time=dates[:31]),
        }
    )
    truth = drawn(plot_forecast(dated, truth=np.ones((10, 2)), backend="none"), "truth")
    np.testing.assert_array_equal(truth["speed"]["x"], dates[31:])


def test_dimensions_of_the_users_names(forecast):
    renamed = xr.DataTree.from_dict(
        {
            name: group.to_dataset().rename(d_time="month", observable="country")
            for name, group in forecast.children.items()
        }
    )
    one, other = (drawn(plot_forecast(f, backend="none"), "data") for f in (forecast, renamed))
    np.testing.assert_array_equal(one["speed"]["y"], other["speed"]["y"])


@pytest.mark.parametrize("transform", [np.exp, {"position": np.exp, "speed": np.exp}])
def test_a_function_of_predictions_record_and_truth(transform, forecast):
    truth = np.zeros((10, 2))
    collection = plot_forecast(forecast, truth=truth, transform=transform, backend="none")
    band = drawn(collection, "band_90")["speed"]
    np.testing.assert_allclose(band["y_bottom"], np.quantile(np.exp(np.arange(100)), 0.05))
    data = drawn(collection, "data")["speed"]
    np.testing.assert_allclose(data["y"], np.exp(np.cos(TIMES[10:31])))
    np.testing.assert_array_equal(drawn(collection, "truth")["speed"]["y"], np.ones(10))
    assert drawn(collection, "y_label")["speed"]["string"] == "exp(speed)"


def test_errors_are_observations_minus_the_median(forecast):
    truth = np.stack([np.arange(10.0), np.full(10, np.nan)], axis=1)
    collection = plot_forecast(forecast, truth=truth, errors=True, backend="none")
    seen = drawn(collection, "errors")
    np.testing.assert_allclose(seen["position"]["y"], np.arange(10) - 49.5)
    np.testing.assert_array_equal(seen["position"]["x"], TIMES[31:])
    assert seen["speed"] is None
    band = drawn(collection, "band_50")["speed"]
    np.testing.assert_allclose(band["y_top"], 99 * 0.75 - 49.5)
    np.testing.assert_allclose(drawn(collection, "median")["speed"]["y"], 0.0, atol=1e-12)
    assert drawn(collection, "y_label")["position"]["string"] == "error of position"
    assert not {"data", "truth", "end"} & set(collection.viz.children)
    functions = [thing["function"] for thing in collection.viz["plot"].item(0) if "x" in thing]
    assert functions[:4] == ["fill_between_y", "fill_between_y", "scatter", "line"]


def test_errors_of_a_simulated_truth_at_some_of_the_times(forecast):
    times = np.append(TIMES[:36] + 1e-12, 99.0)
    simulated = xr.Dataset(
        {"observations": (("obs", "observable"), np.tile(np.arange(37.0), (2, 1)).T)},
        coords={"obs_time": ("obs", times), "observable": ["speed", "position"]},
    )
    seen = drawn(plot_forecast(forecast, truth=simulated, errors=True, backend="none"), "errors")
    np.testing.assert_array_equal(seen["speed"]["x"], TIMES[31:36])
    np.testing.assert_allclose(seen["speed"]["y"], np.arange(31, 36) - 49.5)


def test_a_free_run_beside_the_record(free_run, forecast):
    collection = plot_forecast(free_run, group="free_run", backend="none")
    data = drawn(collection, "data")["speed"]
    np.testing.assert_array_equal(data["x"], TIMES[:31])
    np.testing.assert_allclose(data["y"], np.cos(TIMES[:31]))
    median = drawn(collection, "median")["speed"]
    np.testing.assert_allclose(median["y"], np.cos(TIMES[:31]) + 0.25)
    assert "end" not in collection.viz.children  # nothing is predicted after the record
    errors = plot_forecast(free_run, group="free_run", errors=True, backend="none")
    np.testing.assert_allclose(drawn(errors, "errors")["speed"]["y"], -0.25)
    truth = np.ones((31, 2))
    errors = plot_forecast(free_run, group="free_run", truth=truth, errors=True, backend="none")
    np.testing.assert_allclose(
        drawn(errors, "errors")["speed"]["y"], 0.75 - np.cos(TIMES[:31])
    )  # the truth goes before the record
    shown = plot_forecast(free_run, group="free_run", truth=truth, backend="none")
    np.testing.assert_array_equal(drawn(shown, "truth")["speed"]["x"], TIMES[:31])


def test_a_free_run_alone_needs_no_name_of_its_group(free_run):
    alone = xr.DataTree.from_dict({name: free_run[name] for name in ("free_run", "observed_data")})
    medians = [
        drawn(plot_forecast(alone, group=group, backend="none"), "median")["speed"]["y"]
        for group in (None, "free_run")
    ]
    np.testing.assert_array_equal(*medians)


def test_a_free_run_on_the_second_part_of_the_record(free_run):
    part = free_run.copy(deep=True)
    part["free_run"] = part["free_run"].isel(d_time=slice(20, None))
    for n_past, first in ((None, 0), (3, 17), (0, 20)):
        data = drawn(plot_forecast(part, group="free_run", n_past=n_past, backend="none"), "data")
        np.testing.assert_array_equal(data["speed"]["x"], TIMES[first:31])


def test_units_of_observables(forecast):
    forecast = forecast.copy(deep=True)
    forecast["observed_data"]["d"].attrs["units"] = ["m", "m/s"]
    forecast["observed_data"]["d_time"].attrs["units"] = "s"
    axes = plot_forecast(forecast).viz["figure"].item().axes
    assert [one.get_ylabel() for one in axes] == ["position (m)", "speed (m/s)"]
    assert axes[-1].get_xlabel() == "time (s)"
    label = drawn(
        plot_forecast(forecast, truth=np.ones((10, 2)), errors=True, backend="none"), "y_label"
    )
    assert label["speed"]["string"] == "error of speed (m/s)"


def test_errors_at_dates(forecast):
    """Whatever the scale of time, the errors are those of the numbers."""
    dated = forecast.copy(deep=True)
    for group in ("observed_data", "predictions"):
        times = dated[group]["d_time"]
        dates = np.datetime64("2020-01-01", "us") + (times.values * 1e6).astype("timedelta64[us]")
        dated[group] = dated[group].to_dataset().assign_coords(d_time=dates)
    found = [
        drawn(plot_forecast(one, truth=np.ones((10, 2)), errors=True, backend="none"), "errors")
        for one in (forecast, dated)
    ]
    np.testing.assert_array_equal(*(one["speed"]["y"] for one in found))
    axes = plot_forecast(dated, backend="matplotlib").viz["figure"].item().axes
    assert isinstance(axes[0].xaxis.get_major_formatter(), ConciseDateFormatter)
    with pytest.raises(ModelError, match=r"predictions, 2020-01-01T00:00:03\.1\d* to .*got none"):
        plot_forecast(dated, errors=True)


def test_what_is_refused(forecast):
    with pytest.raises(ModelError, match=r"no group 'free_run': run psf.free_run\(idata, model\)"):
        plot_forecast(forecast, group="free_run")
    with pytest.raises(
        ModelError, match=r"times of the predictions, 3\.1 to 4, got none: give them"
    ):
        plot_forecast(forecast, errors=True)
    with pytest.raises(ModelError, match=r"transform must be among \['position', 'speed'\], got"):
        plot_forecast(forecast, transform={"x": np.exp})
    with pytest.raises(ModelError, match=r"no group 'predictions': run psf.forecast\(idata, model"):
        plot_forecast(xr.DataTree())
    with pytest.raises(ModelError, match="idata must be a DataTree of draws, got Dataset"):
        plot_forecast(xr.Dataset())
    with pytest.raises(ModelError, match="n_past must be an integer of at least 0, got -1"):
        plot_forecast(forecast, n_past=-1)
    with pytest.raises(ModelError, match=r"truth must have shape \(10, 2\).*got shape \(10,\)"):
        plot_forecast(forecast, truth=np.zeros(10))
