"""Forecasts: the exact joint law of states and observations after the record, and its inputs."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.evaluation.simulate import observer
from tests.filters.test_ekf_states import assert_drawn_from
from tests.states.models import (
    DATA_NOISE,
    DT,
    EKF,
    FORCE,
    PUSHED,
    SHAPE,
    T0,
    A,
    counted_model,
    pair_law,
    pair_model,
    posterior,
    pushed_law,
    pushed_model,
    shown,
)
from tests.systems import FORCED_DATA, PAIR, PAIR_DATA, STEPS

pytestmark = pytest.mark.usefixtures("interpreted")

RATE = 1e-3  # of right implementations fail each statistical test
FUTURE = np.array([7, 8, 11])  # after step 6, with a gap
LONG_FORCE = np.append(FORCE, [-1.0, 0.0, 3.0, 1.0, 2.0])


def predictions(*args, **kwargs):
    return psf.forecast(*args, random_seed=1, **kwargs)["predictions"]


def joint_law(states, noise, beside=0.0):
    """Mean and covariance of (states (R, n), observations (R, n)), which show states and more."""
    R, n = states.mean.shape
    cov = states.cov.reshape(R * n, R * n)
    seen = cov + np.kron(np.eye(R), noise)
    mean = np.concatenate([states.mean.ravel(), states.mean.ravel() + beside])
    return mean, np.block([[cov, cov], [cov, seen]])


def pushed_joint_law(force, rows=FUTURE):
    """That of PUSHED with a = 0.7."""
    return joint_law(pushed_law("smoothed", rows, 0.7, force), [[0.5]], shown(rows, force))


def joined(group):
    """States and observations of every draw, (draws, 2 R n)."""
    arrays = [group[name].values for name in ("d_states", "d")]
    return np.concatenate([array.reshape(-1, array[0, 0].size) for array in arrays], axis=1)


@pytest.mark.parametrize("a", [0.6, -0.4])
def test_states_and_observations_have_their_joint_law_over_time(a):
    group = predictions(posterior(a=np.full((2, 2000), a)), pair_model(), steps=FUTURE)
    mean, cov = joint_law(pair_law("smoothed", FUTURE, a), DATA_NOISE)
    assert_drawn_from(joined(group), mean, cov, RATE)


def test_each_draw_goes_on_from_its_own_state_with_its_own_parameters():
    """So that all of them together have no common law, but each part of them its own."""
    values = np.array([0.9, -0.5])
    group = predictions(
        posterior(a=np.tile(values, (2, 1500))), pair_model(), n_steps=2, filter=EKF
    )
    for i in (0, 1):
        mean, cov = joint_law(pair_law("smoothed", np.array([7, 8]), values[i]), DATA_NOISE)
        part = group.to_dataset().isel(draw=slice(i, None, 2))
        assert_drawn_from(joined(part), mean, cov, RATE)


def test_it_begins_with_the_filters_state_of_the_last_observation():
    """Without noise on the way a path is its beginning's image."""
    calm = posterior(a=np.full(SHAPE, 0.6))
    begin = psf.filtered_states(calm, pair_model(), random_seed=1)["filtered_states"]
    later = psf.forecast(calm, pair_model(), n_steps=1, random_seed=1)["predictions"]
    # The same random numbers: what is left is the noise of one step.
    x = begin["d_states"].values[:, :, -1]
    step = later["d_states"].values[:, :, 0] - np.stack(
        [0.6 * x[..., 0] + 0.2 * x[..., 1], 0.8 * x[..., 1]], -1
    )
    assert (np.abs(step) < 5.0 * np.sqrt([1.0, 0.5])).all()


def test_inputs_of_the_record_and_of_the_future():
    """The record's part is really used: the filter reads it."""
    idata, model = posterior(a=np.full((2, 1500), 0.7)), pushed_model()
    changed = LONG_FORCE.copy()
    changed[:6] += [0.0, 0.0, 0.0, 0.0, 4.0, 4.0]
    for force in (LONG_FORCE, changed):
        group = predictions(idata, model, steps=FUTURE, inputs=force)
        assert_drawn_from(joined(group), *pushed_joint_law(force), RATE)


def test_future_inputs_alone_follow_those_of_the_model():
    idata, model = posterior(a=A), pushed_model()
    whole = predictions(idata, model, steps=FUTURE, inputs=LONG_FORCE)
    alone = predictions(idata, model, steps=FUTURE, inputs=LONG_FORCE[7:])
    assert alone.to_dataset().identical(whole.to_dataset())


def test_inputs_of_the_model_reach_beyond_its_record():
    """They depend on a free variable, too: each draw has its own."""
    with pm.Model() as model:
        gain = pm.Normal("gain")
        psf.StateSpace(
            "d", PUSHED, EKF, params={"a": 0.7}, steps=STEPS, observed=FORCED_DATA,
            inputs=gain * pt.as_tensor(LONG_FORCE), t0=T0,
        )  # fmt: skip
    gains = np.array([0.5, 2.0])
    group = predictions(posterior(gain=np.tile(gains, (2, 1500))), model, steps=FUTURE)
    for i in (0, 1):
        part = group.to_dataset().isel(draw=slice(i, None, 2))
        assert_drawn_from(joined(part), *pushed_joint_law(gains[i] * LONG_FORCE), RATE)
    with pytest.raises(
        psf.errors.ModelError, match=r"end after 12 rows, and step 12 needs 13: give inp"
    ):
        predictions(posterior(gain=A), model, n_steps=6)


def test_ways_to_say_when():
    idata, model = posterior(a=A), pushed_model(LONG_FORCE)
    groups = [
        predictions(idata, model, **when)
        for when in ({"n_steps": 3}, {"steps": [7, 8, 9]}, {"times": T0 + DT * np.arange(7, 10)})
    ]
    for group in groups:
        np.testing.assert_array_equal(group["d_time"], [13.5, 14.0, 14.5])
        np.testing.assert_array_equal(group["d"], groups[0]["d"])
    assert groups[0]["d"].dims == ("chain", "draw", "d_time", "observable")
    assert groups[0]["d_states"].dims == ("chain", "draw", "d_time", "state")


def test_parameters_that_no_draw_changes():
    params = {"a": 0.7, "b": 0.1}
    with pm.Model() as model:
        pm.Normal("unused")
        psf.StateSpace("d", PAIR, EKF, params=params, steps=STEPS, observed=PAIR_DATA)
    group = predictions(posterior(unused=np.zeros((2, 1500))), model, n_steps=2)
    law = pair_law("smoothed", np.array([7, 8]), 0.7, 0.1)
    assert_drawn_from(joined(group), *joint_law(law, DATA_NOISE), RATE)


def test_a_draw_at_which_the_filter_fails_has_no_forecast():
    values = A.copy()
    values[1, 0] = 1e300
    with pytest.warns(psf.errors.FilterWarning, match=r"in 1 of 6 evaluations") as warned:
        group = psf.forecast(posterior(a=values), pair_model(), n_steps=2)["predictions"]
    assert [w.filename for w in warned] == [__file__]
    failed = np.zeros(SHAPE, dtype=bool)
    failed[1, 0] = True
    for name in ("d", "d_states"):
        np.testing.assert_array_equal(np.isnan(group[name]).all(["d_time"])[..., 0], failed)
        np.testing.assert_array_equal(np.isnan(group[name]).any(["d_time"])[..., 0], failed)


def test_counts_are_forecast_as_counts():
    """Dispersion: the mean of counts is that of their rate, the variance larger by the mean."""
    model = counted_model(initial_mean=0.0)
    values = np.tile([0.3, 1.3], (2, 1500))
    values[1, 0] = 1e300  # the filter fails, and no count is that of an unknown rate
    with pytest.warns(psf.errors.FilterWarning, match="in 1 of 6000 evaluations"):
        group = predictions(posterior(level=values), model, n_steps=30).to_dataset().isel(d_time=-1)
    assert group["d"].isnull().sum() == group["d"][1, 0].isnull().sum() == 1
    for i, c in enumerate((0.3, 1.3)):
        part = group.isel(draw=slice(i, None, 2))
        known = part["d"].notnull().values.ravel()
        counts = part["d"].values.ravel()[known]
        assert (counts % 1 == 0).all()
        # 30 steps later the state is stationary, with variance 0.2 / (1 - 0.64).
        v = 0.2 / 0.36
        mean = np.exp(c + v / 2)
        variance = mean + mean**2 * np.expm1(v)
        assert abs(counts.mean() - mean) < 5 * np.sqrt(variance / counts.size)
        rate = np.exp(c + part["d_states"].values.ravel()[known])
        z = (counts - rate) / np.sqrt(rate)
        assert abs(z.mean()) < 5 / np.sqrt(z.size)
        assert abs(np.mean(z**2) - 1) < 5 * np.sqrt((2 + np.mean(1 / rate)) / z.size)


def test_observations_of_given_states():
    """At their own steps: inputs and time enter there."""
    steps = np.array([2, 3, 6])
    states = np.random.default_rng(1).normal(size=(3, 1))
    force = np.asarray(FORCE)[:, None]
    look, rng = observer(PUSHED).function, np.random.default_rng(2)
    seen = np.array([look(rng, np.array([[0.7]]), states, steps, force, T0) for _ in range(4000)])
    mean = states[:, 0] + shown(steps, FORCE)
    assert_drawn_from(seen[:, :, 0], mean, 0.5 * np.eye(3), RATE)


def test_the_same_seed_gives_the_same_forecast():
    idata, model = posterior(a=A), pair_model()
    one, two, other = (
        psf.forecast(idata, model, n_steps=2, random_seed=seed)["predictions"].to_dataset()
        for seed in (1, 1, 2)
    )
    assert one.identical(two)
    assert (one["d"] != other["d"]).all()


WRONG = [
    (dict(), "give exactly one of n_steps, steps and times"),
    (dict(n_steps=2, steps=[7]), "give exactly one of n_steps, steps and times"),
    (dict(n_steps=0), "n_steps must be an integer of at least 1, got 0"),
    (dict(n_steps=2.0), "n_steps must be an integer of at least 1, got 2.0"),
    (dict(n_steps=True), "n_steps must be an integer of at least 1, got True"),
    (dict(steps=[6, 7]), "steps must be after the last observation, at step 6, got 6"),
    (dict(steps=[]), "steps must hold at least one step, got"),
    (dict(steps=[9, 8]), "steps must increase strictly"),
    (dict(steps=[7.5]), "steps must be a vector of integers"),
    (dict(times=[T0]), r"times must be after the last observation, at 13.0, got 10.0"),
    (dict(times=[13.6]), r"times\[0\] = .*13.6.* is off the grid t0 \+ k\*dt with t0 = 10"),
    (dict(n_steps=2), "the model's inputs end after 7 rows, and step 8 needs 9"),
    (dict(n_steps=2, inputs=FORCE), "inputs must have at least 9 rows.* step 8 .*got 7"),
    (dict(n_steps=2, inputs=np.zeros((2, 2))), r"inputs must have shape \(steps, 1\)"),
    (dict(n_steps=2, inputs=np.zeros((10, 2))), r"inputs must have shape \(steps, 1\)"),
    (dict(n_steps=2, inputs="none"), "inputs must be numbers"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG)
def test_what_cannot_be_forecast(arguments, message):
    with pytest.raises(psf.errors.ModelError, match=message):
        psf.forecast(posterior(a=A), pushed_model(), **arguments)


def test_whole_numbers_of_numpy():
    group = predictions(posterior(a=A), pair_model(), n_steps=np.int64(2), n_draws=np.int64(2))
    assert group["d"].sizes["d_time"] == 2
    assert group["d"].sizes["draw"] == 1
