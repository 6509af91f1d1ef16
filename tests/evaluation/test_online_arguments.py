"""What `online` takes as a row and a state, what it refuses, and copies of it."""

import copy
import pickle

import numpy as np
import pandas as pd
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from tests.evaluation.test_online import ONE_STATE, OSCILLATOR, PARAMS, driven


def named(**changes):
    settings = {
        "transition": psf.EulerMaruyama(lambda x, k: [x[1], -k * x[0]], [[0.0], [0.5]], dt=0.1),
        "observation": lambda x: [x[0], x[1]],
        "observation_noise": np.diag([0.1, 0.2]),
        "initial_mean": [1.0, 0.0],
        "initial_cov": np.diag([0.1, 0.2]),
        "observables": ["place", "speed"],
    }
    return psf.StateSpaceModel(**settings | changes)


@pytest.mark.parametrize(
    "row",
    [
        pd.Series({"speed": 2.0, "place": 1.0}),
        pd.DataFrame({"speed": [2.0], "place": [1.0]}),
        np.array([1, 2]),
        (1.0, np.float32(2.0)),
    ],
    ids=["Series", "DataFrame", "integers", "tuple"],
)
def test_a_row_is_aligned_by_its_labels(row):
    found, expected = (psf.online(named(), psf.EKF(), PARAMS) for _ in range(2))
    assert found.update(row, step=1)[0] == expected.update([1.0, 2.0], step=1)[0]


def test_a_mask_marks_what_is_missing():
    found, expected = (psf.online(named(), psf.EKF(), PARAMS) for _ in range(2))
    row = np.ma.array([1.0, 2.0], mask=[False, True])
    assert found.update(row, step=1)[0] == expected.update([1.0, np.nan], step=1)[0]


def test_inputs_are_aligned_by_their_labels():
    rows = pd.DataFrame({"offset": [0.3, 0.1], "force": [1.0, -2.0]})
    found, expected = (psf.online(driven(), psf.EKF(), {"a": 0.7}) for _ in range(2))
    aligned = rows[["force", "offset"]].to_numpy()
    for given, tracker in ((rows, found), (aligned, expected)):
        tracker.update(0.4, step=1, inputs=given)
    one = rows.iloc[0], aligned[0]
    assert (
        found.update(0.1, step=2, inputs=one[0])[0]
        == expected.update(0.1, step=2, inputs=one[1])[0]
    )


@pytest.mark.parametrize(
    "copied", [copy.copy, copy.deepcopy, lambda t: pickle.loads(pickle.dumps(t))]
)
def test_a_copy_has_memory_of_its_own(copied):
    tracker, other = (psf.online(ONE_STATE, psf.EKF(), {"a": 0.9}) for _ in range(2))
    for each in (tracker, other):
        each.update(0.2, step=0)
    copied(tracker).update(3.0, step=4)
    assert tracker.update(0.4, step=1)[0] == other.update(0.4, step=1)[0]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"observed": 0.1, "step": 3}, "step must be later than the last one, 3, got 3"),
        ({"observed": 0.1, "step": 1}, "step must be later than the last one, 3, got 1"),
        ({"observed": 0.1, "time": 3.0}, "time must be later"),
        ({"observed": 0.1, "step": 4.5}, "step must be an integer from 0 on, got 4.5"),
        ({"observed": 0.1, "time": 4.5}, "the steps of a transition that is a function have one"),
        ({"observed": 0.1, "time": np.inf}, "time must be a finite number"),
        ({"observed": 0.1}, "exactly one of step and time"),
        ({"observed": np.inf, "step": 4}, "observed must be finite"),
        ({"observed": [0.1, 0.2], "step": 4}, "observed must have a number for each of"),
        ({"observed": 0.1, "step": 4, "inputs": [1.0]}, "inputs must be None"),
        ({"observed": 1e200, "step": 4}, "the row at step 4 has no likelihood"),
        ({"observed": "x", "step": 4}, "observed must be numbers"),
        ({"observed": 0.1, "step": 10**12}, "steps must be at most 1e.09"),
    ],
)
def test_a_wrong_row_leaves_the_filter_where_it_was(row, message):
    tracker, other = (psf.online(ONE_STATE, psf.EKF(), {"a": 0.9}) for _ in range(2))
    for each in (tracker, other):
        each.update(0.2, step=3)
    with pytest.raises(ModelError, match=message):
        tracker.update(**row)
    assert tracker.state.step == 3
    found, expected = (each.update(0.4, step=4) for each in (tracker, other))
    assert (found.log_likelihood, found.mean) == (expected.log_likelihood, expected.mean)


def test_a_state_of_something_else_is_refused():
    tracker = psf.online(ONE_STATE, psf.EKF(), {"a": 0.9})
    for system, filter, params, state, message in (
        (OSCILLATOR, psf.EKF(), PARAMS, tracker.state, "the same system"),
        (ONE_STATE, psf.UKF(), {"a": 0.9}, tracker.state, "the same system"),
        (ONE_STATE, psf.EKF(), {"a": 0.8}, tracker.state, "the same parameters"),
        (ONE_STATE, psf.EKF(), {"a": np.array([0.9, 0.4])}, tracker.state, "the same parameters"),
        (ONE_STATE, psf.EKF(), {"a": 0.9}, 3, "state must be that of an online filter"),
    ):
        with pytest.raises(ModelError, match=message):
            psf.online(system, filter, params, state=state)


@pytest.mark.parametrize("own", [{"t0": 0.0}, {"random_seed": 1}])
def test_a_state_has_its_own_start_and_noise(own):
    state = psf.online(ONE_STATE, psf.EKF(), {"a": 0.9}).state
    with pytest.raises(ModelError, match=f"{next(iter(own))} must be None with state"):
        psf.online(ONE_STATE, psf.EKF(), {"a": 0.9}, state=state, **own)


def test_a_state_of_exchanged_parameters_is_refused():
    line = psf.StateSpaceModel(
        transition=lambda x, q, a, b: [a * x[0] + b + q[0]], process_noise=[[0.5]],
        observation=lambda x: [x[0]], observation_noise=[[0.2]],
        initial_mean=[0.3], initial_cov=[[1.0]],
    )  # fmt: skip
    state = psf.online(line, psf.EKF(), {"a": 0.4, "b": 0.9}).state
    with pytest.raises(ModelError, match="the same parameters"):
        psf.online(line, psf.EKF(), {"a": 0.9, "b": 0.4}, state=state)
