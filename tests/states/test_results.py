"""What comes of any model and any draws: groups, names, choices, warnings, refusals."""

import json

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.pymc_model.observation_moments import sensors_of_states
from tests.states.models import (
    EKF,
    FORCE,
    PUSHED,
    T0,
    A,
    B,
    assert_exact,
    laws_of,
    pair_law,
    pair_model,
    posterior,
    pushed_law,
)
from tests.systems import FORCED_DATA, PAIR, PAIR_DATA, STEPS

pytestmark = pytest.mark.usefixtures("interpreted")

CALLS = {
    "filtered_states": psf.filtered_states,
    "smoothed_states": psf.smoothed_states,
    "predictions": lambda *args, **kwargs: psf.forecast(*args, n_steps=2, **kwargs),
}


def law_of_pair(a, b=0.2, moment="filtered"):
    return pair_law(moment, STEPS, a, b)


def pair_group(idata, model, **settings):
    return psf.filtered_states(idata, model, **settings)["filtered_states"]


# Several variables, and their names.


def two_systems():
    with pm.Model() as model:
        pm.Normal("b")
        pm.Normal("a")
        psf.StateSpace("d", PAIR, EKF, steps=STEPS, observed=PAIR_DATA)
        psf.StateSpace(
            "e", PUSHED, EKF, params={"a": model["b"]}, steps=STEPS, observed=FORCED_DATA,
            inputs=FORCE, t0=T0, dims=("e_time", "sensor"),
        )  # fmt: skip
        psf.StateSpace(
            "f", PAIR, EKF, params={"a": model["b"], "b": model["a"]}, steps=STEPS,
            observed=PAIR_DATA,
        )  # fmt: skip
    return model


def test_several_variables_share_a_group_and_what_they_have_in_common():
    group = pair_group(posterior(a=A, b=B), two_systems())
    assert_exact(group, laws_of(law_of_pair, A, B), "d")
    sensors = json.loads(group["d_states"].attrs["observables"])
    assert sensors == {"x0": "position", "x1": "speed"}
    assert_exact(group, laws_of(lambda a: pushed_law("filtered", STEPS, a), B), "e")
    assert_exact(group, laws_of(law_of_pair, B, A), "f")
    assert group["d_mean"].dims == ("chain", "draw", "d_time", "state")
    assert group["e_mean"].dims == ("chain", "draw", "e_time", "e_state")
    assert group["f_mean"].dims == ("chain", "draw", "f_time", "state")
    assert group["state"].values.tolist() == list(PAIR.states)


def test_one_variable_of_several_keeps_its_dimensions():
    model, idata = two_systems(), posterior(a=A, b=B)
    group = pair_group(idata, model, var_name="e")
    assert set(group.data_vars) == {"e_mean", "e_sd", "e_states", "e_n_effective"}
    assert_exact(group, laws_of(lambda a: pushed_law("filtered", STEPS, a), B), "e")
    assert group["e_mean"].dims == ("chain", "draw", "e_time", "e_state")
    future = psf.forecast(
        idata, model, n_steps=2, var_name="e", inputs=np.zeros(9), extend_inferencedata=False
    )["predictions"]
    assert future["e"].dims == ("chain", "draw", "e_time", "sensor")
    assert future["e_states"].dims == ("chain", "draw", "e_time", "e_state")


def test_names_of_dimensions_that_the_user_chose():
    model = pair_model(dims=("when", "what"))
    for name, call in CALLS.items():
        group = call(posterior(a=A), model)[name]
        assert group["d_states"].dims == ("chain", "draw", "when", "state")
    assert group["d"].dims == ("chain", "draw", "when", "what")
    assert group["what"].values.tolist() == ["position", "speed"]
    assert group["when"].values.tolist() == [7, 8]


def test_a_dimension_of_observables_called_state():
    model = pair_model(dims=("d_time", "state"))
    group = psf.forecast(posterior(a=A), model, n_steps=1)["predictions"]
    assert group["d"].dims[-1] == "state"
    assert group["state"].values.tolist() == ["position", "speed"]
    assert group[group["d_states"].dims[-1]].values.tolist() == list(PAIR.states)


def test_variables_of_a_submodel():
    with pm.Model() as model:
        pm.Normal("b")
        with pm.Model("inner"):
            pm.Normal("a")
            psf.StateSpace("d", PAIR, EKF, steps=STEPS, observed=PAIR_DATA)
    idata = posterior(**{"inner::a": A, "b": B})
    group = pair_group(idata, model, var_name="inner::d")
    assert_exact(group, laws_of(law_of_pair, A, B), "inner::d")
    assert group["inner::d_mean"].dims == ("chain", "draw", "inner::d_time", "state")


def test_the_model_of_the_context():
    with pair_model():
        for name, call in CALLS.items():
            assert name in call(posterior(a=A)).children


# Groups of the DataTree.


@pytest.mark.parametrize("name", CALLS)
def test_groups_are_added_or_alone_and_made_anew(name):
    idata, model, call = posterior(a=A), pair_model(), CALLS[name]
    alone = call(idata, model, extend_inferencedata=False)
    assert set(alone.children) == {name}
    assert set(idata.children) == {"posterior"}
    assert call(idata, model, n_draws=2, random_seed=1) is idata
    first = idata[name].to_dataset()
    assert set(idata.children) == {"posterior", name}
    assert call(idata, model, random_seed=1) is idata
    assert (first.sizes["draw"], idata[name].sizes["draw"]) == (1, 3)
    assert set(idata["posterior"].data_vars) == {"a"}


def test_evenly_spread_draws_of_every_chain():
    values = np.random.default_rng(3).uniform(-0.5, 0.9, (2, 11))
    seeds = np.arange(22).reshape(2, 11)
    idata = posterior(a=values)
    idata["sample_stats"] = posterior(d_seed=seeds)["posterior"]
    model = pair_model(psf.BootstrapPF(64))
    everything = pair_group(idata, model).to_dataset()
    for n_draws, chosen in [(6, [0, 5, 10]), (7, [0, 5, 10]), (22, range(11)), (1, [0])]:
        group = pair_group(idata, model, n_draws=n_draws)
        assert group["draw"].values.tolist() == list(chosen)
        # The noise is that of the draws chosen, too.
        np.testing.assert_array_equal(group["d_mean"], everything["d_mean"][:, list(chosen)])


# Failures.


@pytest.mark.parametrize("name", CALLS)
def test_one_warning_where_the_user_called(name):
    values = A.copy()
    values[0, 1] = values[1, 2] = 1e300
    with pytest.warns(
        psf.errors.FilterWarning, match=r"^EKF\(\) gave -inf in 2 of 6 eval"
    ) as warned:
        CALLS[name](posterior(a=values), pair_model())
    assert [w.filename for w in warned] == [__file__]


@pytest.mark.parametrize("moment", ["filtered", "smoothed"])
def test_failing_draws_are_unknown_from_the_failure_on(moment):
    values = A.copy()
    values[0, 1] = 1e300
    with pytest.warns(psf.errors.FilterWarning):
        idata = CALLS[f"{moment}_states"](posterior(a=values), pair_model())
    group = idata[f"{moment}_states"]
    n_known = 1 if moment == "filtered" else 0
    for name in ("d_mean", "d_sd", "d_states", "d_n_effective"):
        found = group[name].values
        assert np.isfinite(found[0, 1, :n_known]).all() or name == "d_n_effective"
        assert np.isnan(found[0, 1, n_known:]).all()
        assert not np.isnan(np.delete(found.reshape(6, -1), 1, axis=0)).any()
    kept = group.to_dataset().isel(chain=[1])
    assert_exact(kept, laws_of(lambda a: law_of_pair(a, moment=moment), A[1:]))


# What is refused.


def no_variable():
    with pm.Model() as model:
        pm.Normal("a")
    return model


def unobserved():
    return pair_model(observed=None)


def wrong_shape():
    with pm.Model() as model:
        a = pm.Normal("a", shape=3)
        psf.StateSpace("d", PAIR, EKF, params={"a": a[0]}, steps=STEPS, observed=PAIR_DATA)
    return model


def other_name():
    with pm.Model() as model:
        alpha = pm.Normal("alpha")
        psf.StateSpace("d", PAIR, EKF, params={"a": alpha}, steps=STEPS, observed=PAIR_DATA)
    return model


GOOD = posterior(a=A)
REFUSED = {
    "dataset": (posterior(a=A)["posterior"].to_dataset(), pair_model, {}, "must be a DataTree"),
    "no posterior": (
        xr.DataTree.from_dict({"prior": GOOD["posterior"].to_dataset()}),
        pair_model,
        {},
        r"must have a group 'posterior', got \['prior'\]",
    ),
    "one chain": (
        xr.DataTree.from_dict({"posterior": GOOD["posterior"].to_dataset().isel(chain=0)}),
        pair_model,
        {},
        "dimensions chain and draw",
    ),
    "no variable": (GOOD, no_variable, {}, "must have an observed StateSpace variable"),
    "no data": (GOOD, unobserved, {}, "must have an observed StateSpace variable"),
    "another variable": (GOOD, pair_model, {"var_name": "e"}, r"one of \['d'\], got 'e'"),
    "many variables": (GOOD, pair_model, {"var_name": ["d"]}, r"one of \['d'\], got \['d'\]"),
    "shape": (GOOD, wrong_shape, {}, r"'a' has shape \(3,\) in the model, \(\) in idata"),
    "parameter": (GOOD, other_name, {}, r"no draws of 'alpha'.*with \['a'\]"),
    "filter": (GOOD, pair_model, {"filter": "ekf"}, "filter must be a filter .* got 'ekf'"),
    "filter of one state": (GOOD, pair_model, {"filter": psf.GridFilter()}, "one state"),
    "no draws": (GOOD, pair_model, {"n_draws": 0}, "integer from 1 to 6,.*got 0"),
    "too many draws": (GOOD, pair_model, {"n_draws": 7}, "integer from 1 to 6,.*got 7"),
    "half a draw": (GOOD, pair_model, {"n_draws": 2.5}, "integer from 1 to 6,.*got 2.5"),
    "true draws": (GOOD, pair_model, {"n_draws": True}, "integer from 1 to 6,.*got True"),
    "seed": (GOOD, pair_model, {"random_seed": -1}, "random_seed must be None, an int.* got -1"),
    "empty": (GOOD.isel(draw=slice(0)), pair_model, {}, "must have draws"),
}


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_refused(case, name):
    idata, model, settings, message = REFUSED[case]
    with pytest.raises(psf.errors.ModelError, match=message):
        CALLS[name](idata, model(), **settings)


@pytest.mark.parametrize("at", ["observation", 3, ["steps"]])
def test_rows_are_at_observations_or_steps(at):
    for call in (psf.filtered_states, psf.smoothed_states):
        with pytest.raises(
            psf.errors.ModelError, match=r"at must be one of \['observations', 'steps'\]"
        ):
            call(GOOD, pair_model(), at=at)


SENSORS = {
    "another name": (lambda x: [x[1]], {"speed": "y0"}),
    "matrix": (lambda x: np.array([[1.0, 0.0]]) @ x, {"place": "y0"}),
    "noise of its own": (lambda x, e: [x[0] + e[0]], {"place": "y0"}),
    "all, in turn": (lambda x: [x[1], x[0]], {"speed": "y0", "place": "y1"}),
    "two of one state": (lambda x: [x[0], x[0]], {"place": "y0"}),
    "sum": (lambda x: [x[0] + x[1]], {}),
    "unknown gain": (lambda x, a: [a * x[0]], {}),
    "function": (lambda x: [pt.exp(x[0])], {}),
    "trend": (lambda x, t: [x[0] + t], {}),
}


@pytest.mark.parametrize("case", SENSORS)
def test_observables_that_are_a_state(case):
    observation, expected = SENSORS[case]
    p = len(expected) if case == "all, in turn" else 1 + (case == "two of one state")
    system = psf.StateSpaceModel(
        transition=lambda x, q, a: [a * x[0] + x[1], x[1] + q[0]],
        process_noise=[[1.0]],
        observation=observation,
        observation_noise=np.eye(p),
        initial_mean=[0.0, 0.0],
        initial_cov=np.eye(2),
        states=["place", "speed"],
        observables=[f"y{i}" for i in range(p)],
    )
    assert sensors_of_states(system) == expected
