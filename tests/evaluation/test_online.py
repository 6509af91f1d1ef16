"""Rows as they come have the bits of a run over all rows, and cost microseconds without PyMC."""

import pickle
import subprocess
import sys

import numpy as np
import pandas as pd
import pytensor.tensor as pt
import pytest
from scipy.special import logsumexp

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError

OSCILLATOR = psf.StateSpaceModel(
    psf.EulerMaruyama(lambda x, k: [x[1], -k * x[0] - 0.3 * x[1]], [[0.0], [0.5]], dt=0.1),
    observation=lambda x: [x[0], x[1] - x[0]],
    observation_noise=np.diag([0.1, 0.2]),
    initial_mean=[1.0, 0.0],
    initial_cov=np.diag([0.1, 0.2]),
)
PARAMS = {"k": 2.0}
STEPS = np.array([0, 1, 2, 5, 9, 10])
DATA = np.random.default_rng(1).normal(size=(6, 2))
DATA[2, 1] = np.nan
ONE_STATE = psf.StateSpaceModel(
    transition=lambda x, q, a: [a * pt.sin(x[0]) + q[0]],
    process_noise=[[0.5]],
    observation=lambda x: [x[0]],
    observation_noise=[[0.2]],
    initial_mean=[0.3],
    initial_cov=[[1.0]],
)


def test_a_row_tells_how_many_particles_are_behind_it():
    def effective(filter, params, datum):
        row = psf.online(ONE_STATE, filter, params, random_seed=1).update(datum, step=0)
        return row.n_particles

    assert effective(psf.EKF(), {"a": 0.9}, 0.3) == np.inf
    assert effective(psf.EKF(), {"a": np.array([0.9, 0.4])}, 0.3) == np.inf
    near, far = (effective(psf.BootstrapPF(50), {"a": 0.9}, datum) for datum in (0.3, 20.0))
    assert 10 < near < 50
    assert far < 1.01
    assert effective(psf.BootstrapPF(50), {"a": np.array([0.9, 0.4])}, 20.0) < 1.01


def run_of(system, filter, params, data, tracker, **record):
    seed = int(tracker.state.seeds[0])
    return psf.run_filter(system, filter, params, data, seed=seed, **record)


def assert_same(rows, run):
    np.testing.assert_array_equal([row.log_likelihood for row in rows], run["log_likelihood"])
    np.testing.assert_array_equal([row.mean for row in rows], run["mean"])
    # Of parameters that drift it is a sum over all rows at once, whose order rounds otherwise.
    np.testing.assert_allclose([row.cov for row in rows], run["cov"], rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize(
    "filter",
    [psf.EKF(), psf.UKF(), psf.EnKF(256), psf.BootstrapPF(256), psf.PFEnKF(256)],
    ids=repr,
)
def test_rows_are_those_of_a_run(filter):
    tracker = psf.online(OSCILLATOR, filter, PARAMS, random_seed=3)
    rows = [tracker.update(y, step=int(k)) for k, y in zip(STEPS, DATA, strict=True)]
    assert_same(rows, run_of(OSCILLATOR, filter, PARAMS, DATA, tracker, steps=STEPS))


@pytest.mark.parametrize("filter", [psf.GuidedPF(200), psf.GridFilter()], ids=repr)
def test_rows_are_those_of_a_run_that_goes_on_row_by_row(filter):
    """Of filters that look ahead, or whose state is rounded to what they need."""
    tracker, run = psf.online(ONE_STATE, filter, {"a": 0.9}, random_seed=3), None
    seed = int(tracker.state.seeds[0])
    for k, y in zip(STEPS, DATA[:, 0], strict=True):
        row, given = tracker.update(y, step=int(k)), {"steps": [k], "seed": seed, "state": run}
        run = psf.run_filter(ONE_STATE, filter, {"a": 0.9}, [y], **given)
        assert_same([row], run)


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(256)], ids=repr)
@pytest.mark.parametrize("a", [0.9, [0.9, 0.4]], ids=["point", "draws"])
def test_a_row_without_numbers_is_a_row(filter, a):
    """The law moves, the terms are those of a run, and weights stay."""
    params, data = {"a": np.array(a)}, [0.3, np.nan, 1.1]
    tracker = psf.online(ONE_STATE, filter, params, random_seed=3)
    rows = [tracker.update(y, step=2 * k) for k, y in enumerate(data)]
    assert rows[1].log_likelihood == pytest.approx(0.0, abs=1e-15)
    assert rows[1].n_effective == pytest.approx(rows[0].n_effective)
    if np.ndim(a) == 0:
        run = run_of(ONE_STATE, filter, params, data, tracker, steps=[0, 2, 4])
        assert_same(rows, run)


def test_times_may_be_dates():
    dates = pd.Timestamp("2024-02-28") + pd.to_timedelta(STEPS, unit="D")
    given = {"t0": pd.Timestamp("2024-02-28"), "unit": pd.Timedelta(days=10)}
    tracker, state = psf.online(OSCILLATOR, psf.EKF(), PARAMS, **given), None
    rows = []
    for date, y in zip(dates, DATA, strict=True):
        tracker = psf.online(OSCILLATOR, psf.EKF(), PARAMS, state=state) if state else tracker
        rows.append(tracker.update(y, time=date))
        state = pickle.loads(pickle.dumps(tracker.state))
    terms = psf.log_likelihood(OSCILLATOR, psf.EKF(), PARAMS, DATA, times=STEPS * 0.1)
    np.testing.assert_array_equal([row.log_likelihood for row in rows], terms)
    with pytest.raises(ModelError, match="time must be dates"):
        tracker.predict(time=9.0)
    with pytest.raises(ModelError, match=r"as t0 is, got Timestamp.*: give online t0 as a date"):
        psf.online(OSCILLATOR, psf.EKF(), PARAMS).predict(time=dates[0])
    with pytest.raises(ModelError, match="unit must be None where t0 and times are not dates"):
        psf.online(OSCILLATOR, psf.EKF(), PARAMS, unit="D")


@pytest.mark.parametrize("times", [STEPS * 0.1, np.array([0.0, 0.1, 0.234, 0.5, 0.9, 1.05])])
def test_times_on_the_grid_and_off_it(times):
    tracker = psf.online(OSCILLATOR, psf.EKF(), PARAMS)
    rows = [tracker.update(y, time=t) for t, y in zip(times, DATA, strict=True)]
    terms = psf.log_likelihood(OSCILLATOR, psf.EKF(), PARAMS, DATA, times=times)
    np.testing.assert_allclose([row.log_likelihood for row in rows], terms, rtol=1e-12)


@pytest.mark.parametrize("row", [[0.1, 0.2], [1e200, 0.0]], ids=["prediction", "failure"])
def test_what_is_not_kept_leaves_the_grid_to_later_rows(row):
    tracker, other = (psf.online(OSCILLATOR, psf.EKF(), PARAMS) for _ in range(2))
    for each in (tracker, other):
        each.update(DATA[0], step=1)
    tracker.predict(time=0.234)
    if row[0] > 1.0:
        with pytest.raises(ModelError, match="has no likelihood"):
            tracker.update(row, time=0.234)
    found, expected = (each.update(DATA[1], step=2) for each in (tracker, other))
    assert found.log_likelihood == expected.log_likelihood


def driven(**changes):
    settings = {
        "transition": psf.EulerMaruyama(lambda x, u, a: [u[0] - a * x[0]], [[0.4]], dt=0.5),
        "observation": lambda x, u: [x[0] + 0.1 * u[1]],
        "observation_noise": [[0.2]],
        "initial_mean": [0.0],
        "initial_cov": [[1.0]],
        "inputs": ["force", "offset"],
    }
    return psf.StateSpaceModel(**settings | changes)


def test_inputs_come_with_the_rows():
    system, data = driven(), DATA[:, 0]
    inputs = np.random.default_rng(2).normal(size=(11, 2))
    tracker, last, rows = psf.online(system, psf.EKF(), {"a": 0.7}), 0, []
    for k, y in zip(STEPS.tolist(), data, strict=True):
        rows.append(tracker.update(y, step=k, inputs=inputs[last : k + 1]))
        last = k
    assert_same(
        rows, run_of(system, psf.EKF(), {"a": 0.7}, data, tracker, steps=STEPS, inputs=inputs)
    )


def test_sums_start_anew_and_parameters_drift():
    sums = psf.StateSpaceModel(
        psf.EulerMaruyama(lambda x, a: [-a * x[0], x[0]], [[0.4], [0.0]], dt=0.5),
        observation=lambda x: [x[1]], observation_noise=[[0.1]],
        initial_mean=[1.0, 0.0], initial_cov=np.diag([0.2, 0.0]),
        states=["rate", "sum"], accumulators=["sum"],
    )  # fmt: skip
    drifts = psf.drifting(driven(), a=psf.RandomWalk(scale="log", every=2))
    inputs = np.random.default_rng(2).normal(size=(11, 2))
    cases = ((sums, {"a": 0.7}, None), (drifts, {"a": 0.7, "a_strength": 0.1}, inputs))
    for system, params, given in cases:
        tracker, last, rows = psf.online(system, psf.EKF(), params), 0, []
        for k, y in zip(STEPS[1:].tolist(), DATA[1:, 0], strict=True):
            own = None if given is None else given[last : k + 1]
            rows.append(tracker.update(y, step=k, inputs=own))
            last = k
        record = {"steps": STEPS[1:], "inputs": given}
        run = run_of(system, psf.EKF(), params, DATA[1:, 0], tracker, **record)
        assert_same(rows, run)


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(50)], ids=repr)
def test_draws_are_a_mixture_whose_weights_follow_the_rows(filter):
    draws = {"a": np.array([0.2, 0.9, 1.4])}
    tracker = psf.online(ONE_STATE, filter, draws, random_seed=4)
    seeds, data = tracker.state.seeds, DATA[:4, 0]
    rows = [tracker.update(y, step=k) for k, y in enumerate(data)]
    runs = [
        psf.run_filter(ONE_STATE, filter, {"a": a}, data, steps=range(4), seed=int(seed))
        for a, seed in zip(draws["a"], seeds, strict=True)
    ]
    totals = np.cumsum([run["log_likelihood"].values for run in runs], axis=1)
    mixed = logsumexp(totals, axis=0) - np.log(3)
    np.testing.assert_allclose(np.cumsum([row.log_likelihood for row in rows]), mixed, rtol=1e-12)
    w = np.exp(totals[:, -1] - logsumexp(totals[:, -1]))
    mean = np.array([run["mean"].values[-1, 0] for run in runs])
    cov = np.array([run["cov"].values[-1, 0, 0] for run in runs])
    np.testing.assert_allclose(rows[-1].mean, [w @ mean], rtol=1e-10)
    np.testing.assert_allclose(rows[-1].cov, [[w @ (cov + mean**2) - (w @ mean) ** 2]], rtol=1e-9)
    np.testing.assert_allclose(rows[-1].n_effective, 1 / np.sum(w**2), rtol=1e-10)


def test_the_covariance_of_a_mixture_has_both_halves():
    draws = np.array([1.0, 3.0])
    tracker = psf.online(OSCILLATOR, psf.EKF(), {"k": draws})
    row = [tracker.update(y, step=int(k)) for k, y in zip(STEPS, DATA, strict=True)][-1]
    runs = [psf.run_filter(OSCILLATOR, psf.EKF(), {"k": k}, DATA, steps=STEPS) for k in draws]
    totals = np.array([run["log_likelihood"].values.sum() for run in runs])
    w = np.exp(totals - logsumexp(totals))
    mean, cov = (np.array([run[name].values[-1] for run in runs]) for name in ("mean", "cov"))
    second = np.einsum("m,mij->ij", w, cov + mean[:, :, None] * mean[:, None])
    np.testing.assert_allclose(row.cov, second - np.outer(w @ mean, w @ mean), rtol=1e-9)


def test_draws_that_fail_are_left_out():
    """A rate at which the state overflows at once."""
    explosive = psf.StateSpaceModel(
        transition=lambda x, q, a: [pt.exp(a * x[0]) + q[0]], process_noise=[[0.1]],
        observation=lambda x: [x[0]], observation_noise=[[0.2]],
        initial_mean=[1.0], initial_cov=[[0.1]],
    )  # fmt: skip
    tracker = psf.online(explosive, psf.EKF(), {"a": np.array([0.1, 1e4])})
    alone = psf.online(explosive, psf.EKF(), {"a": 0.1})
    row, expected = (each.update(1.2, step=1) for each in (tracker, alone))
    np.testing.assert_allclose(row.log_likelihood, expected.log_likelihood - np.log(2))
    assert row.n_effective == 1.0
    np.testing.assert_allclose(tracker.update(1.1, step=2).mean, alone.update(1.1, step=2).mean)


def test_a_prediction_changes_nothing():
    """Against the moments of the linear system by hand."""
    tracker = psf.online(OSCILLATOR, psf.EKF(), PARAMS)
    row = tracker.update(DATA[0], step=1)
    ahead = tracker.predict(step=3)
    A = np.array([[1.0, 0.1], [-0.2, 0.97]])
    mean, cov, Q = row.mean, row.cov, np.diag([0.0, 0.025])
    for _ in range(2):
        mean, cov = A @ mean, A @ cov @ A.T + Q
    np.testing.assert_allclose(ahead.mean, mean, rtol=1e-12)
    np.testing.assert_allclose(ahead.cov, cov, rtol=1e-12)
    other = psf.online(OSCILLATOR, psf.EKF(), PARAMS)
    other.update(DATA[0], step=1)
    assert tracker.update(DATA[1], step=2)[0] == other.update(DATA[1], step=2)[0]


@pytest.mark.parametrize("resets", ["seen", "row"])
def test_an_advance_is_no_row(resets):
    """Inputs change between the rows, as by a switch; sums go on."""
    system = psf.StateSpaceModel(
        psf.EulerMaruyama(lambda x, u, a: [u[0] - a * x[0], x[0]], [[0.4], [0.0]], dt=0.5),
        observation=lambda x: [x[1]], observation_noise=[[0.1]], inputs=["force"],
        initial_mean=[1.0, 0.0], initial_cov=np.diag([0.2, 0.0]),
        states=["rate", "sum"], accumulators=["sum"], resets=resets,
    )  # fmt: skip
    tracker, force = psf.online(system, psf.EKF(), {"a": 0.7}), [0.0, 0.0, 2.0, 2.0, 2.0, -1.0]
    rows = [tracker.update(0.4, step=1, inputs=0.0)]
    tracker.advance(step=2, inputs=0.0)
    ahead = tracker.predict(step=5, inputs=2.0)
    assert (tracker.advance(step=5, inputs=2.0).mean == ahead.mean).all()
    rows.append(tracker.update(0.9, step=6, inputs=-1.0))
    record = {"steps": [1, 6], "inputs": np.array(force)}
    assert_same(rows, run_of(system, psf.EKF(), {"a": 0.7}, [0.4, 0.9], tracker, **record))


def test_a_system_without_parameters():
    level = psf.StateSpaceModel(
        transition=lambda x, q: [x[0] + q[0]], process_noise=[[1.0]],
        observation=lambda x: [x[0]], observation_noise=[[2.0]],
        initial_mean=[0.5], initial_cov=[[3.0]],
    )  # fmt: skip
    row = psf.online(level, psf.EKF(), {}).update(1.5, step=1)
    np.testing.assert_allclose(row.mean, [0.5 + 4.0 / 6.0])
    np.testing.assert_allclose(row.log_likelihood, -0.5 * (np.log(2 * np.pi * 6.0) + 1.0 / 6.0))


def test_draws_of_chains_are_draws():
    draws = np.array([[0.2, 0.9], [1.4, 0.5]])
    whole, flat = (psf.online(ONE_STATE, psf.EKF(), {"a": a}) for a in (draws, draws.ravel()))
    assert whole.update(0.3, step=1).log_likelihood == flat.update(0.3, step=1).log_likelihood


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(50)], ids=repr)
@pytest.mark.parametrize("params", [{"a": 0.9}, {"a": np.array([0.4, 0.9])}])
def test_a_state_goes_on_elsewhere(filter, params):
    tracker = psf.online(ONE_STATE, filter, params, random_seed=5)
    for k, y in enumerate(DATA[:3, 0]):
        tracker.update(y, step=k)
    state = pickle.loads(pickle.dumps(tracker.state))
    elsewhere = psf.online(ONE_STATE, filter, params, state=state)
    for k, y in ((4, 0.3), (5, -0.2)):
        here, there = (each.update(y, step=k) for each in (tracker, elsewhere))
        np.testing.assert_array_equal(np.hstack([here.log_likelihood, here.mean]),
                                      np.hstack([there.log_likelihood, there.mean]))  # fmt: skip


WITHOUT_PYMC = """
import sys
import pymc_statespace_filters as psf
system = psf.StateSpaceModel(
    psf.EulerMaruyama(lambda x, a: [-a * x[0]], [[0.4]], dt=0.5),
    observation=lambda x: [x[0]], observation_noise=[[0.1]],
    initial_mean=[1.0], initial_cov=[[0.2]],
)
psf.online(system, psf.EKF(), {"a": 0.7}).update(0.3, step=2)
print({"pymc", "arviz", "nutpie"} & set(sys.modules))
"""


def test_nothing_of_pymc_is_loaded():
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_PYMC], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "set()"
