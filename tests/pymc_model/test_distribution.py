"""`StateSpace`, what is said to it: where values come from, what is accepted, what is refused."""

import numpy as np
import pandas as pd
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from tests.modes import AS_IT_STANDS
from tests.systems import (
    FORCE,
    FORCED,
    FORCED_DATA,
    PAIR,
    PAIR_DATA,
    STEPS,
    autoregression,
    forced,
    forced_terms,
    pair_terms,
)

pytestmark = pytest.mark.usefixtures("interpreted")

ENKF = psf.EnKF(20)


def pair_variable(name="d", filter=psf.EKF(), **changes):  # noqa: B008 (settings are frozen)
    return psf.StateSpace(name, PAIR, filter, **{"steps": STEPS, "observed": PAIR_DATA} | changes)


def forced_variable(name="d", **changes):
    settings = {"steps": STEPS, "observed": FORCED_DATA, "inputs": FORCE, "params": {"a": 0.6}}
    return psf.StateSpace(name, FORCED, psf.EKF(), **settings | changes)


def terms(variable):
    """The log-likelihood terms at fixed parameters, by PyTensor's reference linker."""
    model = pm.modelcontext(None)
    value = model.rvs_to_values[variable]
    return pm.logp(variable, value).eval(mode=AS_IT_STANDS)


# Where parameters come from.


def as_variable():
    pm.Normal("a", 0.6, 1)


def as_data():
    pm.Data("a", 0.6)


def as_deterministic():
    pm.Deterministic("a", 2 * pm.Normal("half", 0.3, 1))


def as_number():
    return {"a": 0.6}


def as_expression():
    return {"a": 3 * pm.Normal("k", [0.2, 0.3], 1)[0]}


@pytest.mark.parametrize("give", [as_variable, as_data, as_deterministic, as_number, as_expression])
def test_parameters_are_found(give):
    with pm.Model() as model:
        pair_variable(params=give())
        (logp,) = model.compile_logp([model["d"]], sum=False)(model.initial_point())
    np.testing.assert_allclose(logp, pair_terms(0.6), rtol=1e-12)


def test_params_win_over_the_model_and_the_model_over_defaults():
    with pm.Model():
        pm.Data("a", 0.1)
        pm.Data("b", -0.4)
        np.testing.assert_allclose(
            terms(pair_variable(params={"a": 0.6})), pair_terms(0.6, -0.4), rtol=1e-12
        )


def test_a_submodel_sees_its_own_variables_first_then_those_around_it():
    with pm.Model() as model:
        pm.Data("a", 0.6)
        pm.Data("b", 0.3)
        with pm.Model(name="sub"):
            pm.Data("b", -0.4)
            variable = pair_variable(filter=psf.EKF())
            np.testing.assert_allclose(terms(variable), pair_terms(0.6, -0.4), rtol=1e-12)
        with pm.Model(name="other"):
            # Another record of the same name: its dimension is its own.
            pair_variable(steps=[1, 5], observed=PAIR_DATA[:2])
    assert model.named_vars_to_dims["sub::d"] == ("sub::d_time", "observable")
    assert model.named_vars_to_dims["other::d"] == ("other::d_time", "observable")


def test_declared_shapes():
    system = forced(
        transition=lambda x, q, u, k: [k[0] * x[0] + k[1] * u[0] + q[0]], shapes={"k": (2,)}
    )
    record = {"steps": STEPS, "observed": FORCED_DATA, "inputs": FORCE}
    with pm.Model():
        pm.Normal("k", shape=2)
        psf.StateSpace("d", system, psf.EKF(), **record)
        with pytest.raises(ModelError, match=r"'k' must have shape \(2,\), got \(\)"):
            psf.StateSpace("e", system, psf.EKF(), params={"k": 1.0}, **record)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        (
            None,
            r"params must .*\['a'\] \(optional, with a default: \['b'\]\), got no .* \['a'\]",
        ),
        ({"a": 1.0, "c": 2.0}, r"params must name parameters .*\['a', 'b'\], got \['c'\]"),
        ({"a": [0.1, 0.2]}, r"'a' must have shape \(\), got \(2,\)"),
        ({"a": pt.dvector("v")}, r"'a' must have shape \(\)"),
        ({"a": "fast"}, "'a' must be numbers, got 'fast'"),
        ({"a": None}, "'a' must not be NaN, got None"),
        ([0.1], r"params must be a mapping.*got \[0.1\]"),
    ],
)
def test_wrong_parameters(params, message):
    with pm.Model(), pytest.raises(ModelError, match=message):
        pair_variable(params=params)


def test_data_with_the_name_of_a_parameter():
    with pm.Model():
        pm.Normal("a")
        with pytest.raises(ModelError, match=r"name .*'a', .*the parameter 'a' .*such as 'a_data'"):
            psf.StateSpace("a", PAIR, psf.EKF(), steps=STEPS, observed=PAIR_DATA)


def test_a_vector_in_the_model_for_a_scalar_parameter():
    with pm.Model():
        pm.Normal("a", shape=3)
        with pytest.raises(ModelError, match=r"'a' must have shape \(\), got \(3,\)"):
            pair_variable()


# Data.

COLUMN = FORCED_DATA[:, None]


@pytest.mark.parametrize(
    "observed",
    [
        FORCED_DATA,
        COLUMN,
        FORCED_DATA.tolist(),
        COLUMN.tolist(),
        [0.1, -0.4, None, 0.9],
        np.ma.masked_invalid(FORCED_DATA),
        np.ma.masked_array([0.1, -0.4, 7.0, 0.9], [False, False, True, False]),
        pd.Series(FORCED_DATA, index=list("abcd")),
        pd.Series([0.1, -0.4, None, 0.9], dtype="Float64"),
        pd.DataFrame({"y0": FORCED_DATA}),
        pt.as_tensor(COLUMN),
        pytensor.shared(COLUMN),
    ],
    ids=lambda value: type(value).__name__,
)
def test_data_as_people_have_them(observed):
    """All of them the same record, its missing row neither imputed nor dropped."""
    with pm.Model() as model:
        variable = forced_variable(observed=observed)
        assert variable.type.ndim == 2
        assert model.basic_RVs == [variable]
        np.testing.assert_allclose(terms(variable), forced_terms(0.6), rtol=1e-12)
    assert model.free_RVs == []


def test_times_in_place_of_steps():
    with pm.Model() as model:
        variable = forced_variable(steps=None, times=10.0 + STEPS, t0=10.0)
        np.testing.assert_allclose(terms(variable), forced_terms(0.6), rtol=1e-12)
        assert model.coords["d_time"] == (10.0, 12.0, 13.0, 16.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observed": pytensor.shared(np.zeros((3, 1)))}, r"observed must have shape \(4, 1\)"),
        ({"observed": pt.dvector("v")}, "observed must have 2 dimensions .*symbolic"),
        ({"steps": STEPS * 1.0}, r"steps must be a vector of integers.*\.astype\(int\)"),
        ({"steps": pytensor.shared(STEPS * 1.0)}, "steps must be a vector of integers"),
        ({"steps": [[1, 2], [1, 2, 3]]}, "lists of several lengths.*need panel="),
        ({"steps": [0, 2, 2, 6]}, r"got steps\[1\] = 2 followed by 2"),
        ({"steps": None, "times": pt.dvector("t")}, "times must be numbers, got a symbol"),
        ({"inputs": pytensor.shared(FORCE[:5])}, "inputs must have at least 6 rows.*got 5"),
        ({"inputs": pt.dtensor3("u")}, r"inputs must have shape \(steps, 1\)"),
        ({"seed": [1, 2]}, r"seed must be one integer, got an array of shape \(2,\)"),
        ({"dims": "time"}, "dims must be two names.*got 'time'"),
        ({"dims": ("time",)}, "dims must be two names"),
    ],
)
def test_wrong_records(changes, message):
    """What only a model may be given; `tests/test_bad_input.py` has what any call refuses so."""
    with pm.Model(), pytest.raises(ModelError, match=message):
        forced_variable(**changes)


def test_wrong_system_filter_and_inputs_that_nobody_asked_for():
    with pm.Model():
        with pytest.raises(ModelError, match=r"filter must be a filter such as psf.EKF\(\)"):
            pair_variable(filter=psf.EKF, params={"a": 1.0})
        with pytest.raises(ModelError, match="system must be a StateSpaceModel, got 'pair'"):
            psf.StateSpace("d", "pair", psf.EKF(), steps=STEPS)
        for inputs in (FORCE, pytensor.shared(FORCE)):
            with pytest.raises(ModelError, match="inputs must be None for a system without inputs"):
                pair_variable(params={"a": 1.0}, inputs=inputs)


def test_outside_a_model():
    with pytest.raises(TypeError, match="No model on context stack: add StateSpace inside"):
        pair_variable(params={"a": 1.0})
    with pytest.raises(ModelError, match=r"model must be given outside a `with` block .* got None"):
        psf.sample()


def test_name_clash():
    with pm.Model():
        pm.Normal("d")
        with pytest.raises(ValueError, match="d already exists"):
            pair_variable(params={"a": 1.0})


# Dimensions and coordinates.


def test_dimensions_and_coordinates():
    with pm.Model() as model:
        variable = pair_variable(params={"a": 0.6})
    assert variable.type.shape == (4, 2)
    assert model.named_vars_to_dims["d"] == ("d_time", "observable")
    assert model.coords == {"d_time": (0.0, 2.0, 3.0, 6.0), "observable": ("position", "speed")}


def test_renamed_dimensions_and_ones_that_the_user_made():
    with pm.Model(coords={"sensor": ["position", "speed"]}) as model:
        pair_variable(params={"a": 0.6}, dims=("time", "sensor"))
    assert model.named_vars_to_dims["d"] == ("time", "sensor")
    assert model.coords["time"] == (0.0, 2.0, 3.0, 6.0)


def test_dimensions_that_belong_to_something_else():
    with pm.Model(coords={"time": range(4), "observable": ["a", "b"]}):
        with pytest.raises(
            ModelError, match=r"'time', a dimension of length 4.*dims=\(\.\.\., \.\.\.\)"
        ):
            pair_variable(params={"a": 0.6}, dims=("time", "sensor"))
        with pytest.raises(ModelError, match="'observable', a dimension"):
            pair_variable(params={"a": 0.6})


def test_several_records_share_parameters():
    with pm.Model() as model:
        pm.Normal("a", 0.5, 1)
        pair_variable("first")
        pair_variable("second", filter=ENKF, steps=[1, 4], observed=PAIR_DATA[:2])
        with pytest.raises(ModelError, match=r"dims of 'third' must .*'observable'"):
            forced_variable("third")
        forced_variable("third", dims=("third_time", "place"))
    assert [v.name for v in model.free_RVs] == ["a"]
    assert model["second"].type.shape == (2, 2)
    logp = model.compile_logp([model["first"]], sum=False)
    np.testing.assert_allclose(logp({"a": 0.6})[0], pair_terms(0.6), rtol=1e-12)


def test_a_misspelt_parameter_is_shown_among_the_models_variables():
    with pm.Model():
        pm.Normal("fi")
        pm.HalfNormal("spread")
        words = (
            r"no value for the parameters \['phi'\]; the model's variables are \['fi', 'spread'\]: "
            "name one so, or give the value in params"
        )
        with pytest.raises(psf.errors.ModelError, match=words):
            psf.StateSpace("d", autoregression(), psf.EKF(), steps=[1], observed=[0.3])
