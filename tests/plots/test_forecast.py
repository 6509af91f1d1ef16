"""Predicted observations, the end of the record and what came, as drawn."""

import numpy as np
import pytest
import xarray as xr

from pymc_statespace_filters import ModelError, plot_forecast
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
    nothing = drawn(plot_forecast(forecast, n_past=0, backend="none"), "data")
    assert set(nothing.values()) == {None}
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


def test_dimensions_of_the_users_names(forecast):
    renamed = xr.DataTree.from_dict(
        {
            name: group.to_dataset().rename(d_time="month", observable="country")
            for name, group in forecast.children.items()
        }
    )
    one, other = (drawn(plot_forecast(f, backend="none"), "data") for f in (forecast, renamed))
    np.testing.assert_array_equal(one["speed"]["y"], other["speed"]["y"])


def test_what_is_refused(forecast):
    with pytest.raises(ModelError, match=r"no group 'predictions': run psf.forecast\(idata, model"):
        plot_forecast(xr.DataTree())
    with pytest.raises(ModelError, match="idata must be a DataTree of draws, got Dataset"):
        plot_forecast(xr.Dataset())
    with pytest.raises(ModelError, match="n_past must be an integer of at least 0, got -1"):
        plot_forecast(forecast, n_past=-1)
    with pytest.raises(ModelError, match=r"truth must have shape \(10, 2\).*got shape \(10,\)"):
        plot_forecast(forecast, truth=np.zeros(10))
