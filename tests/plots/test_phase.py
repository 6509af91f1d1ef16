"""Draws, medians and truth in the plane of two quantities, as drawn."""

import numpy as np
import pytest
import xarray as xr

from pymc_statespace_filters import plot_phase
from pymc_statespace_filters.errors import ModelError
from tests.plots.conftest import TIMES

SINE, COSINE = np.sin(TIMES), 10 * np.cos(TIMES)


def only(collection, visual):
    return collection.viz[visual]["phase"].item()


def test_the_path_of_the_medians_and_draws(states):
    collection = plot_phase(states, "speed", "position", n_draws=2, backend="none")
    median = only(collection, "median")
    np.testing.assert_allclose(median["x"], COSINE + 49.5)
    np.testing.assert_allclose(median["y"], SINE + 49.5)
    draws = only(collection, "draws")
    x, y = (np.asarray(draws[axis]).reshape(2, 42) for axis in "xy")
    assert np.isnan(y[:, -1]).all()  # draws are not joined
    np.testing.assert_allclose(x[:, :-1], np.add.outer([0, 99], COSINE))
    np.testing.assert_allclose(y[:, :-1], np.add.outer([0, 99], SINE))
    assert only(collection, "x_label")["string"] == "speed"


def test_a_quantity_of_the_user(states):
    position = states["smoothed_states"]["d_states"].sel(state="position")
    collection = plot_phase(states, "position", (position**3).rename("force"), backend="none")
    np.testing.assert_allclose(only(collection, "median")["y"], (SINE + 49.5) ** 3, rtol=1e-3)
    assert only(collection, "y_label")["string"] == "force"


def test_filtered_states_are_points(states):
    settings = {"group": "filtered_states", "n_draws": 3, "backend": "none"}
    draws = only(plot_phase(states, "position", "speed", **settings), "draws")
    assert draws["function"] == "scatter"
    steps = np.array([0, 49, 99])[:, None]
    np.testing.assert_allclose(np.sort(draws["x"]), np.sort((SINE[::5] - steps).ravel()))
    np.testing.assert_allclose(np.sort(draws["y"]), np.sort((COSINE[::5] - steps).ravel()))
    difference = np.sort(draws["y"] - draws["x"])  # of each point, whatever the draw
    np.testing.assert_allclose(difference, np.sort(np.tile((COSINE - SINE)[::5], 3)))


@pytest.mark.parametrize("form", ["pair", "simulate"])
def test_truth(form, states):
    simulated = xr.Dataset(
        {"states": (("step", "state"), np.stack([SINE, COSINE], axis=1))},
        coords={"time": ("step", TIMES), "state": ["position", "speed"]},
    )
    given = (COSINE, SINE) if form == "pair" else simulated
    truth = only(plot_phase(states, "speed", "position", truth=given, backend="none"), "truth")
    np.testing.assert_array_equal(truth["x"], COSINE)
    np.testing.assert_array_equal(truth["y"], SINE)


def test_what_is_refused(states):
    force = states["smoothed_states"]["d_states"]
    with pytest.raises(ModelError, match=r"x must be among \['position', 'speed'\], got \['v'\]"):
        plot_phase(states, "v", "speed")
    with pytest.raises(ModelError, match=r"y must have dimensions \(chain, draw, time\), got"):
        plot_phase(states, "position", force)
    with pytest.raises(ModelError, match="truth must be a pair"):
        plot_phase(states, "position", force.sel(state="speed"), truth=xr.Dataset())
    with pytest.raises(ModelError, match=r"two arrays of one length.*\[\(41,\), \(3,\)\]"):
        plot_phase(states, "position", "speed", truth=(SINE, SINE[:3]))
    with pytest.raises(ModelError, match="y must be at the times of x"):
        plot_phase(states, "position", force.sel(state="speed").isel(d_time=slice(3)))
