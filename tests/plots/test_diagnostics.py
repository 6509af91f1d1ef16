"""Filter health and residuals: points, correlations, PIT and effective particles, as drawn."""

from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from scipy.stats import kstest, norm

from pymc_statespace_filters import plot_filter_health, plot_residuals
from pymc_statespace_filters.errors import ModelError
from tests.plots.conftest import TIMES
from tests.plots.drawn import drawn

BOTH = pytest.mark.parametrize(
    ("plot", "row"), [(plot_filter_health, "residual"), (plot_residuals, "innovation")]
)


@pytest.fixture(scope="module")
def health(diagnostics):
    return plot_filter_health(diagnostics, backend="none")


@pytest.fixture(scope="module")
def residuals(diagnostics_with_inputs):
    return plot_residuals(diagnostics_with_inputs, backend="none")


def tree_of(group):
    return xr.DataTree.from_dict({"filter_diagnostics": group})


def of_residuals(residual):
    values = np.asarray(residual)[:, None]
    over_time = ("d_time", "observable")
    return xr.Dataset(
        {"d_residual": (over_time, values), "d_pit": (over_time, norm.cdf(values))},
        coords={"d_time": np.arange(len(values)), "observable": ["y"]},
    )


def heights(bars):
    return np.asarray(bars["y"]).reshape(-1, 3)[:, 1]


@BOTH
def test_points_over_time_and_their_band(plot, row, diagnostics):
    """Innovations are divided by their standard deviations."""
    collection = plot(diagnostics, backend="none")
    expected = diagnostics["filter_diagnostics"]["d_residual"].sel(observable="speed")
    seen = drawn(collection, "seen", row)
    np.testing.assert_array_equal(seen["speed"]["x"], TIMES)
    np.testing.assert_allclose(seen["speed"]["y"], expected)
    np.testing.assert_array_equal(seen["position"]["x"], np.delete(TIMES, 3))
    band = drawn(collection, "expected", row)["speed"]
    assert (band["ymin"], band["ymax"]) == (-1.96, 1.96)


@BOTH
def test_autocorrelation_and_its_band(plot, row, diagnostics):
    collection = plot(diagnostics, backend="none")
    seen = drawn(collection, "seen", "autocorrelation")["speed"]
    np.testing.assert_array_equal(np.asarray(seen["x"])[::3], np.arange(1, 11))
    np.testing.assert_allclose(heights(seen), -0.02 * np.arange(1, 11))
    for name, n in (("position", 40), ("speed", 41)):  # of one, an observation is missing
        band = drawn(collection, "expected", "autocorrelation")[name]
        np.testing.assert_allclose([-band["ymin"], band["ymax"]], 1.96 / np.sqrt(n))


def test_distribution_of_the_pit_against_the_uniform_one(health, diagnostics):
    pit = diagnostics["filter_diagnostics"]["d_pit"].sel(observable="speed").values
    seen = drawn(health, "seen", "pit")["speed"]
    expected = (pit[:, None] <= seen["x"]).mean(0) - seen["x"]
    np.testing.assert_allclose(seen["y"], expected, atol=1e-12)


def test_the_band_of_the_pit_holds_nineteen_of_twenty_good_filters():
    # 1000 times 100 uniform numbers against one band: the share inside has a standard error of
    # 0.007, and so has the level of the band, of 1000 simulations. Beyond 0.91 and 0.99, four of
    # both together, is once in 10 000 tests.
    uniform = np.random.default_rng(2).uniform(size=(1000, 100))
    tree = tree_of(of_residuals(norm.ppf(uniform[0])))
    band = drawn(plot_filter_health(tree, backend="none"), "expected", "pit")["y"]
    grid = band["x"]
    differences = (uniform[:, :, None] <= grid).mean(1) - grid
    inside = (differences >= band["y_bottom"] - 1e-9) & (differences <= band["y_top"] + 1e-9)
    assert 0.91 < inside.all(1).mean() < 0.99


@pytest.mark.parametrize(("scale", "first"), [(2.0, 1), (0.4, -1)])
def test_a_filter_too_sure_or_not_sure_enough_leaves_the_band(scale, first):
    residual = scale * norm.ppf((np.arange(200) + 0.5) / 200)
    collection = plot_filter_health(tree_of(of_residuals(residual)), backend="none")
    seen, band = (drawn(collection, visual, "pit")["y"] for visual in ("seen", "expected"))
    assert kstest(norm.cdf(residual), "uniform").pvalue < 0.01
    outside = (seen["y"] > band["y_top"]) | (seen["y"] < band["y_bottom"])
    assert np.sign(seen["y"][outside][0]) == first
    assert np.sign(seen["y"][outside][-1]) == -first


def test_effective_particles_and_the_line_of_collapse(health, diagnostics):
    median = health.viz["median"]["effective"].item()
    np.testing.assert_allclose(median["y"], np.median(np.log10(np.arange(1, 101))))
    assert health.viz["collapsed"]["effective"].item()["y"] == np.log10(3)
    panel = health.viz["plot"]["effective"].item()
    (ticks,) = (thing for thing in panel if thing["function"] == "yticks")
    assert ticks["labels"] == ["1", "3", "10", "30", "100"]
    assert health.viz["title"]["effective"].item()["string"] == "12 evaluations failed"
    # A deterministic filter has no such panel.
    group = diagnostics["filter_diagnostics"].to_dataset()
    without = group.assign(d_n_effective=xr.full_like(group["d_n_effective"], np.inf))
    collection = plot_filter_health(tree_of(without), backend="none")
    assert set(collection.viz["plot"].data_vars) == {"residual", "autocorrelation", "pit"}


def test_residuals_that_are_cut_off_are_crossed_out():
    group = of_residuals([0.3, 2.8, -2.8, -1.0])
    clipped = np.array([[False], [True], [True], [False]])
    group["d_clipped"] = (("d_time", "observable"), clipped)
    (key,) = plot_filter_health(tree_of(group)).viz["figure"].item().legends
    assert key.get_lines()[-1].get_marker() == "x"
    crosses = drawn(plot_filter_health(tree_of(group), backend="none"), "clipped", "residual")["y"]
    np.testing.assert_array_equal(crosses["x"], [1, 2])
    np.testing.assert_array_equal(crosses["y"], [2.8, -2.8])


def test_the_largest_correlation_with_an_input_at_each_lag():
    group = of_residuals(np.random.default_rng(6).normal(size=100)).assign_coords(
        input_lag=[0, 1], input=["force", "heat"]
    )
    values = [[[0.1], [-0.4]], [[np.nan], [0.05]]]
    group["d_input_correlation"] = (("input_lag", "input", "observable"), values)
    collection = plot_filter_health(tree_of(group), backend="none")
    np.testing.assert_array_equal(heights(drawn(collection, "seen", "inputs")["y"]), [-0.4, 0.05])
    band = drawn(collection, "expected", "inputs")["y"]
    # The larger of two standard normals is within this in 95 % of all cases.
    np.testing.assert_allclose(2 * norm.cdf(10 * band["ymax"]) - 1, np.sqrt(0.95))
    assert band["ymin"] == -band["ymax"]


def test_each_input_has_a_panel(residuals, diagnostics_with_inputs, diagnostics):
    found = diagnostics_with_inputs["filter_diagnostics"]["d_input_correlation"]
    for name in ("force", "heat"):
        seen = drawn(residuals, "seen", f"input_{name}")["position"]
        np.testing.assert_array_equal(np.asarray(seen["x"])[::3], np.arange(11))
        np.testing.assert_allclose(heights(seen), found.sel(input=name, observable="position"))
        band = drawn(residuals, "expected", f"input_{name}")["position"]
        np.testing.assert_allclose(band["ymax"], 1.96 / np.sqrt(40))
    panels = plot_residuals(diagnostics, backend="none").viz["plot"]  # without inputs
    assert list(panels.data_vars) == ["innovation", "autocorrelation", "prediction"]


@pytest.mark.parametrize("has_record", [True, False])
def test_innovations_against_the_prediction(has_record, diagnostics):
    group = diagnostics["filter_diagnostics"].to_dataset()
    tree, predicted = {"filter_diagnostics": group}, group["d_residual"] + 7.0
    if has_record:
        predicted = xr.full_like(predicted, 3.0)
        tree["observed_data"] = (group["d_innovation"] + predicted).to_dataset(name="d")
    collection = plot_residuals(xr.DataTree.from_dict(tree), backend="none")
    seen = drawn(collection, "seen", "prediction")["speed"]
    np.testing.assert_allclose(seen["x"], predicted.sel(observable="speed"))
    np.testing.assert_allclose(seen["y"], group["d_residual"].sel(observable="speed"))
    assert drawn(collection, "expected", "prediction")["speed"]["ymax"] == 1.96


def test_labels_of_panels(diagnostics, diagnostics_with_inputs):
    axes = plot_filter_health(diagnostics).viz["figure"].item().axes
    found = [(a.get_title(), a.get_xlabel(), a.get_ylabel()) for a in axes[:7:2]]
    assert found[:3] == [
        ("position", "time", "standardised residual"),
        ("position", "lag (observations)", "autocorrelation"),
        ("position", "PIT: probability of less", "share below − expected"),
    ]
    assert found[3][1:] == ("time", "effective number")
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


@BOTH
def test_what_has_no_value_has_no_panel(plot, row, diagnostics_with_inputs):
    group = diagnostics_with_inputs["filter_diagnostics"].to_dataset().copy(deep=True)
    for name in ("residual", "pit", "innovation", "autocorrelation", "input_correlation"):
        group[f"d_{name}"].loc[{"observable": "speed"}] = np.nan
    group["d_input_correlation"].loc[{"input": "heat"}] = np.nan
    collection = plot(tree_of(group), backend="none")
    assert list(collection.data["observable"].values) == ["position"]
    assert "input_heat" not in collection.data
    assert all(collection.data[name].notnull().any() for name in collection.data)
    group["d_input_correlation"][:] = np.nan  # no input ever changes
    collection = plot(tree_of(group), backend="none")
    assert not {"inputs", "input_force"} & set(collection.data)
    with pytest.raises(ModelError, match="must be an observation to compare"):
        plot(tree_of(group.where(group["observable"] == "")))


@BOTH
def test_what_is_refused(plot, row, diagnostics):
    with pytest.raises(ModelError, match=r"'filter_diagnostics': run psf.filter_diagnostics\("):
        plot(xr.DataTree())
    with pytest.raises(ModelError, match=r"var_name must be one of \['d'\], got 'e'"):
        plot(diagnostics, var_name="e")
    old = diagnostics["filter_diagnostics"].to_dataset()[["d_residual", "d_pit"]]
    with pytest.raises(ModelError, match=r"no innovations: run psf\.filter_diag"):
        plot_residuals(tree_of(old))


def test_years_do_not_touch_where_panels_are_side_by_side(diagnostics):
    of_years = diagnostics["filter_diagnostics"].to_dataset()
    of_years = of_years.assign_coords(d_time=np.linspace(1973.5, 1984.5, of_years.sizes["d_time"]))
    with plt.rc_context({"font.size": 14.0}):
        figure = plot_filter_health(tree_of(of_years)).viz["figure"].item()
        figure.canvas.draw()
    for axes in figure.axes[:2]:
        boxes = [label.get_window_extent() for label in axes.get_xticklabels()]
        assert len(boxes) > 1
        assert all(left.x1 < right.x0 for left, right in pairwise(boxes))
