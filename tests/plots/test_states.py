"""Bands, bars, truth, record and draws of states, as drawn."""

import numpy as np
import pytest
import xarray as xr

from pymc_statespace_filters import ModelError, plot_states
from tests.plots.conftest import TIMES, states_group
from tests.plots.drawn import drawn

SINE = np.sin(TIMES)


def test_bands_and_median_are_quantiles_of_the_draws(states):
    collection = plot_states(states, backend="none")
    for prob, tail in ((90, 0.05), (50, 0.25)):
        band = drawn(collection, f"band_{prob}")["position"]
        np.testing.assert_array_equal(band["x"], TIMES)
        np.testing.assert_allclose(band["y_bottom"], SINE + 99 * tail)
        np.testing.assert_allclose(band["y_top"], SINE + 99 * (1 - tail))
    median = drawn(collection, "median")["speed"]
    np.testing.assert_allclose(median["y"], 10 * np.cos(TIMES) + 49.5)


def test_states_at_observations_are_bars_with_nothing_between(states):
    collection = plot_states(states, group="filtered_states", backend="none")
    assert not {"band_90", "median"} & set(collection.viz.children)
    bar = drawn(collection, "bar_90")["position"]
    ends = np.asarray(bar["y"]).reshape(-1, 3)
    np.testing.assert_array_equal(np.asarray(bar["x"])[::3], TIMES[::5])
    np.testing.assert_allclose(ends[:, 0], SINE[::5] - 99 * 0.95)
    np.testing.assert_allclose(ends[:, 1], SINE[::5] - 99 * 0.05)
    assert np.isnan(ends[:, 2]).all()


def test_the_record_is_in_the_panel_of_its_state(states):
    (point,) = [p for p in drawn(plot_states(states, backend="none"), "data").values() if p]
    seen = np.delete(np.arange(9), 3)  # what is missing is no point
    np.testing.assert_array_equal(point["x"], TIMES[::5][seen])
    np.testing.assert_allclose(point["y"], SINE[::5][seen])
    moved = plot_states(states, observables={"speed": "position"}, backend="none")
    data = drawn(moved, "data")
    assert data["position"] is None
    np.testing.assert_allclose(data["speed"]["y"], SINE[::5][seen])


def test_a_state_without_draws_for_a_while_has_a_gap():
    values = np.arange(10.0).reshape(1, 10, 1, 1) + np.zeros((1, 10, 41, 1))
    values[:, :, 10:15] = np.nan
    values[:, 0, 20:] = np.nan  # a draw that failed does not count
    tree = xr.DataTree.from_dict({"filtered_states": states_group(values, ["x"])})
    collection = plot_states(tree, backend="none")
    fills = [
        thing
        for thing in collection.viz["plot"].item(0)
        if thing["function"] == "fill_between_y" and thing["alpha"] == 0.4
    ]
    assert [fill["x"].size for fill in fills] == [10, 26]
    np.testing.assert_allclose(fills[0]["y_bottom"], 2.25)
    np.testing.assert_allclose(fills[1]["y_bottom"][[4, 5]], [2.25, 3.0])
    np.testing.assert_array_equal(
        np.isnan(drawn(collection, "median")["x"]["y"]), np.isin(np.arange(41), np.arange(10, 15))
    )


def test_draws_are_paths_if_smoothed_and_points_if_filtered(states):
    paths = drawn(plot_states(states, n_draws=3, backend="none"), "draws")["speed"]
    assert paths["function"] == "line"
    lines = np.asarray(paths["y"]).reshape(3, 42)
    for line, draw in zip(lines, (0, 49, 99), strict=True):
        np.testing.assert_allclose(line[:-1], 10 * np.cos(TIMES) + draw)
    filtered = plot_states(states, group="filtered_states", n_draws=3, backend="none")
    points = drawn(filtered, "draws")["speed"]
    assert points["function"] == "scatter"
    assert points["y"].size == 27
    group = states["smoothed_states"].to_dataset().assign_attrs(at="observations")
    at_observations = xr.DataTree.from_dict({"smoothed_states": group})
    points = drawn(plot_states(at_observations, n_draws=3, backend="none"), "draws")["speed"]
    assert points["function"] == "scatter"  # a line would claim something for the time between


@pytest.mark.parametrize("form", ["array", "data array", "simulate", "one state"])
def test_truth(form, states):
    both = np.stack([SINE, -SINE], axis=1)
    simulated = xr.Dataset(
        {"states": (("step", "state"), both[:, ::-1])},
        coords={"time": ("step", TIMES), "state": ["speed", "position"]},
    )
    given = {
        "array": both,
        "data array": xr.DataArray(both, coords=[("t", TIMES), ("state", ["position", "speed"])]),
        "simulate": simulated,
        "one state": simulated.sel(state=["position"]),
    }
    truth = drawn(plot_states(states, truth=given[form], backend="none"), "truth")
    np.testing.assert_array_equal(truth["position"]["x"], TIMES)
    np.testing.assert_array_equal(truth["position"]["y"], SINE)
    if form == "one state":
        assert truth["speed"] is None
    else:
        np.testing.assert_array_equal(truth["speed"]["y"], -SINE)


def test_truth_ends_where_the_states_do(states):
    times = np.arange(-10, 60) / 10
    true = xr.DataArray(times[:, None], coords=[("time", times), ("state", ["position"])])
    truth = drawn(plot_states(states, truth=true, backend="none"), "truth")["position"]
    np.testing.assert_allclose(truth["y"], TIMES, atol=1e-12)


def test_dimensions_of_another_name(states):
    group = states["smoothed_states"].to_dataset()
    group = group.rename(d_time="month", state="d_state")
    tree = xr.DataTree.from_dict({"smoothed_states": group})
    one, other = (drawn(plot_states(s, backend="none"), "median") for s in (states, tree))
    np.testing.assert_array_equal(one["speed"]["y"], other["speed"]["y"])


def test_panels_and_their_names(states):
    states = states.copy(deep=True)
    states["smoothed_states"]["d_time"].attrs["units"] = "s"
    figure = plot_states(states).viz["figure"].item()
    assert [axes.get_ylabel() for axes in figure.axes] == ["position", "speed"]
    assert [axes.get_xlabel() for axes in figure.axes] == ["", "time (s)"]
    key = [text.get_text() for text in figure.legends[0].get_texts()]
    assert key == ["median", "50 %", "90 %", "data"]
    unseen = plot_states(states, states="speed").viz["figure"].item()
    assert [axes.get_ylabel() for axes in unseen.axes] == ["speed"]
    assert [text.get_text() for text in unseen.legends[0].get_texts()] == key[:-1]


def test_many_states():
    values = np.random.default_rng(1).normal(size=(1, 5, 41, 12))
    group = states_group(values, [f"x{i}" for i in range(12)])
    tree = xr.DataTree.from_dict({"smoothed_states": group})
    collection = plot_states(tree, backend="plotly")  # it limits the room between panels
    assert collection.viz["median"]["states"].size == 12


def test_what_is_refused(states):
    with pytest.raises(ModelError, match=r"no group 'smoothed_states': run psf.smoothed_states\("):
        plot_states(xr.DataTree())
    with pytest.raises(ModelError, match=r"no group 'predictions': run psf.forecast\(idata"):
        plot_states(states, group="predictions")
    with pytest.raises(ModelError, match=r"var_name must be one of \['d'\], got 'y'"):
        plot_states(states, var_name="y")
    with pytest.raises(ModelError, match=r"n_draws must be an integer of at least 0, got 0\.5"):
        plot_states(states, n_draws=0.5)
    with pytest.raises(ModelError, match=r"states must be among \['position', 'speed'\], got \['v"):
        plot_states(states, states=["v"])
    with pytest.raises(ModelError, match=r"its values must be among \['position'\], got \['y0'\]"):
        plot_states(states, observables={"speed": "y0"})
    with pytest.raises(ModelError, match=r"truth must have shape \(41, 2\).* got shape \(41,\)"):
        plot_states(states, truth=SINE)
    other = xr.DataArray(SINE[:, None], coords=[("time", TIMES), ("state", ["x0"])])
    with pytest.raises(ModelError, match=r"truth must have some of \['position', 'speed'\]"):
        plot_states(states, truth=other)
