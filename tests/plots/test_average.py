"""Curves and densities of an average and its members, as drawn."""

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import trapezoid

from pymc_statespace_filters import average_models, plot_average
from pymc_statespace_filters.errors import ModelError
from tests.plots.drawn import drawn


def test_a_curve_has_means_and_intervals(curve_average):
    collection = plot_average(curve_average, backend="none")
    force = curve_average["posterior"]["force"]
    curves = drawn(collection, "curve")
    assert list(curves) == ["average", "linear", "cubic"]
    np.testing.assert_allclose(curves["average"]["y"], force.mean(["chain", "draw"]))
    np.testing.assert_array_equal(curves["average"]["x"], force["displacement"])
    members = curve_average["members"]["force"].mean(["chain", "draw"])
    for name in ("linear", "cubic"):
        np.testing.assert_allclose(curves[name]["y"], members.sel(model=name))
    for visual, level in (("lower", 0.055), ("upper", 0.945)):  # of arviz's intervals of 0.89
        end = drawn(collection, visual)["average"]["y"]
        below = (force.squeeze("chain") <= end).mean("draw")[force["displacement"] != 0]
        np.testing.assert_allclose(below, level, atol=0.002)
    assert list(drawn(collection, "band")) == ["linear", "cubic"]


def test_the_average_stands_out(curve_average):
    curves = drawn(plot_average(curve_average, backend="none"), "curve")
    assert curves["average"]["color"] == "B1"
    assert curves["average"]["width"] > curves["linear"]["width"]
    assert curves["linear"]["color"] != curves["cubic"]["color"]


def test_densities_carry_weights_and_add_up(scalar_average):
    densities = drawn(plot_average(scalar_average, backend="none"), "density")
    area = {name: trapezoid(one["y"], one["x"]) for name, one in densities.items()}
    np.testing.assert_allclose([area["linear"], area["cubic"]], [0.25, 0.75], rtol=0.01)
    np.testing.assert_allclose(
        densities["average"]["y"], densities["linear"]["y"] + densities["cubic"]["y"]
    )
    peak = densities["average"]["x"][np.argmax(densities["average"]["y"])]
    assert abs(peak - 2) < 0.1  # a quarter of the draws, but three times narrower: higher here


def test_a_model_that_hardly_counts_does_not_stretch_the_axis(draws):
    far = {"linear": draws["linear"], "far": draws["cubic"].map_over_datasets(lambda d: 1000 * d)}
    average = average_models(far, {"linear": 1, "far": 1e-6}, lambda posterior: posterior["k"])
    densities = drawn(plot_average(average, backend="none"), "density")
    assert densities["average"]["x"].max() < 3


def test_names_become_panels(average_in_panels):
    collection = plot_average(average_in_panels, backend="none")
    curves = collection.viz["curve"]["force"]
    assert dict(curves.sizes) == {"model": 3, "side": 2}
    left, right = (curves.sel(model="average", side=side).item()["y"] for side in ("left", "right"))
    np.testing.assert_allclose(left, -np.asarray(right))


def test_the_legend_tells_the_probabilities(curve_average):
    figure = plot_average(curve_average).viz["figure"].item()
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == [
        "89 % interval of a model",
        "average",
        "linear (0.25)",
        "cubic (0.75)",
        "89 % interval of the average",
    ]


def test_axes_are_named_in_words_with_units(draws):
    x = xr.DataArray([0.0, 1.0, 2.0], coords=[("u", [0.0, 1.0, 2.0], {"units": "m"})])

    def labelled(posterior):
        return (posterior["k"] * x).assign_attrs(units="N", long_name="spring force")

    def restoring_force(posterior):
        return (posterior["k"] * x).drop_attrs(deep=False)

    for function, label in ((restoring_force, "restoring force"), (labelled, "spring force (N)")):
        average = average_models(draws, {"linear": 1, "cubic": 1}, function, random_seed=1)
        (axes,) = plot_average(average).viz["figure"].item().axes
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("u (m)", label)


def test_two_dimensions_with_numbers_are_refused(draws):
    grid = xr.DataArray(np.ones((2, 3)), coords=[("x", [0.0, 1.0]), ("y", [0.0, 1.0, 2.0])])
    average = average_models(draws, {"linear": 1, "cubic": 1}, lambda p: p["k"] * grid)
    with pytest.raises(ModelError, match=r"at most one dimension with numbers, got \['x', 'y'\]"):
        plot_average(average)


def test_what_is_refused(draws):
    with pytest.raises(ModelError, match="average must be a DataTree of average_models, got"):
        plot_average(draws["linear"])


def test_a_legend_of_many_models_leaves_the_plot_its_height(draws):
    """And no two curves have the colour and the line of another."""
    heights = {}
    for n_models in (2, 20):
        models = {
            f"stiffness with damping and hysteresis {i}": draws["cubic"] for i in range(n_models)
        }
        found = average_models(
            models, dict.fromkeys(models, 1), lambda p: p["k"], n_draws=200, random_seed=1
        )
        figure = plot_average(found).viz["figure"].item()
        figure.canvas.draw()
        (axes,) = figure.axes
        heights[n_models] = axes.bbox.height
        lines = {(str(one.get_color()), one.get_linestyle()) for one in axes.get_lines()}
        assert len(lines) == n_models + 1
    assert heights[20] > 0.9 * heights[2]
