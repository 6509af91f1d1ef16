"""Every plot is drawn by every backend, and handed what is meant for the backend."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from arviz_plots import PlotCollection

from pymc_statespace_filters import (
    plot_average,
    plot_designs,
    plot_drift,
    plot_evidence,
    plot_field,
    plot_filter_health,
    plot_forecast,
    plot_model_probabilities,
    plot_prior_sensitivity,
    plot_residuals,
    plot_states,
    plot_terms,
)
from tests.plots.conftest import DESIGNS, FIELDS, TERMS


def run_free(idata, **settings):
    return plot_forecast(idata, group="free_run", **settings)


def errors_of(idata, **settings):
    return plot_forecast(idata, group="free_run", errors=True, **settings)


def in_bins(idata, **settings):
    return plot_forecast(idata, group="posterior_predictive", bins=4, **settings)


PLOTS = [
    (plot_drift, "drift_scan"),
    (plot_evidence, "table"),
    (plot_evidence, "estimates"),
    (plot_model_probabilities, "table"),
    (plot_prior_sensitivity, "sensitivity"),
    (plot_average, "curve_average"),
    (plot_average, "scalar_average"),
    (plot_average, "average_in_panels"),
    (plot_states, "states"),
    (plot_forecast, "forecast"),
    (plot_filter_health, "diagnostics"),
    (plot_residuals, "diagnostics_with_inputs"),
    (plot_states, "simulated"),
    (run_free, "free_run"),
    (errors_of, "free_run"),
    (in_bins, "replicated"),
    (plot_terms, "terms"),
    (plot_designs, "designs"),
    (plot_field, "curve_of_field"),
    (plot_field, "maps_of_field"),
]


@pytest.fixture(scope="session")
def replicated(free_run):
    """The draws of a free run as replicates of its record."""
    groups = {"posterior_predictive": free_run["free_run"].to_dataset()[["d"]]}
    return xr.DataTree.from_dict(groups | {"observed_data": free_run["observed_data"].to_dataset()})


@pytest.fixture(scope="session")
def terms():
    return xr.DataTree.from_dict({"terms": TERMS})


@pytest.fixture(scope="session")
def designs():
    return DESIGNS


@pytest.fixture(scope="session")
def curve_of_field():
    return FIELDS.filter(lambda node: node.name != "e")


@pytest.fixture(scope="session")
def maps_of_field():
    return FIELDS.filter(lambda node: node.name != "c")


@pytest.fixture(scope="session")
def sensitivity():
    return curves_of(("linear", "cubic", "quintic"))


def curves_of(models):
    """Probabilities of three models at three widths, as `prior_sensitivity` gives them."""
    prob = np.array([[0.1, 0.2, 0.3], [0.6, 0.5, 0.4], [0.3, 0.3, 0.3]])
    curves = {"": prob, "_low": prob - 0.05, "_high": prob + 0.05}
    return xr.Dataset(
        {f"width_prob{end}": (("model", "width"), curve) for end, curve in curves.items()},
        coords={"model": list(models), "width": [0.1, 1.0, 10.0]},
    )


@pytest.mark.parametrize("backend", ["plotly", "bokeh"])
@pytest.mark.parametrize(("plot", "result"), PLOTS)
def test_every_other_backend(plot, result, backend, request):
    collection = plot(request.getfixturevalue(result), backend=backend)
    assert isinstance(collection, PlotCollection)
    assert collection.backend == backend


@pytest.mark.parametrize(("plot", "result"), PLOTS)
def test_the_default_backend_draws_a_key_beside_the_panels(plot, result, request):
    collection = plot(request.getfixturevalue(result))
    figure = collection.viz["figure"].item()
    figure.canvas.draw()
    for key in (legend.get_window_extent() for legend in figure.legends):
        assert figure.bbox.x0 <= key.x0 < key.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= key.y0
        assert not any(key.overlaps(axes.get_tightbbox()) for axes in figure.axes)
        assert key.width < 0.4 * figure.bbox.width
    assert bool(figure.legends) == (plot is not plot_evidence)


def test_the_size_of_the_user(curve_average):
    figure_kwargs = {"figsize": (7, 3)}
    figure = plot_average(curve_average, figure_kwargs=figure_kwargs).viz["figure"].item()
    assert tuple(figure.get_size_inches()) == (7, 3)
    assert figure_kwargs == {"figsize": (7, 3)}


def test_colours_of_the_user(curve_average):
    colours = ["#111111", "#222222", "#333333"]
    collection = plot_average(curve_average, backend="none", color=colours)
    drawn = [curve.item()["color"] for curve in collection.viz["curve"]["force"]]
    assert drawn == colours


@pytest.mark.parametrize("plot", [plot_evidence, plot_model_probabilities])
def test_nothing_in_a_picture_overlaps(plot, table):
    figure = plot(table).viz["figure"].item()
    figure.canvas.draw()
    (axes,) = figure.axes
    boxes = [text.get_window_extent() for text in (*axes.texts, *axes.get_yticklabels())]
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[i + 1 :])
        assert figure.bbox.containsx(box.x0)
        assert figure.bbox.containsx(box.x1)


LONG = {name: f"a rather long name of the {name} model" for name in ("linear", "cubic", "quintic")}


@pytest.mark.parametrize("size", [8, 14])
def test_a_key_of_long_names_is_inside_the_figure(size):
    """With letters of any size."""
    with plt.rc_context({"legend.fontsize": size}):
        figure = plot_prior_sensitivity(curves_of(LONG.values())).viz["figure"].item()
        figure.canvas.draw()
    key = figure.legends[0].get_window_extent()
    assert figure.bbox.x0 <= key.x0 < key.x1 <= figure.bbox.x1
    assert figure.axes[0].bbox.width > 0.8 * key.width


@pytest.mark.parametrize("plot", [plot_evidence, plot_model_probabilities])
def test_long_names_of_rows_leave_the_axis_its_label(plot, table):
    names = {name: f"{long} with hysteresis" for name, long in LONG.items()}
    figure = plot(table.rename(index=names)).viz["figure"].item()
    figure.canvas.draw()
    (axes,) = figure.axes
    label = axes.xaxis.label.get_window_extent()
    assert figure.bbox.x0 <= label.x0 < label.x1 <= figure.bbox.x1
    assert axes.bbox.width > 0.45 * figure.bbox.width


@pytest.mark.parametrize("backend", ["matplotlib", "plotly", "bokeh"])
def test_the_key_names_what_is_drawn_and_shows_points_as_points(backend, states):
    collection = plot_states(states, backend=backend)
    figure = collection.viz["figure"].item()
    if backend == "matplotlib":
        (key,) = figure.legends
        names = [text.get_text() for text in key.get_texts()]
        point = key.get_lines()[2]
        assert (point.get_marker(), point.get_linestyle()) == ("o", "None")
    elif backend == "plotly":
        names = [trace.name for trace in figure.data if trace.showlegend]
        (point,) = figure.select_traces({"name": "data"})
        assert (point.mode, point.marker.symbol) == ("markers", "circle")
    else:
        (key,) = collection.iget_target(0, -1).legend
        names = [item.label.value for item in key.items]
        (point,) = key.items[2].renderers
        assert point.glyph.marker == "circle"
    assert names == ["90 %", "50 %", "data", "median"]
