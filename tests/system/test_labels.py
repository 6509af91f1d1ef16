"""Tables of pandas and xarray whose columns are in another order than the names of the system."""

import numpy as np
import pandas as pd
import pymc as pm
import pytensor
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.labels import columns_in_order, rows_in_order
from tests.systems import PAIR, PAIR_DATA, STEPS, pair, pair_terms

pytestmark = pytest.mark.usefixtures("interpreted")

A = {"a": 0.5}
FRAME = pd.DataFrame(PAIR_DATA, columns=["position", "speed"])
SWAPPED = FRAME[["speed", "position"]]
ARRAY = xr.DataArray(SWAPPED, dims=["obs", "observable"])


@pytest.mark.parametrize(
    "observed", [FRAME, SWAPPED, ARRAY, ARRAY.T, ARRAY.rename(observable="sensor").T]
)
def test_data_are_aligned_by_label(observed):
    terms = psf.log_likelihood(PAIR, psf.EKF(), A, observed, steps=STEPS)
    np.testing.assert_array_equal(
        terms, psf.log_likelihood(PAIR, psf.EKF(), A, PAIR_DATA, steps=STEPS)
    )
    np.testing.assert_allclose(terms, pair_terms(0.5), rtol=1e-12, atol=1e-14)
    run = psf.run_filter(PAIR, psf.EKF(), A, observed, steps=STEPS)
    np.testing.assert_array_equal(run["log_likelihood"], terms)


def in_model(coords, panel=("A", "B"), labels=None):
    """The terms of two records, whose own parameters are a variable with these coordinates."""
    rows = np.repeat(panel, STEPS.size) if labels is None else labels
    with pm.Model(coords={"machine": coords}) as model:
        pm.Normal("a", dims="machine")
        psf.StateSpace(
            "d", PAIR, psf.EKF(), panel=rows, steps=np.tile(STEPS, 2),
            observed=np.tile(PAIR_DATA, (2, 1)),
        )  # fmt: skip
    (terms,) = model.compile_logp(model["d"], sum=False)({"a": np.array([0.5, 0.9])})
    return terms


def test_variables_of_a_model_are_aligned_with_the_records_by_their_dimension():
    expected = [pair_terms(0.5), pair_terms(0.9)]
    for coords, panel, first in (
        (["A", "B"], ("A", "B"), 0),
        (["B", "A"], ("A", "B"), 1),
        ([3, 7], (7, 3), 1),
        ([0, 1], (1, 0), 1),
        ([0, 1], ("A", "B"), 0),  # no labels, but positions
    ):
        terms = np.concatenate([expected[first], expected[1 - first]])
        np.testing.assert_allclose(in_model(coords, panel), terms, rtol=1e-12, atol=1e-14)
    with pytest.raises(ModelError, match=r"'a' must have a value for each record.*'A', 'C'"):
        in_model(["A", "C"])


def test_a_vector_that_all_records_share_has_coordinates_of_its_own():
    system = pair(
        transition=lambda x, q, w: [w[0] * x[0] + w[1] * x[1] + q[0], 0.8 * x[1] + q[1]],
        shapes={"w": (2,)},
    )
    with pm.Model(coords={"weight": ["own", "other"]}) as model:
        pm.Normal("w", dims="weight")
        psf.StateSpace(
            "d", system, psf.EKF(), panel=np.repeat(["A", "B"], STEPS.size),
            steps=np.tile(STEPS, 2), observed=np.tile(PAIR_DATA, (2, 1)),
        )  # fmt: skip
    (terms,) = model.compile_logp(model["d"], sum=False)({"w": np.array([0.5, 0.2])})
    np.testing.assert_allclose(terms, np.tile(pair_terms(0.5), 2), rtol=1e-12, atol=1e-14)


def test_the_order_of_records_that_may_be_replaced_is_that_of_the_rows():
    labels = pytensor.shared(np.repeat([7, 3], STEPS.size))
    in_model([7, 3], labels=labels)
    with pytest.raises(ModelError, match=r"in the order of the rows.*\[7, 3\].*got .*\[3, 7\]"):
        in_model([3, 7], labels=labels)


def test_data_of_a_model_are_aligned_by_label():
    with pm.Model() as model:
        pm.Normal("a")
        psf.StateSpace("d", PAIR, psf.EKF(), steps=STEPS, observed=SWAPPED)
        rows = {"steps": np.tile(STEPS, 2), "panel": np.repeat([1, 2], STEPS.size)}
        psf.StateSpace(
            "two", PAIR, psf.EKF(), observed=pd.concat([SWAPPED, SWAPPED]), **rows,
            dims=("two_obs", "sensor"),
        )  # fmt: skip
    np.testing.assert_array_equal(model.rvs_to_values[model["d"]].eval(), PAIR_DATA)
    np.testing.assert_array_equal(
        model.rvs_to_values[model["two"]].eval(), np.concatenate([PAIR_DATA, PAIR_DATA])
    )


def test_a_table_in_long_format_keeps_the_names_of_its_columns():
    table = FRAME.assign(who="A", time=STEPS.astype(float))
    columns = {"record": "who", "time": "time", "dt": 1.0}
    for values in (["position", "speed"], ["speed", "position"]):
        record = psf.panel_from(table, values=values, **columns)
        terms = psf.log_likelihood(PAIR, psf.EKF(), A, **record)
        np.testing.assert_allclose(terms, pair_terms(0.5), rtol=1e-12, atol=1e-14)


def test_inputs_are_aligned_by_label():
    system = psf.StateSpaceModel(
        transition=lambda x, u: [x[0] + u[0] - 2.0 * u[1]],
        observation=lambda x: [x[0]],
        observation_noise=[[1.0]],
        initial_mean=[0.0],
        initial_cov=[[0.0]],
        inputs=["in", "out"],
    )
    inputs = pd.DataFrame({"out": [1.0, 0.0, 2.0], "in": [0.5, 0.3, 0.0]})
    found = psf.simulate(system, {}, steps=[3], inputs=inputs, random_seed=1)
    assert found["states"].values[-1, 0] == pytest.approx(0.8 - 2.0 * 3.0)
    each = {"b": inputs, "a": inputs[["in", "out"]]}
    found = psf.simulate(
        system, {}, steps=[3, 3], panel=["a", "b"], inputs=each, random_seed=1
    )  # fmt: skip
    assert found["states"].values[[3, 7], 0] == pytest.approx(0.8 - 2.0 * 3.0)
    with pytest.raises(ModelError, match=r"inputs must have a column .*'in', 'out'.*'inn'"):
        psf.simulate(system, {}, steps=[3], inputs=inputs.rename(columns={"in": "inn"}))


def test_other_labels_are_refused_by_name():
    for wrong in (
        FRAME.rename(columns={"speed": "spedd"}),
        FRAME.assign(time=0.0),
        FRAME[["speed"]],
        ARRAY.assign_coords(observable=["position", "other"]),
    ):
        with pytest.raises(ModelError, match=r"observables \['position', 'speed'\], got the"):
            psf.log_likelihood(PAIR, psf.EKF(), A, wrong, steps=STEPS)


def test_columns_without_names_are_taken_by_position():
    unnamed = pair(observables=None)
    for system, observed in (
        (unnamed, FRAME.rename(columns={"speed": "v"})),
        (PAIR, pd.DataFrame(PAIR_DATA)),
        (PAIR, FRAME.set_axis(["y0", "y1"], axis=1)),  # as simulated by an unnamed system
        (PAIR, xr.DataArray(PAIR_DATA)),
    ):
        names = system.observables
        values = columns_in_order("observed", observed, names, "observables")
        np.testing.assert_array_equal(values, PAIR_DATA)


def test_a_series_needs_no_name():
    series = pd.Series([0.3, 1.2], name="level")
    assert columns_in_order("observed", series, ["height"], "observables") is series


def test_parameters_of_records_are_aligned_by_label():
    labels = ["A", "B", "C"]
    series = pd.Series({"C": 3.0, "A": 1.0, "B": 2.0})
    for values in (series, xr.DataArray(series, dims="record"), np.array([1.0, 2.0, 3.0])):
        np.testing.assert_array_equal(rows_in_order("a", values, labels), [1.0, 2.0, 3.0])
    data = np.tile(PAIR_DATA, (2, 1))
    rows = {"steps": np.tile(STEPS, 2), "panel": np.repeat(["A", "B"], STEPS.size)}
    own = pd.Series({"B": 0.9, "A": 0.5})
    terms = psf.log_likelihood(PAIR, psf.EKF(), {"a": own}, data, **rows)
    expected = np.concatenate([pair_terms(0.5), pair_terms(0.9)])
    np.testing.assert_allclose(terms, expected, rtol=1e-12, atol=1e-14)
    with pytest.raises(ModelError, match=r"parameter 'a' must have a value for each record"):
        psf.log_likelihood(PAIR, psf.EKF(), {"a": own.rename({"B": "D"})}, data, **rows)
