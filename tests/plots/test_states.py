"""Bands, bars, truth, record and draws of states, as drawn."""

import numpy as np
import pytest
import xarray as xr

from pymc_statespace_filters import plot_states
from pymc_statespace_filters.errors import ModelError
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


def test_states_at_a_few_dates_are_bars(states):
    dates = np.datetime64("2024-01-07", "us") + 7 * np.arange(TIMES.size).astype("m8[D]")
    group = states["filtered_states"].to_dataset()
    dates = dates[: group.sizes["d_time"]]
    tree = xr.DataTree.from_dict({"filtered_states": group.assign_coords(d_time=dates)})
    bar = drawn(plot_states(tree, backend="none"), "bar_90")["position"]
    np.testing.assert_array_equal(np.asarray(bar["x"])[::3], dates)
    np.testing.assert_allclose(np.asarray(bar["y"])[::3], SINE[::5] - 99 * 0.95)
    assert np.isnan(np.asarray(bar["y"])[2::3]).all()


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


def test_a_regime_has_ribbons_as_thick_as_its_probability():
    """Beside a continuous state; the first regime has no draw at the first time."""
    rng = np.random.default_rng(1)
    regime = (rng.uniform(size=(2, 50, 6)) < np.linspace(1, 0.2, 6)).astype(float)
    values = np.stack([regime, rng.standard_normal((2, 50, 6))], axis=-1)
    group = xr.Dataset(
        {"d_states": (("chain", "draw", "d_time", "state"), values)},
        coords={"d_time": np.arange(6.0), "state": ["regime", "speed"]},
    )
    collection = plot_states(
        xr.DataTree.from_dict({"smoothed_states": group}), truth=values[0, 0], backend="none"
    )
    ribbon = drawn(collection, "probability")["regime"]
    np.testing.assert_allclose(ribbon["y_top"] - 1, 0.45 * regime.mean(axis=(0, 1)))
    np.testing.assert_allclose(ribbon["y_bottom"] + ribbon["y_top"], 2.0)
    band = drawn(collection, "band_90")
    assert band["regime"] is None
    assert band["speed"] is not None
    for backend in ("matplotlib", "plotly", "bokeh"):
        plot_states(xr.DataTree.from_dict({"smoothed_states": group}), backend=backend)
        alone = plot_states(
            xr.DataTree.from_dict({"smoothed_states": group}), states="regime", backend=backend
        )
        assert "band_90" not in alone.viz.children


def test_the_ticks_of_a_regime_are_its_values():
    """The middle of the ribbons of 100 times, without rounding: zero is not 1e-17."""
    regime = np.random.default_rng(1).integers(0, 2, (2, 50, 100, 1)).astype(float)
    group = xr.Dataset(
        {"d_states": (("chain", "draw", "d_time", "state"), regime)},
        coords={"d_time": np.arange(100.0), "state": ["regime"]},
    )
    collection = plot_states(xr.DataTree.from_dict({"smoothed_states": group}), backend="none")
    panel = collection.viz["plot"].item(0)
    (ticks,) = (thing for thing in panel if thing["function"] == "yticks")
    assert ticks["labels"] == ["0", "1"]


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
    assert key == ["90 %", "50 %", "data", "median"]
    unseen = plot_states(states, states="speed").viz["figure"].item()
    assert [axes.get_ylabel() for axes in unseen.axes] == ["speed"]
    assert [text.get_text() for text in unseen.legends[0].get_texts()] == ["90 %", "50 %", "median"]


def test_many_states():
    values = np.random.default_rng(1).normal(size=(1, 5, 41, 12))
    group = states_group(values, [f"x{i}" for i in range(12)])
    tree = xr.DataTree.from_dict({"smoothed_states": group})
    collection = plot_states(tree, backend="plotly")  # it limits the room between panels
    assert collection.viz["median"]["states"].size == 12


def many_states(n_times, at="observations"):
    """States at so many observations, around 4499.3, observed with an error of 1e-3."""
    times = np.arange(n_times) / 100
    values = 4499.3 + 1e-4 * np.arange(10.0).reshape(1, 10, 1, 1) + np.zeros((1, 10, n_times, 1))
    record = 4499.3 + 1e-3 * np.random.default_rng(1).normal(size=(n_times, 1))
    observed = xr.Dataset(
        {"d": (("d_time", "observable"), record)},
        coords={"d_time": times, "observable": ["position"]},
    )
    return xr.DataTree.from_dict(
        {
            "filtered_states": states_group(values, ["position"], times, at=at),
            "observed_data": observed,
        }
    )


def test_bands_at_more_observations_than_bars_fit():
    few, many = (plot_states(many_states(n), backend="none").viz for n in (200, 201))
    assert "bar_90" in few.children
    assert "band_90" not in few.children
    assert {"band_90", "band_50", "median"} <= set(many.children)
    assert "bar_90" not in many.children
    assert many["band_90"]["states"].item()["x"].size == 201


def test_points_do_not_hide_the_median():
    sizes, opacities = [], []
    for n_times in (40, 3200):
        collection = plot_states(many_states(n_times, at="steps"), backend="none")
        things = collection.viz["plot"].item(0)
        drawn_first_to_last = [thing["function"] for thing in things if "x" in thing]
        assert drawn_first_to_last[:4] == ["fill_between_y", "fill_between_y", "scatter", "line"]
        point = drawn(collection, "data")["position"]
        sizes.append(point["size"])
        opacities.append(point["alpha"])
    assert sizes == [16, 4]  # areas
    assert opacities == [1.0, 0.6]


def test_numbers_at_the_axes_are_written_in_full():
    figure = plot_states(many_states(40)).viz["figure"].item()
    figure.canvas.draw()
    (axes,) = figure.axes
    assert axes.yaxis.get_offset_text().get_text() == ""
    assert axes.get_yticklabels()[1].get_text().startswith("4499.")


def test_years_at_the_time_axis_are_whole_numbers():
    years = np.linspace(1900, 1920, 81)
    group = states_group(np.zeros((1, 10, 81, 1)), ["hare"], years, at="steps")
    figure = plot_states(xr.DataTree.from_dict({"smoothed_states": group})).viz["figure"].item()
    figure.canvas.draw()
    labels = [label.get_text() for label in figure.axes[0].get_xticklabels()]
    assert {"1900", "1905", "1910", "1915", "1920"} <= set(labels)


@pytest.mark.parametrize(
    ("transform", "data"),
    [
        (np.exp, np.exp(SINE[::5])),  # the observable has the name of a state
        ({"speed": np.exp}, SINE[::5]),
        ({"speed": np.exp, "position": np.exp}, np.exp(SINE[::5])),
    ],
)
def test_a_function_of_states_and_truth(transform, data, states):
    both = np.stack([SINE, SINE / 2], axis=1)
    collection = plot_states(
        states,
        group="filtered_states",
        observables={"speed": "position"},
        truth=both[::5],
        transform=transform,
        backend="none",
    )
    seen = np.delete(np.arange(9), 3)
    np.testing.assert_allclose(drawn(collection, "data")["speed"]["y"], data[seen])
    np.testing.assert_allclose(drawn(collection, "truth")["speed"]["y"], np.exp(SINE[::5] / 2))
    bar = np.asarray(drawn(collection, "bar_90")["speed"]["y"]).reshape(-1, 3)
    draws = np.exp(10 * np.cos(TIMES[::5]) - np.arange(100)[:, None])
    np.testing.assert_allclose(bar[:, 0], np.quantile(draws, 0.05, axis=0))
    np.testing.assert_allclose(bar[:, 1], np.quantile(draws, 0.95, axis=0))
    assert drawn(collection, "y_label")["speed"]["string"] == "exp(speed)"


def test_transforms_that_are_refused(states):
    with pytest.raises(ModelError, match=r"transform must be a function of an array.*got 'exp'"):
        plot_states(states, transform="exp")
    with pytest.raises(ModelError, match=r"transform must be among \['position', 'speed'\], got"):
        plot_states(states, transform={"voltage": np.exp})
    with pytest.raises(
        ModelError, match=r"the shape it is given, \(2, 50, 41\) of 'position', got"
    ):
        plot_states(states, transform=lambda x: x.mean(axis=0))


@pytest.mark.parametrize("where", ["variable", "coordinate"])
@pytest.mark.parametrize("units", [["m", "m/s"], {"speed": "m/s", "position": "m"}])
def test_units_of_states(where, units, states):
    states = states.copy(deep=True)
    states["smoothed_states"]["d_states" if where == "variable" else "state"].attrs["units"] = units
    labels = drawn(plot_states(states, backend="none"), "y_label")
    assert {name: label["string"] for name, label in labels.items()} == {
        "position": "position (m)",
        "speed": "speed (m/s)",
    }
    changed = plot_states(states, transform={"speed": np.square}, backend="none")
    assert drawn(changed, "y_label")["speed"]["string"] == "square(speed)"


def test_a_simulation(simulated):
    collection = plot_states(simulated, backend="none")
    path, data = drawn(collection, "path"), drawn(collection, "data")
    assert list(path) == ["position", "speed", "voltage"]
    np.testing.assert_array_equal(path["speed"]["x"], TIMES)
    np.testing.assert_array_equal(path["speed"]["y"], 10 * np.cos(TIMES))
    assert path["voltage"] is None  # no state: a panel of its own
    assert data["speed"] is None
    np.testing.assert_array_equal(data["position"]["y"], SINE[::5] + 0.1)
    np.testing.assert_array_equal(data["voltage"]["x"], TIMES[::5])
    np.testing.assert_array_equal(data["voltage"]["y"], np.arange(9))
    axes = plot_states(simulated).viz["figure"].item().axes
    assert [one.get_ylabel() for one in axes] == ["position", "speed", "voltage"]
    assert axes[-1].get_xlabel() == "time"


def test_a_simulation_with_chosen_states_and_observables(simulated):
    moved = {"speed": "voltage", "position": "position"}
    collection = plot_states(simulated, observables=moved, transform=np.square, backend="none")
    assert list(drawn(collection, "path")) == ["position", "speed"]
    np.testing.assert_array_equal(drawn(collection, "data")["speed"]["y"], np.arange(9))
    np.testing.assert_allclose(drawn(collection, "path")["position"]["y"], SINE**2)
    data = drawn(collection, "data")["position"]["y"]
    np.testing.assert_allclose(data, (SINE[::5] + 0.1) ** 2)
    one = plot_states(simulated, states="speed", backend="none")
    assert list(drawn(one, "path")) == ["speed"]
    assert "data" not in one.viz.children


def test_what_is_refused_of_a_simulation(simulated):
    with pytest.raises(ModelError, match="a DataTree of draws or a result of simulate, got a Data"):
        plot_states(xr.Dataset({"a": 1.0}))
    given = {"group": "smoothed_states", "var_name": "d", "truth": SINE, "n_draws": 3}
    for name, value in given.items():
        with pytest.raises(ModelError, match=f"{name} is for draws of states, got it with a res"):
            plot_states(simulated, **{name: value})


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


def test_data_are_in_the_panel_of_the_state_that_their_sensor_is(states):
    """Whatever they are called; the name of a state comes first, and a user's word before it."""
    tree = states.copy()
    tree["observed_data"] = states["observed_data"].to_dataset().assign_coords(observable=["y"])
    assert "data" not in plot_states(tree, backend="none").viz.children
    tree["smoothed_states"]["d_states"].attrs["observables"] = '{"speed": "y"}'
    data = drawn(plot_states(tree, backend="none"), "data")
    assert data["position"] is None
    np.testing.assert_allclose(data["speed"]["y"], np.delete(SINE[::5], 3))
    squares = drawn(plot_states(tree, transform=np.square, backend="none"), "data")
    np.testing.assert_allclose(squares["speed"]["y"], np.delete(SINE[::5], 3) ** 2)
    chosen = plot_states(tree, observables={"position": "y"}, backend="none")
    assert drawn(chosen, "data")["speed"] is None
