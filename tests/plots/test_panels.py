"""Plots of a panel: records side by side, or one of them, as results without a panel."""

import numpy as np
import pymc as pm
import pytest
import xarray as xr

from pymc_statespace_filters import (
    plot_filter_health,
    plot_forecast,
    plot_residuals,
    plot_states,
)
from pymc_statespace_filters.errors import ModelError

LABELS, LENGTHS = ["A", "B"], [3, 5]
OF_ROWS = np.repeat(LABELS, LENGTHS)
TIMES = np.concatenate([[1.0, 2.0, 4.0], [0.5, 1.0, 3.0, 4.0, 6.0]])
RNG = np.random.default_rng(1)
DRAWN = np.arange(8.0) + RNG.normal(scale=0.1, size=(2, 50, 8))
DATA = np.arange(8.0)
ROWS = {"d_panel": ("d_obs", OF_ROWS), "d_time": ("d_obs", TIMES)}


def a_tree(group, variable, values, dims, last, names=("level",), **attrs):
    results = xr.Dataset({variable: (dims, values)}, coords={**ROWS, last: list(names)})
    observed = xr.Dataset(
        {"d": (("d_obs", "observable"), DATA[:, None])}, coords={"observable": ["level"]}
    )
    # Labels that are texts are stored as numbers of records.
    constant = xr.Dataset(
        {"d_panel": ("d_obs", np.repeat([0, 1], LENGTHS)), "d_time": ("d_obs", TIMES)}
    )
    return xr.DataTree.from_dict(
        {group: results.assign_attrs(attrs), "observed_data": observed, "constant_data": constant}
    )


@pytest.fixture
def states():
    dims = ("chain", "draw", "d_obs", "state")
    return a_tree("smoothed_states", "d_states", DRAWN[..., None], dims, "state", at="observations")


@pytest.fixture
def forecast_of_past():
    times = np.arange(8.0)
    coords = {"d_time": times, "observable": ["level"]}
    drawn = {"d": (("chain", "draw", "d_time", "observable"), DRAWN[..., None])}
    data = {"d": (("d_time", "observable"), DATA[:, None])}
    return xr.DataTree.from_dict(
        {
            "posterior_predictive": xr.Dataset(drawn, coords),
            "observed_data": xr.Dataset(data, coords),
        }
    )


def drawn_points(collection, visual, **where):
    return collection.get_viz(visual, **where).get_offsets().data


def test_each_record_has_a_panel_with_its_own_data(states):
    collection = plot_states(states, backend="matplotlib")
    assert list(collection.viz["plot"]["record"].values) == LABELS
    for label in LABELS:
        points = drawn_points(collection, "data", record=label, state="level")
        rows = label == OF_ROWS
        np.testing.assert_array_equal(points, np.stack([TIMES[rows], DATA[rows]], axis=1))


def test_chosen_records_in_their_order(states):
    collection = plot_states(states, records="B", backend="none")
    assert list(collection.viz["plot"]["record"].values) == ["B"]
    collection = plot_states(
        states, records=["B", "A"], backend="none", transform={"level": np.exp}
    )
    assert list(collection.viz["plot"]["record"].values) == ["B", "A"]


def test_no_more_than_twelve_records_unless_they_are_named():
    labels = [f"r{i}" for i in range(15)]
    results = xr.Dataset(
        {"d_states": (("chain", "draw", "d_obs", "state"), RNG.normal(size=(2, 20, 30, 1)))},
        coords={
            "d_panel": ("d_obs", np.repeat(labels, 2)),
            "d_time": ("d_obs", np.tile([0.0, 1.0], 15)),
            "state": ["x"],
        },
        attrs={"at": "steps"},
    )
    idata = xr.DataTree.from_dict({"smoothed_states": results})
    assert plot_states(idata, backend="none").viz["plot"].sizes["record"] == 12
    assert plot_states(idata, records=labels, backend="none").viz["plot"].sizes["record"] == 15


def test_a_line_does_not_break_at_the_times_of_other_records():
    dims = ("chain", "draw", "d_obs", "observable")
    idata = a_tree("free_run", "d", DRAWN[..., None], dims, "observable")
    collection = plot_forecast(idata, backend="matplotlib")
    line = collection.get_viz("median", record="A", observable="level")
    x, y = line.get_xdata(), line.get_ydata()
    known = np.isfinite(y)
    np.testing.assert_array_equal(np.flatnonzero(known), np.arange(1, 5))  # 1, 2, 3 and 4
    np.testing.assert_allclose(y[known][[0, 1, 3]], np.median(DRAWN, axis=(0, 1))[:3])
    assert x[known].tolist() == [1.0, 2.0, 3.0, 4.0]


def test_a_forecast_begins_at_the_end_of_its_record():
    dims = ("chain", "draw", "d_obs", "observable")
    idata = a_tree("predictions", "d", DRAWN[..., None], dims, "observable")
    later = idata["predictions"].to_dataset()
    later["d_time"] = ("d_obs", TIMES + np.repeat([4.0, 6.0], LENGTHS))
    idata["predictions"] = xr.DataTree(later)
    collection = plot_forecast(idata, backend="matplotlib")
    ends = [
        collection.get_viz("end", record=label, observable="level").get_xdata()[0]
        for label in LABELS
    ]
    assert ends == [4.0, 6.0]


def test_the_truth_of_a_panel_is_its_simulation(states):
    simulated = xr.Dataset(
        {"states": (("row", "state"), DATA[:, None])},
        coords={"record": ("row", OF_ROWS), "time": ("row", TIMES), "state": ["level"]},
    )
    collection = plot_states(states, truth=simulated, backend="matplotlib")
    line = collection.get_viz("truth", record="A", state="level")
    own = np.isin(line.get_xdata(), TIMES[:3])  # between them the line goes on
    np.testing.assert_array_equal(line.get_ydata()[own], DATA[:3])
    with pytest.raises(ModelError, match=r"truth of a panel must be the result of psf.simulate"):
        plot_states(states, truth=DATA, backend="none")


def test_a_simulated_panel_has_panels_of_its_records():
    simulated = xr.Dataset(
        {
            "states": (("row", "state"), DATA[:, None]),
            "observations": (("obs", "observable"), DATA[:, None] + 1.0),
        },
        coords={
            "record": ("row", OF_ROWS),
            "time": ("row", TIMES),
            "obs_record": ("obs", OF_ROWS),
            "obs_time": ("obs", TIMES),
            "state": ["level"],
            "observable": ["level"],
        },
    )
    collection = plot_states(simulated, records=["B"], backend="matplotlib")
    assert list(collection.viz["plot"]["record"].values) == ["B"]
    np.testing.assert_array_equal(
        collection.get_viz("path", record="B", state="level").get_ydata(), DATA[3:]
    )
    np.testing.assert_array_equal(
        drawn_points(collection, "data", record="B", state="level")[:, 1], DATA[3:] + 1.0
    )
    with pytest.raises(ModelError, match=r"records must be None without a panel, got \['B'\]"):
        plot_states(
            simulated.isel(row=slice(3), obs=slice(3)).drop_vars(["record", "obs_record"]),
            records=["B"],
        )


@pytest.fixture
def diagnostics():
    dims, by_record = ("d_obs", "observable"), ("d_record", "lag", "observable")
    residual = RNG.normal(size=(8, 1))
    idata = a_tree("filter_diagnostics", "d_residual", residual, dims, "observable")
    found = idata["filter_diagnostics"].to_dataset()
    found["d_pit"] = dims, RNG.uniform(size=(8, 1))
    found["d_innovation"] = dims, residual
    found["d_innovation_cov"] = (*dims, "observable_bis"), np.ones((8, 1, 1))
    found["d_autocorrelation"] = by_record, RNG.uniform(-0.2, 0.2, (2, 2, 1))
    found["d_predicted"] = ("chain", "draw", *dims), DRAWN[..., None]
    found["d_n_effective"] = ("chain", "draw", "d_obs"), np.full((2, 50, 8), np.inf)
    idata["filter_diagnostics"] = xr.DataTree(found.assign_coords(d_record=LABELS, lag=[1, 2]))
    return idata


@pytest.mark.parametrize("plot", [plot_filter_health, plot_residuals])
def test_diagnostics_of_one_record(plot, diagnostics):
    collection = plot(diagnostics, record="B", backend="matplotlib")
    name = "residual" if plot is plot_filter_health else "innovation"
    points = drawn_points(collection, "seen", var_name=name, observable="level")
    expected = diagnostics["filter_diagnostics"]["d_residual"].values[3:, 0]
    np.testing.assert_array_equal(points[:, 1], expected)
    np.testing.assert_array_equal(points[:, 0], TIMES[3:])
    if plot is plot_residuals:
        bars = collection.get_viz("seen", var_name="autocorrelation", observable="level")
        ends = bars.get_ydata().reshape(-1, 3)[:, 1]  # from zero, to the value, and a gap
        of_records = diagnostics["filter_diagnostics"]["d_autocorrelation"]
        np.testing.assert_allclose(np.sort(np.abs(ends)), np.sort(np.abs(of_records[1, :, 0])))
    with pytest.raises(ModelError, match=r"record must be among the labels \['A', 'B'\], got None"):
        plot(diagnostics, backend="none")


def test_what_is_refused(states):
    with pytest.raises(ModelError, match=r"records must be among the labels .* got \['C'\]"):
        plot_states(states, records=["C"], backend="none")
    alone = xr.Dataset(
        {"d_states": (("chain", "draw", "d_time", "state"), DRAWN[..., None])},
        coords={"d_time": np.arange(8.0), "state": ["level"]},
    )
    alone = xr.DataTree.from_dict({"smoothed_states": alone})
    with pytest.raises(ModelError, match=r"records must be None without a panel, got \['A'\]"):
        plot_states(alone, records=["A"], backend="none")


@pytest.mark.parametrize("known_by", ["draws", "model", None])
def test_replicated_observations_of_each_record(known_by):
    """Draws of PyMC have no record and time of a row; texts are in the model and some draws."""
    dims = ("chain", "draw", "d_obs", "sensor")
    tree = a_tree("posterior_predictive", "d", DRAWN[..., None], dims, "sensor")
    tree["posterior_predictive"] = tree["posterior_predictive"].to_dataset().drop_vars(ROWS)
    if known_by == "draws":
        tree["posterior"] = xr.Dataset({"rate": ("d_record", [1.0, 2.0])}, {"d_record": LABELS})
    model = pm.Model(coords={"d_record": LABELS}) if known_by == "model" else None
    collection = plot_forecast(
        tree, group="posterior_predictive", model=model, backend="matplotlib"
    )
    for number, label in enumerate(LABELS if known_by else [0, 1]):
        rows = OF_ROWS == LABELS[number]
        where = {"record": label, "observable": "level"}
        points = drawn_points(collection, "data", **where)
        np.testing.assert_array_equal(points, np.stack([TIMES[rows], DATA[rows]], axis=1))
        median = collection.get_viz("median", **where).get_ydata()
        expected = np.median(DRAWN[..., rows], axis=(0, 1))
        np.testing.assert_allclose(median[np.isin(np.unique(TIMES), TIMES[rows])], expected)


def test_replicated_observations_of_one_record(forecast_of_past):
    collection = plot_forecast(forecast_of_past, group="posterior_predictive", backend="none")
    assert {"band_90", "band_50", "median", "data"} <= set(collection.viz.children)
    assert "end" not in collection.viz.children
    with pytest.raises(ModelError, match="idata has no group 'prior_predictive'"):
        plot_forecast(forecast_of_past, group="prior_predictive")


@pytest.mark.parametrize("plot", [plot_states, plot_forecast])
def test_one_word_for_one_record_and_one_for_several(plot):
    with pytest.raises(TypeError, match="has no argument 'record': give records="):
        plot(None, record="A")
    with pytest.raises(TypeError, match="has no argument 'records': give record="):
        plot_residuals(None, records=["A"])


NAMES = ["Mount Pleasant Elementary School", "Lake Constance (Bregenz gauge)", "x", "Patient 12"]
NAMES += [f"Kilimanjaro, lower forest station {i}" for i in range(8)]


@pytest.mark.parametrize("n_records", [2, 12])
def test_long_names_of_records_are_titles_that_touch_nothing(n_records):
    labels, of_rows = NAMES[:n_records], np.repeat(NAMES[:n_records], 3)
    rows = {"d_panel": ("d_obs", of_rows), "d_time": ("d_obs", np.arange(3.0 * n_records) % 3)}
    drawn = (("chain", "draw", "d_obs", "state"), RNG.normal(size=(2, 20, of_rows.size, 1)))
    group = xr.Dataset({"d_states": drawn}, coords={**rows, "state": ["level"]})
    figure = plot_states(xr.DataTree.from_dict({"smoothed_states": group})).viz["figure"].item()
    figure.canvas.draw()
    panels = figure.axes[:n_records]
    assert [axes.get_title().replace("\n", " ") for axes in panels] == labels
    assert {axes.get_ylabel() for axes in panels} == {"level"}
    boxes = [axes.title.get_window_extent() for axes in panels]
    boxes += [axes.yaxis.label.get_window_extent() for axes in panels]
    boxes += [axes.bbox for axes in panels]
    for i, box in enumerate(boxes):
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert not any(box.overlaps(other) for other in boxes[i + 1 :])


def test_a_name_longer_than_its_axis_has_two_lines():
    name = "concentration of dissolved oxygen"
    drawn = (("chain", "draw", "d_time", "state"), RNG.normal(size=(2, 20, 5, 1)))
    group = xr.Dataset({"d_states": drawn}, coords={"d_time": np.arange(5.0), "state": [name]})
    figure = plot_states(xr.DataTree.from_dict({"smoothed_states": group})).viz["figure"].item()
    figure.canvas.draw()
    (axes,) = figure.axes
    label = axes.yaxis.label
    assert label.get_text() == "concentration of\ndissolved oxygen"
    assert label.get_window_extent().height < figure.bbox.height
