"""Probabilities of terms, as drawn."""

import numpy as np
import pytest
import xarray as xr

from pymc_statespace_filters import plot_terms
from pymc_statespace_filters.errors import ModelError
from tests.plots.drawn import drawn

TERMS = xr.Dataset(
    {
        "inclusion": ("term", [0.12, 0.98, 0.5]),
        "inclusion_se": ("term", [0.01, 0.02, 0.0]),
        "prior_inclusion": ("term", [0.5, 0.4, 0.5]),
    },
    coords={"term": ["c2", "k3", "k_f, k_h"]},
)


def test_probabilities_errors_and_priors():
    collection = plot_terms(xr.DataTree.from_dict({"terms": TERMS}), backend="none")
    points = drawn(collection, "point", "inclusion")
    assert list(points) == ["k3", "k_f, k_h", "c2"]  # the most probable one on top
    assert [points[name]["y"] for name in points] == [2, 1, 0]
    bounds = drawn(collection, "interval", "inclusion")
    np.testing.assert_allclose(bounds["c2"]["x"], [0.1, 0.14])
    np.testing.assert_allclose(bounds["k3"]["x"], [0.94, 1.0])
    assert np.nanmax(drawn(collection, "prior", "inclusion")["k3"]["x"]) == 0.4
    texts = drawn(collection, "text", "inclusion")
    assert texts["c2"]["string"] == "0.12 ± 0.01"


def test_what_is_refused():
    with pytest.raises(ModelError, match="found must be the result of select_terms, got Dataset"):
        plot_terms(TERMS)
    with pytest.raises(ModelError, match=r"got DataTree with the groups \['terms'\]"):
        plot_terms(xr.DataTree.from_dict({"terms": TERMS[["inclusion"]]}))
