"""States along a record: each draw has its own parameters, data, inputs and noise."""

from functools import partial

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from tests.states.models import (
    ALL_STEPS,
    DT,
    EKF,
    FORCE,
    PUSHED,
    SHAPE,
    T0,
    A,
    B,
    assert_exact,
    laws_of,
    pair_law,
    pair_model,
    posterior,
    pushed_law,
    pushed_model,
)
from tests.systems import FORCED_DATA, PAIR, PAIR_DATA, STEPS

pytestmark = pytest.mark.usefixtures("interpreted")

PF = psf.BootstrapPF(64)
ESTIMATES = {"filtered": psf.filtered_states, "smoothed": psf.smoothed_states}


def record(name="d", params=None, filter=EKF):
    return psf.StateSpace(name, PAIR, filter, params=params, steps=STEPS, observed=PAIR_DATA)


def by_name_in_another_order():
    pm.Normal("b")
    pm.HalfNormal("a")
    record()
    return {"a": abs(A), "b": B}, (abs(A), B)


def entries_of_a_matrix_and_data():
    scale = pm.Data("scale", 2.0)
    k = pm.Normal("k", shape=(2, 2))
    record(params={"b": k[0, 1] / scale, "a": k[1, 0]})
    return {"k": np.stack([np.stack([A, 2 * B], -1), np.stack([A, B], -1)], -2)}, (A, B)


def default_of_the_function():
    pm.Normal("a")
    record()
    return {"a": A}, (A, 0.2)


def constants_alone():
    pm.Normal("unused")
    record(params={"a": 0.7, "b": 0.1})
    return {"unused": A}, (np.full(SHAPE, 0.7), 0.1)


def named_expressions_of_whole_numbers():
    n = pm.DiscreteUniform("n", 0, 9)
    pm.Deterministic("a", n / 10.0)
    pm.Bernoulli("b", 0.5)
    record()
    n = np.arange(6).reshape(SHAPE)
    return {"n": n, "b": n % 2}, (n / 10.0, n % 2)


def observed_parameter():
    """It has its data's value; another draw of it would be another parameter."""
    pm.Normal("a")
    pm.Normal("b", 0.0, 5.0, observed=-0.3)
    record()
    return {"a": A}, (A, -0.3)


def hyperparameter_that_was_not_stored():
    mu = pm.Normal("mu")
    pm.Normal("a", mu, 1.0)
    record()
    return {"a": A}, (A, 0.2)


WAYS = [
    by_name_in_another_order, entries_of_a_matrix_and_data, default_of_the_function,
    constants_alone, named_expressions_of_whole_numbers, observed_parameter,
    hyperparameter_that_was_not_stored,
]  # fmt: skip


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
def test_each_draw_has_its_own_parameters(way):
    with pm.Model() as model:
        values, parameters = way()
    idata = psf.filtered_states(posterior(**values), model, at="steps")
    laws = laws_of(partial(pair_law, "filtered", ALL_STEPS), *parameters)
    group = idata["filtered_states"]
    assert_exact(group, laws)
    assert group["d_mean"].dims == ("chain", "draw", "d_time", "state")
    assert group["d_n_effective"].dims == ("chain", "draw", "d_time")
    assert np.isposinf(group["d_n_effective"]).all()


# The states that the observables are, as JSON.
SEEN = '{"x0": "position", "x1": "speed"}'


@pytest.mark.parametrize("at", ["observations", "steps"])
def test_smoothed_states_know_the_whole_record(at):
    rows = {"observations": STEPS, "steps": ALL_STEPS}[at]
    idata = psf.smoothed_states(posterior(a=A), pair_model(), at=at)
    assert set(idata.children) == {"posterior", "smoothed_states"}
    group = idata["smoothed_states"]
    assert_exact(group, laws_of(partial(pair_law, "smoothed", rows), A))
    assert group.attrs["at"] == at
    smoothing = EKF.smoothing_method(compile_system(PAIR))
    attrs = {"filter": "EKF()", "smoothing": smoothing, "observables": SEEN}
    assert group["d_states"].attrs == attrs


def test_at_observations_by_default():
    group = psf.filtered_states(posterior(a=A), pair_model())["filtered_states"]
    assert_exact(group, laws_of(partial(pair_law, "filtered", STEPS), A))
    assert group.attrs["at"] == "observations"
    assert group["d_states"].attrs == {"filter": "EKF()", "observables": SEEN}


def test_draws_in_another_order_of_dimensions():
    idata = posterior(a=A)
    idata["posterior"] = idata["posterior"].to_dataset().transpose("draw", "chain")
    group = psf.filtered_states(idata, pair_model())["filtered_states"]
    assert_exact(group, laws_of(partial(pair_law, "filtered", STEPS), A))


def test_draws_must_be_finite():
    idata = posterior(a=np.where(A == A.flat[0], np.nan, A))
    with pytest.raises(psf.errors.ModelError, match="'a' in idata must be finite, got 1 of"):
        psf.filtered_states(idata, pair_model())


def test_coordinates_are_times_names_and_the_draws_own():
    idata = posterior(a=A).isel(draw=[2, 0])
    idata["posterior"] = idata["posterior"].to_dataset().assign_coords(chain=[4, 7])
    for at, rows in {"observations": STEPS, "steps": ALL_STEPS}.items():
        group = psf.filtered_states(idata, pushed_model(), at=at)["filtered_states"]
        np.testing.assert_array_equal(group["d_time"], T0 + DT * rows)
        assert_exact(group, laws_of(partial(pushed_law, "filtered", rows), A[:, [2, 0]]))
    assert group["draw"].values.tolist() == [2, 0]
    assert group["chain"].values.tolist() == [4, 7]
    assert group["state"].values.tolist() == list(PUSHED.states)


def test_inputs_that_depend_on_free_variables():
    with pm.Model() as model:
        gain = pm.Normal("gain")
        psf.StateSpace(
            "d", PUSHED, EKF, params={"a": 0.7}, steps=STEPS, observed=FORCED_DATA,
            inputs=gain * pt.as_tensor(FORCE), t0=T0,
        )  # fmt: skip
    idata = psf.smoothed_states(posterior(gain=A), model)
    laws = laws_of(lambda gain: pushed_law("smoothed", STEPS, 0.7, gain * FORCE), A)
    assert_exact(idata["smoothed_states"], laws)


def test_data_exchanged_after_sampling():
    shifted = np.nan_to_num(PAIR_DATA) + 1.0
    dims = ("d_time", "observable")
    with pm.Model(coords={"observable": PAIR.observables}) as model:
        pm.Normal("a")
        steps = pm.Data("steps", STEPS, dims=dims[:1])
        observed = pm.Data("observed", shifted, dims=dims)
        psf.StateSpace("d", PAIR, EKF, steps=steps, observed=observed, dims=dims)
    new = np.array([1, 5])
    pm.set_data({"steps": new, "observed": shifted[2:] - 3.0}, model, coords={"d_time": new})
    group = psf.filtered_states(posterior(a=A), model, at="steps")["filtered_states"]
    laws = laws_of(lambda a: pair_law("filtered", np.arange(6), a, 0.2, shifted[2:] - 3.0, new), A)
    assert_exact(group, laws)
    np.testing.assert_array_equal(group["d_time"], np.arange(6))


def test_a_shared_record_with_gaps():
    observed = pytensor.shared(np.zeros_like(PAIR_DATA))
    model = pair_model(observed=observed)
    observed.set_value(PAIR_DATA)
    group = psf.filtered_states(posterior(a=A), model)["filtered_states"]
    assert_exact(group, laws_of(partial(pair_law, "filtered", STEPS), A))


def test_drawn_states_vary_as_the_moments_say():
    """Means and variances within 5 standard errors: once in 100 000 seeds for 8 numbers."""
    idata = psf.filtered_states(posterior(a=np.full((2, 2000), 0.6)), pair_model(), random_seed=3)
    group, law = idata["filtered_states"], pair_law("filtered", STEPS, 0.6)
    z = ((group["d_states"].values - law.mean) / law.sd).reshape(4000, -1)
    assert np.abs(z.mean(0)).max() < 5 / np.sqrt(4000)
    assert np.abs(z.var(0) - 1).max() < 5 * np.sqrt(2 / 4000)


# Noise.


def test_a_draw_has_the_noise_of_its_own_estimate():
    seeds = np.arange(6).reshape(SHAPE) * 10**17 + 7
    idata = posterior(a=A)
    idata["sample_stats"] = posterior(d_seed=seeds)["posterior"]
    model = pair_model(PF)
    one, two = (
        psf.filtered_states(idata, model, random_seed=i, extend_inferencedata=False) for i in (1, 2)
    )
    one, two = one["filtered_states"], two["filtered_states"]
    np.testing.assert_array_equal(one["d_mean"], two["d_mean"])
    assert (one["d_states"] != two["d_states"]).mean() > 0.5
    likelihood = evaluator(LogLikelihood(PAIR, PF))
    for place in np.ndindex(SHAPE):
        theta = np.array([A[place], 0.2])
        _, health = likelihood(theta, STEPS, PAIR_DATA, np.zeros((0, 0)), 0.0, seeds[place])
        # The third observation is missing: nothing is weighted there.
        n_effective = one["d_n_effective"].values[place][[0, 1, 3]]
        assert n_effective.min() == pytest.approx(health[0], rel=1e-12)


def test_fresh_noise_for_each_draw_where_none_is_stored():
    idata = posterior(a=np.full(SHAPE, 0.6))
    model = pair_model(PF, seed=5)
    means = [
        psf.filtered_states(idata, model, random_seed=seed)["filtered_states"]["d_mean"].values
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(means[0], means[1])
    all_means = np.concatenate([means[0], means[2]]).reshape(12, -1)
    assert len(np.unique(all_means[:, 0])) == 12


def test_moved_noise_is_no_longer_that_of_a_seed():
    idata = posterior(a=np.full(SHAPE, 0.6))
    stats = posterior(d_seed=np.full(SHAPE, 3), correlation=np.full(SHAPE, 0.9))
    idata["sample_stats"] = stats["posterior"]
    mean = psf.filtered_states(idata, pair_model(PF))["filtered_states"]["d_mean"].values
    assert len(np.unique(mean[..., 0, 0])) == 6


def test_another_filter_with_its_own_name_and_noise():
    idata = psf.filtered_states(posterior(a=A), pair_model(), filter=PF, random_seed=1)
    group = idata["filtered_states"]
    assert group["d_states"].attrs["filter"] == repr(PF)
    assert (group["d_n_effective"] < 64.5).all()
    law = pair_law("filtered", STEPS, A[1, 2])
    # Eight times the standard error of 64 members at their least effective.
    z = (group["d_mean"].values[1, 2] - law.mean) / law.sd
    assert 0 < np.abs(z).max() < 8 / np.sqrt(group["d_n_effective"].min())


@pytest.mark.parametrize("seed", [None, 4, np.random.default_rng(4)], ids=["none", "int", "rng"])
def test_kinds_of_seeds(seed):
    model, idata = pair_model(), posterior(a=A)
    drawn = [
        psf.filtered_states(idata, model, random_seed=seed)["filtered_states"]["d_states"].values
        for _ in range(2)
    ]
    assert (drawn[0] == drawn[1]).all() == (seed == 4)


@pytest.mark.parametrize("estimate", ESTIMATES.values(), ids=ESTIMATES)
def test_every_draw_is_drawn_apart(estimate):
    idata = estimate(posterior(a=np.full(SHAPE, 0.6)), pair_model(), random_seed=1)
    drawn = list(idata.children.values())[-1]["d_states"].values
    assert len(np.unique(drawn)) == drawn.size


def test_seeds_belong_to_the_draws_of_their_labels():
    """Draws thinned by the user, whose statistics were not."""
    model, idata = pair_model(PF), posterior(a=A)
    idata["sample_stats"] = posterior(d_seed=np.arange(6).reshape(SHAPE))["posterior"]
    means = psf.filtered_states(idata, model, random_seed=1)["filtered_states"]["d_mean"]
    kept = {"chain": [1], "draw": [0, 2]}
    thinned = idata.copy()
    thinned["posterior"] = idata["posterior"].isel(kept)
    found = psf.filtered_states(thinned, model, random_seed=2)["filtered_states"]["d_mean"]
    np.testing.assert_array_equal(found, means.isel(kept))
    others = thinned["posterior"].to_dataset().assign_coords(draw=[7, 8])
    thinned["posterior"] = xr.DataTree(others)
    with pytest.raises(psf.errors.ModelError, match="not among those of sample_stats"):
        psf.filtered_states(thinned, model)
