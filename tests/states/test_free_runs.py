"""Free runs: against a simulation in numpy, on the record and on new segments, and their errors."""

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from numba.core.dispatcher import Dispatcher

import pymc_statespace_filters as psf
from pymc_statespace_filters.states import free_runs
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
    pair_model,
    posterior,
    pushed_model,
)
from tests.systems import FORCED_DATA, PAIR, PAIR_DATA, STEPS, forced

pytestmark = pytest.mark.usefixtures("interpreted")

RATE = 1e-3  # of right implementations fail each statistical test
LATER = np.array([1, 2, 5, 9])  # irregular, and beyond the record
LONG_FORCE = np.random.default_rng(3).normal(size=10)


def runs(*args, **kwargs):
    return psf.free_run(*args, random_seed=1, **kwargs)["free_run"].to_dataset()


def pushed_run(a, steps, force):
    """States (R,) and observations (R,) of PUSHED without noise."""
    x, path = 0.0, []
    for k in range(steps[-1] + 1):
        path.append(x)
        if k < steps[-1]:
            x = a * x + force[k] + 0.1 * (T0 + DT * k)
    path = np.array(path)[steps]
    return path, path + 2.0 * np.asarray(force)[steps] - 0.3 * (T0 + DT * steps)


def assert_runs_of_pushed(group, values, steps, force):
    for place in np.ndindex(values.shape):
        path, seen = pushed_run(values[place], steps, force)
        np.testing.assert_allclose(group["d_states"].values[place][:, 0], path, rtol=1e-10)
        np.testing.assert_allclose(group["d"].values[place][:, 0], seen, rtol=1e-10)


def test_without_noise_a_run_is_the_equations():
    """On the steps and inputs of the record; then on others, shorter and longer."""
    model = pushed_model()
    group = runs(posterior(a=A), model)
    assert_runs_of_pushed(group, A, STEPS, FORCE)
    assert group["d"].dims == ("chain", "draw", "d_time", "observable")
    assert group["d_states"].dims == ("chain", "draw", "d_time", "state")
    np.testing.assert_array_equal(group["d_time"], T0 + DT * STEPS)
    assert group.attrs == {"noise": 0}
    later = runs(posterior(a=A), model, steps=LATER, inputs=LONG_FORCE)
    assert set(later) == {"d", "d_states"}
    assert_runs_of_pushed(later, A, LATER, LONG_FORCE)
    by_times = runs(posterior(a=A), model, times=T0 + DT * LATER, inputs=LONG_FORCE)
    assert by_times.identical(later)
    short = runs(posterior(a=A), model, steps=[1], inputs=LONG_FORCE[4:6])
    assert_runs_of_pushed(short, A, np.array([1]), LONG_FORCE[4:6])


def test_inputs_that_depend_on_the_draw():
    with pm.Model() as model:
        gain = pm.Normal("gain")
        psf.StateSpace(
            "d", PUSHED, EKF, params={"a": 0.7}, steps=STEPS, observed=FORCED_DATA,
            inputs=gain * pt.as_tensor(FORCE), t0=T0,
        )  # fmt: skip
    group = runs(posterior(gain=A), model)
    for place in np.ndindex(SHAPE):
        _, seen = pushed_run(0.7, STEPS, A[place] * FORCE)
        np.testing.assert_allclose(group["d"].values[place][:, 0], seen, rtol=1e-10)


def twice_pushed_model(inputs):
    system = forced(
        transition=lambda x, q, u, a: [a * x[0] + u[0] + u[1] + q[0]], inputs=["force", "wind"]
    )
    with pm.Model() as model:
        pm.Normal("a")
        psf.StateSpace("d", system, EKF, steps=STEPS, observed=FORCED_DATA, inputs=inputs)
    return model


def test_other_inputs_and_lengths_compile_nothing(monkeypatch):
    """Inputs of another length and memory layout, in a new model: no machine code is made."""
    compiled, make = [], Dispatcher.compile

    def count(self, signature):  # once for every new signature, also of code found on disk
        compiled.append((self.py_func.__name__, signature))
        return make(self, signature)

    idata, rows = posterior(a=A), np.random.default_rng(4).normal(size=(12, 2))
    monkeypatch.setattr(Dispatcher, "compile", count)
    with pytensor.config.change_flags(mode="NUMBA"):
        for noise in (False, True):
            psf.free_run(idata, twice_pushed_model(rows[:6]), noise=noise, observed=FORCED_DATA)
        n_before = len(compiled)
        for noise in (False, True):
            model = twice_pushed_model(rows)
            psf.free_run(idata, model, noise=noise, steps=[2, 8], observed=[1.0, 2.0])
            psf.free_run(
                posterior(a=A[:1]), model, noise=noise, inputs=np.asfortranarray(rows),
                times=[1.0, 3.0], observed=np.ones(2),
            )  # fmt: skip
    assert compiled[n_before:] == []


def test_with_noise_a_run_has_the_law_of_the_model():
    """Jointly over times, states and observations, initial state and all; not that of the data."""
    a, steps = 0.6, np.array([0, 1, 3])
    group = runs(posterior(a=np.full((2, 2000), a)), pair_model(), steps=steps, noise=True)
    assert group.attrs == {"noise": 1}
    F, Q = np.array([[a, 0.2], [0.0, 0.8]]), np.diag([1.0, 0.5])
    mean, cov = np.array([0.0, 0.3]), np.diag([1.0, 2.0])
    powers = [np.linalg.matrix_power(F, k) for k in range(4)]
    covs = [cov]
    for _ in range(3):
        covs.append(F @ covs[-1] @ F.T + Q)
    between = np.block(
        [
            [
                covs[s] @ powers[r - s].T if r >= s else powers[s - r] @ covs[r]
                for r in steps
            ]
            for s in steps
        ]
    )  # fmt: skip
    seen = between + np.kron(np.eye(3), DATA_NOISE)
    means = np.concatenate([powers[k] @ mean for k in steps])
    drawn = [group[name].values.reshape(4000, 6) for name in ("d_states", "d")]
    law = np.tile(means, 2), np.block([[between, between], [between, seen]])
    assert_drawn_from(np.concatenate(drawn, axis=1), *law, RATE)


def test_threads_seeds_and_draws(monkeypatch):
    idata, model = posterior(a=np.full(SHAPE, 0.6)), pair_model()
    found = runs(idata, model, noise=True)
    monkeypatch.setattr(free_runs, "available_cores", lambda: 1)
    assert runs(idata, model, noise=True).identical(found)
    assert len(np.unique(found["d"].isel(d_time=0, observable=0))) == 6
    other = psf.free_run(idata, model, noise=True, random_seed=2, extend_inferencedata=False)
    assert list(other.children) == ["free_run"]
    assert (other["free_run"]["d"] != found["d"]).all()
    fewer = runs(posterior(a=A), model, n_draws=2)
    np.testing.assert_array_equal(fewer["d"], runs(posterior(a=A), model)["d"][:, :1])


def test_errors_of_the_predictions():
    """With a missing component and a missing row; each observable is judged alone."""
    values = np.random.default_rng(2).uniform(-0.5, 0.9, (2, 300))
    group = runs(posterior(a=values), pair_model(), observed=PAIR_DATA)
    d = group["d"].values
    known = np.isfinite(PAIR_DATA)
    for i in range(2):
        rows = known[:, i]
        record, predicted = PAIR_DATA[rows, i], d[:, :, rows, i]
        rmse = np.sqrt(np.mean((predicted.mean(axis=(0, 1)) - record) ** 2))
        assert group["d_rmse"].values[i] == pytest.approx(rmse, rel=1e-12)
        relative = rmse / record.std()
        assert group["d_relative_error"].values[i] == pytest.approx(relative, rel=1e-12)
        each = np.sqrt(np.mean((predicted - record) ** 2, axis=2))
        np.testing.assert_allclose(group["d_rmse_of_draws"].values[..., i], each, rtol=1e-12)
    assert group["d_rmse"].dims == group["d_relative_error"].dims == ("observable",)
    assert group["d_rmse_of_draws"].dims == ("chain", "draw", "observable")
    assert group["d_coverage"].dims == ("interval", "observable")
    assert group["interval"].values.tolist() == [0.5, 0.9]


def test_rows_that_are_not_scored_are_not_compared():
    model = pair_model(score_from=2)
    rest = np.where(np.arange(len(STEPS))[:, None] < 2, np.nan, PAIR_DATA)
    expected = runs(posterior(a=A), model, observed=rest)
    np.testing.assert_array_equal(runs(posterior(a=A), model)["d_rmse"], expected["d_rmse"])


@pytest.mark.parametrize("noise", [False, True])
def test_coverage_is_that_of_measurements(noise):
    """Intervals cover as many of 400 data as they say, if these have the law of the predictions.

    Without noise that is the one path of the known parameter, seen by the sensor alone.
    """
    steps, params = np.arange(400), {"a": 0.1}
    path = psf.simulate(PAIR, params, steps=steps, noise=noise, random_seed=5)
    record = path["observations"].values
    if not noise:
        rng = np.random.default_rng(6)
        record = record + rng.multivariate_normal(np.zeros(2), DATA_NOISE, size=400)
    idata = posterior(a=np.full((2, 1000), 0.1))
    group = runs(idata, pair_model(), steps=steps, observed=record, noise=noise)
    for prob, found in zip((0.5, 0.9), group["d_coverage"].values, strict=True):
        # 4 standard errors of data whose autocorrelation leaves at least a third of their number.
        assert (abs(found - prob) < 4 * np.sqrt(3 * prob * (1 - prob) / 400)).all()


def test_counts():
    """Means of counts, compared with intervals of whole counts."""
    model = counted_model(initial_mean=1.0)
    idata = posterior(level=np.full((2, 500), 0.5))
    expected = np.exp(0.5 + 0.8 ** np.arange(3))
    group = runs(idata, model, steps=[0, 1, 2], observed=[3.0, np.nan, 20.0])
    np.testing.assert_allclose(group["d"][0, 0, :, 0], expected, rtol=1e-10)
    # 3 is near the mean of the first, 4.48; 20 is far above that of the last, 3.13.
    np.testing.assert_array_equal(group["d_coverage"][:, 0], [0.5, 0.5])
    noisy = runs(idata, model, noise=True)
    assert (noisy["d"] % 1 == 0).all()


def test_a_run_that_diverges():
    values = np.full(SHAPE, 0.5)
    values[1, 2] = 1e200
    with pytest.warns(
        psf.errors.FilterWarning, match="leaves the finite numbers at 1 of 6 draws"
    ) as w:
        group = psf.free_run(posterior(a=values), pair_model(), observed=PAIR_DATA)["free_run"]
    assert [one.filename for one in w] == [__file__]
    failed = np.zeros(SHAPE, dtype=bool)
    failed[1, 2] = True
    for name in ("d", "d_states"):
        np.testing.assert_array_equal(group[name].isnull().all(["d_time"])[..., 0], failed)
        np.testing.assert_array_equal(group[name].isnull().any(["d_time"])[..., 0], failed)
    clean = runs(posterior(a=values[:1]), pair_model(), observed=PAIR_DATA)
    np.testing.assert_allclose(group["d_rmse"], clean["d_rmse"], rtol=1e-12)
    np.testing.assert_array_equal(group["d_rmse_of_draws"].isnull()[..., 0], failed)
    with pytest.warns(psf.errors.FilterWarning, match="at 6 of 6 draws"):
        group = runs(posterior(a=np.full(SHAPE, 1e200)), pair_model(), observed=PAIR_DATA)
    assert group["d_coverage"].isnull().all()


def two_variables():
    with pm.Model() as model:
        pm.Normal("a")
        psf.StateSpace("d", PAIR, EKF, steps=STEPS, observed=PAIR_DATA)
        psf.StateSpace(
            "push", PUSHED, EKF, steps=STEPS, observed=FORCED_DATA, inputs=FORCE, t0=T0,
            dims=("push_time", "pushed"),
        )  # fmt: skip
    return model


def test_several_variables():
    model = two_variables()
    group = runs(posterior(a=A), model)
    errors = ("rmse", "relative_error", "rmse_of_draws", "coverage")
    names = ("d", "push")  # each compared with its own record
    assert set(group) == {*names, *(f"{n}_{of}" for n in names for of in ("states", *errors))}
    np.testing.assert_array_equal(
        group["d_rmse"], runs(posterior(a=A), model, var_name="d", observed=PAIR_DATA)["d_rmse"]
    )
    assert set(runs(posterior(a=A), model, var_name="d", steps=STEPS)) == {"d", "d_states"}
    assert group["push"].dims == ("chain", "draw", "push_time", "pushed")
    one = runs(posterior(a=A), model, var_name="push", observed=FORCED_DATA)
    np.testing.assert_array_equal(one["push"], group["push"])
    assert "d" not in one
    with pytest.raises(psf.errors.ModelError, match=r"give var_name, one of \['d', 'push'\]"):
        psf.free_run(posterior(a=A), model, observed=FORCED_DATA)


WRONG = [
    (dict(steps=[1], times=[T0]), "give at most one of steps and times, got both"),
    (dict(steps=[8]), "the model's inputs end after 7 rows, and step 8 needs 9: give inputs="),
    (dict(steps=[8], inputs=FORCE), "inputs must have at least 9 rows"),
    (dict(observed=[1.0]), r"observed must have shape \(4, 1\)"),
    (dict(noise=0.1), "noise must be True or False, got 0.1"),
    (dict(times=[13.6]), "off the grid"),
    (dict(var_name="e"), r"var_name must be one of \['d'\], got 'e'"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG)
def test_what_cannot_be_run(arguments, message):
    with pytest.raises(psf.errors.ModelError, match=message):
        psf.free_run(posterior(a=A), pushed_model(), **arguments)
