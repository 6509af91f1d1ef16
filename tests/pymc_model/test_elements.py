"""Elements of variables by their position and by their coordinates."""

import arviz as az
import pandas as pd
import pymc as pm
import pytest

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.pymc_model.elements import Elements, element_names

COORDS = {"term": ["1", "z^3"], "side": ["left", "right"], "year": [1, 2]}


def a_model():
    with pm.Model(coords=COORDS) as model:
        model.add_coord("plain", length=2)
        pm.Normal("k", dims=("term", "side"))
        pm.HalfNormal("sigma")
        pm.Normal("b", shape=2)
        pm.Normal("a", dims="year")
        pm.Normal("c", dims="plain")
        pm.Dirichlet("p", [1.0, 1.0, 1.0])
    return model


def elements():
    return Elements.of(a_model())


def test_labels_are_those_of_arviz():
    found = elements()
    k = ["k[1, left]", "k[1, right]", "k[z^3, left]", "k[z^3, right]"]
    rest = ["sigma", "b[0]", "b[1]", "a[1]", "a[2]", "c[0]", "c[1]", "p[0]", "p[1]"]
    assert list(found.labels) == k + rest
    assert found.variables[3:6] == ("k", "sigma", "b")


@pytest.mark.parametrize(
    "values",
    [
        pd.date_range("2020-01-01", periods=2),
        [pd.Timestamp("2020-01-01 06:30"), pd.Timestamp("2021-01-01")],
        pd.to_timedelta([1, 2], unit="h"),
        [True, False],
        [0.5, 1e-20],
        ["a", "b"],
    ],
)
def test_coordinates_are_written_as_in_a_summary(values):
    with pm.Model(coords={"at": values}) as model:
        pm.Normal("a", dims="at")
        idata = pm.sample_prior_predictive(20, random_seed=1)
    assert element_names(model) == list(az.summary(idata, group="prior", kind="stats").index)


def test_messages_name_elements_of_some_variables_so():
    model = a_model()
    values = [model.rvs_to_values[model[name]] for name in ("p", "a")]
    assert element_names(model, values) == ["p[0]", "p[1]", "a[1]", "a[2]"]
    assert tuple(element_names(model)) == Elements.of(model).labels


@pytest.mark.parametrize(
    ("name", "columns"),
    [
        ("k", (0, 1, 2, 3)),
        ("k[z^3, left]", (2,)),
        ("k[1, 0]", (2,)),
        ("sigma", (4,)),
        ("b[1]", (6,)),
        ("a[0]", (7,)),
        ("a[2]", (8,)),
        ("c", (9, 10)),
    ],
)
def test_names_of_elements(name, columns):
    assert elements().columns(name, "absent") == columns


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("k[z^2, left]", r"absent must name .* got 'k\[z\^2, left\]': 'k' has \['k\[1, left\]', "),
        ("q", "got 'q': the model has"),
        (3, "got 3: the model has"),
        ("a[1]", r"one element, got 'a\[1\]', which is one by its position and another by its"),
    ],
)
def test_a_wrong_name_is_answered(name, message):
    with pytest.raises(ModelError, match=message):
        elements().columns(name, "absent")
