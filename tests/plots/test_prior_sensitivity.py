"""Curves of probability against the width of the priors, of a given Dataset."""

import numpy as np
import pytest
import xarray as xr

from pymc_statespace_filters import plot_prior_sensitivity
from pymc_statespace_filters.errors import ModelError
from tests.plots.drawn import drawn


def test_the_axis_of_widths_is_logarithmic():
    widths = np.array([0.1, 1.0, 10.0])
    values = np.array([[0.2, 0.8], [0.5, 0.5], [0.9, 0.1]])
    found = xr.Dataset(
        {
            "width_prob": (("width", "model"), values),
            "width_prob_low": (("width", "model"), values - 0.1),
            "width_prob_high": (("width", "model"), values + 0.1),
        },
        coords={"width": widths, "model": ["a", "b"]},
    )
    collection = plot_prior_sensitivity(found, backend="none")
    curve = drawn(collection, "curve", "width_prob")["a"]
    np.testing.assert_allclose(curve["x"], [-1, 0, 1])
    np.testing.assert_array_equal(curve["y"], values[:, 0])
    band = drawn(collection, "band", "width_prob")["b"]
    np.testing.assert_allclose(band["y_bottom"], values[:, 1] - 0.1)
    panel = collection.viz["plot"]["width_prob"].item()
    (ticks,) = (thing for thing in panel if thing["function"] == "xticks")
    np.testing.assert_allclose(10 ** np.asarray(ticks["ticks"]), [0.1, 0.3, 1, 3, 10])
    assert ticks["labels"] == ["0.1", "0.3", "1", "3", "10"]


def of_widths(values, **more):
    """Curves of two models against three widths."""
    models = ("width", "model")
    return xr.Dataset(
        {
            **{f"width_{name}": (models, np.array(values)) for name in PROBS},
            **{name: (models, np.array(value)) for name, value in more.items()},
        },
        coords={"width": [0.1, 1.0, 10.0], "model": ["a", "b"]},
    )


PROBS = ("prob", "prob_low", "prob_high")
NONE = [[np.nan, np.nan]]


def test_a_panel_without_results_tells_why():
    found = of_widths(NONE * 3)
    note = plot_prior_sensitivity(found, backend="none").viz["note"]["width_prob"].item()
    assert note["string"] == "no result at any width:\nthe draws do not determine it"
    found.attrs["width_note"] = "The prior of k leaves most widths unknown."
    note = plot_prior_sensitivity(found, backend="none").viz["note"]["width_prob"].item()
    assert note["string"].split("\n")[1:] == ["The prior of k leaves most", "widths unknown."]
    assert (note["x"], note["y"]) == (0.0, 0.5)
    axes = plot_prior_sensitivity(found).viz["figure"].item().axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == (
        "width of the priors (factor)",
        "probability of the model",
    )
    np.testing.assert_allclose(axes.get_xlim(), (-1.1, 1.1))
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0.1", "0.3", "1", "3", "10"]


def test_the_axis_tells_at_how_many_widths_there_is_no_result():
    half = [[0.5, 0.5]]
    for values, lines in ((NONE + half * 2, ["no result at 1 of 3 widths"]), (half * 3, [])):
        collection = plot_prior_sensitivity(of_widths(values), backend="none")
        panel = collection.viz["plot"]["width_prob"].item()
        (label,) = (thing["string"] for thing in panel if thing["function"] == "xlabel")
        assert label.split("\n") == ["width of the priors (factor)", *lines]
        assert "note" not in collection.viz.children


@pytest.mark.parametrize(
    ("attrs", "lines"),
    [
        ({}, ["width of the priors (factor)"]),
        ({"width_left_out": "k, c"}, ["width of the priors (factor)", "without the prior of k, c"]),
        (
            {"width_left_out": "", "width_unknown": "k"},
            ["width of the priors (factor)", "mostly unknown due to the prior of k"],
        ),
    ],
)
def test_the_panel_of_widths_names_the_priors_that_it_is_without(attrs, lines):
    values = np.full((3, 2), np.nan if attrs.get("width_unknown") else 0.5)
    found = xr.Dataset(
        {f"width_{name}": (("width", "model"), values) for name in PROBS},
        coords={"width": [0.5, 1, 2], "model": ["a", "b"]},
        attrs=attrs,
    )
    collection = plot_prior_sensitivity(found, backend="none")
    panel = collection.viz["plot"]["width_prob"].item()
    assert [one["string"].split("\n") for one in panel if one["function"] == "xlabel"] == [lines]


def test_evidences_without_errors_leave_curves_without_bands():
    found = of_widths([[0.5, 0.5]] * 3)
    unknown = found.assign({name: found[name] * np.nan for name in list(found) if "prob_" in name})
    collection = plot_prior_sensitivity(unknown, backend="none")
    assert "band" not in collection.viz.children
    assert None not in drawn(collection, "curve", "width_prob").values()


def test_what_is_refused(table):
    for given in (xr.Dataset(), None, table):
        with pytest.raises(ModelError, match="curves must be the result of prior_sensitivity"):
            plot_prior_sensitivity(given)
