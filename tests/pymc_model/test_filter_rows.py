"""Rows of a record at many points side by side, from states, against one point at a time."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.states import FilterRun
from pymc_statespace_filters.parallel import threads
from pymc_statespace_filters.parallel.threads import Pace
from pymc_statespace_filters.pymc_model.filter_rows import FilterRows, Record

SYSTEM = psf.StateSpaceModel(
    transition=lambda x, q, u, a: [a * x[0] + q[0] + u[0], 0.5 * x[1] + x[0]],
    process_noise=lambda a: [[1.0 + 0.1 * a]],
    observation=lambda x: [x[0], x[1]],
    observation_noise=[[0.5, 0.0], [0.0, 0.3]],
    initial_mean=[0.0, 0.0],
    initial_cov=[[1.0, 0.0], [0.0, 0.0]],
    inputs=["force"],
)
EXACT_PATH = psf.StateSpaceModel(
    transition=lambda x, u, a: [a * x[0] + u[0]],
    observation=lambda x: [x[0], 2 * x[0]],
    observation_noise=[[0.5, 0.0], [0.0, 0.3]],
    initial_mean=[0.2],
    initial_cov=[[0.0]],
    inputs=["force"],
)
RNG = np.random.default_rng(1)
STEPS = np.array([0, 2, 3, 7, 8, 12, 15])
DATA, FORCE = RNG.normal(size=(7, 2)), RNG.normal(size=(20, 1))
DATA[3, 0], DATA[4] = np.nan, np.nan
RECORD = Record(STEPS, DATA, FORCE, np.asarray(0.0))
# No multiple of the number of lanes; one has no variance of the noise, one overflows.
THETA = np.append(RNG.normal(size=17), [-20.0, 1e200])[:, np.newaxis]
NO_SEEDS = np.zeros(len(THETA), np.int64)
NOTHING = np.empty((len(THETA), 0))


def one_by_one(system, filter):
    """Terms and states of a run at each point alone."""
    evaluate = evaluator(FilterRun(system, filter))
    none = np.empty(0)
    found = [evaluate(theta, *RECORD, np.int64(0), none.astype(int), none) for theta in THETA]
    return np.stack([one[0] for one in found]), np.stack([one[-1] for one in found])


@pytest.mark.parametrize(
    ("system", "filter"),
    [(SYSTEM, psf.EKF()), (SYSTEM, psf.IPLF()), (EXACT_PATH, psf.EKF())],
    ids=["EKF", "IPLF", "path"],
)
def test_points_side_by_side_are_points_alone_wherever_the_record_is_cut(system, filter):
    """To rounding, and to the bit for every cut and every order of the points."""
    rows, (terms, after) = FilterRows(system, filter), one_by_one(system, filter)
    whole, end = rows(THETA, NO_SEEDS, NOTHING, RECORD)
    np.testing.assert_allclose(whole, terms, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(end, after, rtol=1e-12, atol=1e-12)
    for cut in (1, 4, 7):
        first, states = rows(THETA, NO_SEEDS, NOTHING, RECORD.rows(0, cut))
        np.testing.assert_array_equal(first, whole[:, :cut])
        known = np.flatnonzero(np.isfinite(states).all(axis=1))[::-1]
        assert set(known) >= set(range(17))
        second, left = rows(THETA[known], NO_SEEDS[known], states[known], RECORD.rows(cut, 7))
        np.testing.assert_array_equal(second, whole[known, cut:])
        np.testing.assert_array_equal(left, states[known] if cut == 7 else end[known])


def test_pieces_in_threads_are_one_call(monkeypatch):
    rows = FilterRows(SYSTEM, psf.EKF())
    whole = rows(THETA, NO_SEEDS, NOTHING, RECORD)
    monkeypatch.setattr(threads, "_SHORT", 0.0)
    monkeypatch.setattr(threads, "available_cores", lambda: 3)
    for found, expected in zip(rows(THETA, NO_SEEDS, NOTHING, RECORD), whole, strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("change", ["another step", "another length"])
def test_states_that_the_filter_has_not_left_are_refused(change):
    rows = FilterRows(SYSTEM, psf.EKF())
    _, states = rows(THETA, NO_SEEDS, NOTHING, RECORD.rows(0, 2))
    if change == "another step":
        states[3, 0] += 1
    else:
        states = states[:, :-1].copy()
    with pytest.raises(ModelError, match="state of the filter"):
        rows(THETA[:17], NO_SEEDS[:17], states[:17], RECORD.rows(2, 7))


def test_points_that_fail_at_once_do_not_make_work_short():
    pace = Pace()
    pace.measured(10, 1.0)
    pace.measured(10, 1e-6)
    assert not pace.is_short(10)
    for _ in range(10):
        pace.measured(10, 1e-6)
    assert pace.is_short(10)
