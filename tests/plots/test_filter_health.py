"""Residuals, their autocorrelation, PIT and effective particles, as drawn."""

from itertools import pairwise

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from scipy.stats import kstest, norm

from pymc_statespace_filters import plot_filter_health
from pymc_statespace_filters.errors import ModelError
from tests.plots.conftest import TIMES
from tests.plots.drawn import drawn


@pytest.fixture(scope="module")
def collection(diagnostics):
    return plot_filter_health(diagnostics, backend="none")


def of_residuals(residual):
    values = np.asarray(residual)[:, None]
    over_time = ("d_time", "observable")
    return xr.Dataset(
        {"d_residual": (over_time, values), "d_pit": (over_time, norm.cdf(values))},
        coords={"d_time": np.arange(len(values)), "observable": ["y"]},
    )


def test_residuals_over_time(collection, diagnostics):
    expected = diagnostics["filter_diagnostics"]["d_residual"]
    seen = drawn(collection, "seen", "residual")
    np.testing.assert_array_equal(seen["speed"]["x"], TIMES)
    np.testing.assert_array_equal(seen["speed"]["y"], expected.sel(observable="speed"))
    np.testing.assert_array_equal(seen["position"]["x"], np.delete(TIMES, 3))
    band = drawn(collection, "expected", "residual")["speed"]
    assert (band["ymin"], band["ymax"]) == (-1.96, 1.96)


def test_autocorrelation_and_its_band(collection):
    seen = drawn(collection, "seen", "autocorrelation")["speed"]
    np.testing.assert_allclose(np.reshape(seen["y"], (-1, 3))[:, 1], -0.02 * np.arange(1, 11))
    for name, n in (("position", 40), ("speed", 41)):  # of one, an observation is missing
        band = drawn(collection, "expected", "autocorrelation")[name]
        np.testing.assert_allclose(band["ymax"], 1.96 / np.sqrt(n))


def test_distribution_of_the_pit_against_the_uniform_one(collection, diagnostics):
    pit = diagnostics["filter_diagnostics"]["d_pit"].sel(observable="speed").values
    seen = drawn(collection, "seen", "pit")["speed"]
    expected = (pit[:, None] <= seen["x"]).mean(0) - seen["x"]
    np.testing.assert_allclose(seen["y"], expected, atol=1e-12)


def test_the_band_of_the_pit_holds_nineteen_of_twenty_good_filters():
    # 1000 times 100 uniform numbers against one band: the share inside has a standard error of
    # 0.007, and so has the level of the band, of 1000 simulations. Beyond 0.91 and 0.99, four of
    # both together, is once in 10 000 tests.
    uniform = np.random.default_rng(2).uniform(size=(1000, 100))
    tree = xr.DataTree.from_dict({"filter_diagnostics": of_residuals(norm.ppf(uniform[0]))})
    band = drawn(plot_filter_health(tree, backend="none"), "expected", "pit")["y"]
    grid = band["x"]
    differences = (uniform[:, :, None] <= grid).mean(1) - grid
    tolerance = 1e-9
    inside = (differences >= band["y_bottom"] - tolerance) & (
        differences <= band["y_top"] + tolerance
    )
    assert 0.91 < inside.all(1).mean() < 0.99


@pytest.mark.parametrize(("scale", "first"), [(2.0, 1), (0.4, -1)])
def test_a_filter_too_sure_or_not_sure_enough_leaves_the_band(scale, first):
    residual = scale * norm.ppf((np.arange(200) + 0.5) / 200)
    tree = xr.DataTree.from_dict({"filter_diagnostics": of_residuals(residual)})
    collection = plot_filter_health(tree, backend="none")
    seen, band = (drawn(collection, visual, "pit")["y"] for visual in ("seen", "expected"))
    assert kstest(norm.cdf(residual), "uniform").pvalue < 0.01
    outside = (seen["y"] > band["y_top"]) | (seen["y"] < band["y_bottom"])
    assert np.sign(seen["y"][outside][0]) == first
    assert np.sign(seen["y"][outside][-1]) == -first


def test_effective_particles_and_the_line_of_collapse(collection):
    median = collection.viz["median"]["effective"].item()
    np.testing.assert_allclose(median["y"], np.median(np.log10(np.arange(1, 101))))
    assert collection.viz["collapsed"]["effective"].item()["y"] == np.log10(3)
    panel = collection.viz["plot"]["effective"].item()
    (ticks,) = (thing for thing in panel if thing["function"] == "yticks")
    assert ticks["labels"] == ["1", "3", "10", "30", "100"]
    assert collection.viz["title"]["effective"].item()["string"] == "12 evaluations failed"


def test_a_deterministic_filter_has_no_panel_of_particles(diagnostics):
    group = diagnostics["filter_diagnostics"].to_dataset()
    without = group.assign(d_n_effective=xr.full_like(group["d_n_effective"], np.inf))
    tree = xr.DataTree.from_dict({"filter_diagnostics": without})
    collection = plot_filter_health(tree, backend="none")
    assert set(collection.viz["plot"].data_vars) == {"residual", "autocorrelation", "pit"}


def test_residuals_that_are_cut_off_are_crossed_out():
    group = of_residuals([0.3, 2.8, -2.8, -1.0])
    clipped = np.array([[False], [True], [True], [False]])
    group["d_clipped"] = (("d_time", "observable"), clipped)
    tree = xr.DataTree.from_dict({"filter_diagnostics": group})
    (key,) = plot_filter_health(tree).viz["figure"].item().legends
    assert [line.get_marker() for line in key.get_lines()][-1] == "x"
    crosses = drawn(plot_filter_health(tree, backend="none"), "clipped", "residual")["y"]
    np.testing.assert_array_equal(crosses["x"], [1, 2])
    np.testing.assert_array_equal(crosses["y"], [2.8, -2.8])


def test_the_largest_correlation_with_an_input_at_each_lag():
    group = of_residuals(np.random.default_rng(6).normal(size=100)).assign_coords(
        input_lag=[0, 1], input=["force", "heat"]
    )
    values = [[[0.1], [-0.4]], [[np.nan], [0.05]]]
    group["d_input_correlation"] = (("input_lag", "input", "observable"), values)
    tree = xr.DataTree.from_dict({"filter_diagnostics": group})
    collection = plot_filter_health(tree, backend="none")
    heights = np.reshape(drawn(collection, "seen", "inputs")["y"]["y"], (-1, 3))
    np.testing.assert_array_equal(heights[:, 1], [-0.4, 0.05])
    band = drawn(collection, "expected", "inputs")["y"]
    # The larger of two standard normals is within this in 95 % of all cases.
    np.testing.assert_allclose(2 * norm.cdf(10 * band["ymax"]) - 1, np.sqrt(0.95))
    assert band["ymin"] == -band["ymax"]


def test_names_of_axes_and_panels(diagnostics):
    axes = plot_filter_health(diagnostics).viz["figure"].item().axes
    found = [(a.get_title(), a.get_xlabel(), a.get_ylabel()) for a in axes[:7:2]]
    assert found[:3] == [
        ("position", "time", "standardised residual"),
        ("position", "lag (observations)", "autocorrelation"),
        ("position", "PIT: probability of less", "share below − expected"),
    ]
    assert found[3][1:] == ("time", "effective number")


def test_what_is_refused(diagnostics):
    with pytest.raises(
        ModelError, match=r"'filter_diagnostics': run psf.filter_diagnostics\(idata"
    ):
        plot_filter_health(xr.DataTree())
    with pytest.raises(ModelError, match=r"var_name must be one of \['d'\], got 'e'"):
        plot_filter_health(diagnostics, var_name="e")


def test_years_do_not_touch_where_panels_are_side_by_side(diagnostics):
    of_years = diagnostics["filter_diagnostics"].to_dataset()
    of_years = of_years.assign_coords(d_time=np.linspace(1973.5, 1984.5, of_years.sizes["d_time"]))
    tree = xr.DataTree.from_dict({"filter_diagnostics": of_years})
    with plt.rc_context({"font.size": 14.0}):
        figure = plot_filter_health(tree, backend="matplotlib").viz["figure"].item()
        figure.canvas.draw()
    for axes in figure.axes[:2]:
        boxes = [label.get_window_extent() for label in axes.get_xticklabels()]
        assert len(boxes) > 1
        assert all(left.x1 < right.x0 for left, right in pairwise(boxes))
