"""Events, jumps of the state at known times, against closed forms and composed maps."""

import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.pymc_model.step_refinement import step_stability
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.input_columns import divided
from pymc_statespace_filters.system.record import read_record

pytestmark = pytest.mark.usefixtures("interpreted")

DECAY, VOLUME, SHARE, SD = 0.7, 2.0, 0.9, 0.1
DOSES = {"time": [1.0, 1.77, 2.5], "dose": [10.0, 5.0, 3.0]}
TIMES = np.array([0.5, 1.0, 2.05, 3.0])
PARAMS = {"k": DECAY, "V": VOLUME, "sd": SD, "F": SHARE, "sigma": 0.3}
DATA = np.array([[0.3], [0.4], [4.0], [2.6]])


def one_compartment(integrator=None, **others):
    settings = {
        "initial_mean": [1.0],
        "initial_cov": [[0.2]],
        "event": lambda x, dose, F: [x[0] + F * dose],
        "events": ["dose"],
    }
    return psf.StateSpaceModel(
        integrator or psf.ExactLinear(lambda k: [[-k]], lambda sigma: [[sigma]], dt=0.1),
        lambda x, V: [x[0] / V],
        observation_noise=lambda sd: [[sd**2]],
        **settings | others,
    )


COMPARTMENT = one_compartment()
# The amounts in two compartments, of which a dose fills one and a rinse empties the other.
TWO = psf.StateSpaceModel(
    psf.EulerMaruyama(
        lambda x, u, k: [-k * x[0] + u[0], k * x[0] - x[1] ** 2 / 4], lambda s: [[s], [s]], dt=0.1
    ),
    lambda x: [x[1]],
    observation_noise=[[0.04]],
    initial_mean=[1.0, 0.5],
    initial_cov=[[0.1, 0.0], [0.0, 0.1]],
    event=lambda x, dose, rinse, share: [x[0] + dose, (1 - share * rinse) * x[1]],
    events=["dose", "rinse"],
    inputs=["flow"],
)


def amounts(times, doses=DOSES, before=()):
    """The expected amount at each time, of a dose at the same time only where it is before."""
    found = np.exp(-DECAY * times)
    for time, dose in zip(doses["time"], doses["dose"], strict=True):
        age = times - time
        acts = age >= 0 if time in before else age > 0
        found += np.where(acts, SHARE * dose * np.exp(-DECAY * np.maximum(age, 0)), 0.0)
    return found


def log_density(before=()):
    """The log-density of the data: jointly normal, as the states are."""
    mean = amounts(TIMES, before=before) / VOLUME
    first, second = np.minimum.outer(TIMES, TIMES), np.abs(np.subtract.outer(TIMES, TIMES))
    stationary = PARAMS["sigma"] ** 2 / (2 * DECAY)
    at_first = 0.2 * np.exp(-2 * DECAY * first) + stationary * (1 - np.exp(-2 * DECAY * first))
    cov = at_first * np.exp(-DECAY * second) / VOLUME**2 + SD**2 * np.eye(len(TIMES))
    residual = DATA[:, 0] - mean
    _, log_det = np.linalg.slogdet(2 * np.pi * cov)
    return -0.5 * (log_det + residual @ np.linalg.solve(cov, residual))


@pytest.mark.parametrize("before", [(), (1.0,)])
def test_a_likelihood_with_events_is_the_joint_density_of_the_record(before):
    events = DOSES | {"before": [float(t in before) for t in DOSES["time"]]}
    found = psf.log_likelihood(COMPARTMENT, psf.EKF(), PARAMS, DATA, times=TIMES, events=events)
    assert found.sum() == pytest.approx(log_density(before), abs=1e-10)


def test_a_grid_agrees_where_events_come_after_observations_and_refuses_others():
    call = {"times": TIMES, "params": PARAMS, "observed": DATA}
    found = psf.log_likelihood(COMPARTMENT, psf.GridFilter(), events=DOSES, **call)
    assert found.sum() == pytest.approx(log_density(), abs=1e-7)
    assert psf.GridFilter().is_exact_for(compile_system(COMPARTMENT))  # an event is no kink
    events = pd.DataFrame(DOSES | {"before": [1, 0, 0]})
    with pytest.raises(psf.errors.ModelError, match="between an event and an observation"):
        psf.log_likelihood(COMPARTMENT, psf.GridFilter(), events=events, **call)


@pytest.mark.parametrize("filter", [psf.BootstrapPF(300), psf.GuidedPF(40)])
def test_particles_are_unbiased_across_events(filter):
    seeds = np.arange(400)
    events = DOSES | {"time": [1.0, 1.77, 2.05], "before": [1, 0, 1]}
    data = psf.simulate(COMPARTMENT, PARAMS, times=TIMES, events=events, random_seed=2)
    call = {"params": PARAMS, "times": TIMES, "events": events}
    call["observed"] = data["observations"].values
    exact = psf.log_likelihood(COMPARTMENT, psf.EKF(), **call).sum()
    ratios = np.exp(psf.log_likelihood(COMPARTMENT, filter, seed=seeds, **call).sum(axis=1) - exact)
    # One in 16 000 by chance; the guide is exact here, but for rounding.
    assert abs(ratios.mean() - 1) < 4 * ratios.std(ddof=1) / 20 + 1e-12


def test_a_map_composes_an_event_with_its_next_step():
    system = psf.StateSpaceModel(
        lambda x, q, u, a: [a * x[0] + u[0] + q[0]],
        lambda x: [x[0]],
        process_noise=[[0.01]],
        observation_noise=[[0.04]],
        initial_mean=[1.0],
        initial_cov=[[0.0]],
        event=lambda x, u, t, share: [(1 - share) * x[0] * u[0] + t],
        events=["share"],
        inputs=["u"],
    )
    inputs, events = (
        np.array([1.0, 2.0, 3.0, 4.0, 5.0]),
        {"time": [0, 2, 4], "share": [0.5, 0.2, 1]},
    )
    found = psf.simulate(
        system, {"a": 0.9}, steps=[0, 2, 4], inputs=inputs, events=events, noise=False
    )
    x = [1.0]
    for k in range(4):
        now = x[-1]
        if k in (0, 2):
            now = (1 - {0: 0.5, 2: 0.2}[k]) * now * inputs[k] + k
        x.append(0.9 * now + inputs[k])
    np.testing.assert_allclose(found["states"].values[:, 0], x, rtol=1e-15)
    np.testing.assert_allclose(found["observations"].values[:, 0], np.array(x)[[0, 2, 4]])
    with pytest.raises(psf.errors.ModelError, match=r"the event at 1\.5 is off the grid"):
        psf.simulate(system, {"a": 0.9}, steps=[2], inputs=inputs,
                     events={"time": [1.5], "share": [1]})  # fmt: skip
    with pytest.raises(psf.errors.ModelError, match="steps must be at most 1e"):
        psf.simulate(system, {"a": 0.9}, steps=[2], inputs=inputs,
                     events={"time": [1e19], "share": [1]})  # fmt: skip
    with pytest.raises(psf.errors.ModelError, match="must not come before the observation"):
        psf.simulate(system, {"a": 0.9}, steps=[2], inputs=inputs,
                     events={"time": [2], "share": [1], "before": [1]})  # fmt: skip


def test_a_sum_starts_anew_before_an_event_at_its_observation():
    system = psf.StateSpaceModel(
        psf.EulerMaruyama(lambda x: [1.0, x[0]], [[0.0], [0.0]], dt=1.0),
        lambda x: [x[1]],
        observation_noise=[[0.04]],
        initial_mean=[0.0, 0.0],
        initial_cov=np.zeros((2, 2)),
        states=["x", "sum"],
        accumulators=["sum"],
        event=lambda x, add: [x[0], x[1] + add],
        events=["add"],
    )
    found = psf.simulate(
        system, {}, steps=[2, 4], events={"time": [2.0, 3.0], "add": [10.0, 5.0]}, noise=False
    )
    np.testing.assert_allclose(found["observations"].values[:, 0], [0 + 1, 10 + 2 + 5 + 3])


def record_of_two(**others):
    rng = np.random.default_rng(3)
    times = np.array([0.4, 0.9, 1.3, 2.0, 2.6])
    given = {
        "times": times,
        "inputs": np.array([0.5, 1.0, 0.2]),
        "input_times": np.array([0.0, 1.1, 1.9]),
        "events": {"time": [0.9, 1.55], "dose": [1.0, 0.5], "rinse": [0.3, 1.0], "before": [1, 0]},
        "observed": np.abs(rng.normal(0.7, 0.2, (5, 1))),
    }
    return given | others


def test_gradients_through_events_are_differences():
    names = {"k": 0.8, "s": 0.2, "share": 0.4}
    with pm.Model() as model:
        for name, value in names.items():
            pm.Normal(name, value, 1.0)
        psf.StateSpace("y", TWO, psf.EKF(), **record_of_two())
    log_density, gradient = model.compile_logp(), model.compile_dlogp()
    found = gradient({name: np.asarray(value) for name, value in names.items()})
    for i, name in enumerate(names):
        values = [
            log_density({**{n: np.asarray(v) for n, v in names.items()}, name: np.asarray(at)})
            for at in (names[name] - 1e-5, names[name] + 1e-5)
        ]
        assert found[i] == pytest.approx((values[1] - values[0]) / 2e-5, rel=1e-6, abs=1e-6)


def test_a_drift_that_returns_has_a_gradient_over_a_step_of_length_zero():
    """The spread of no time is zero at any rate."""
    system = psf.drifting(COMPARTMENT, F=psf.OrnsteinUhlenbeck())
    params = PARAMS | {"F_strength": 0.3}
    events = DOSES | {"before": [1, 0, 0]}
    with pm.Model() as model:
        pm.Flat("F_rate")
        psf.StateSpace("y", system, psf.EKF(), params=params, times=TIMES, observed=DATA,
                       events=events)  # fmt: skip
    log_density, slope = model.compile_logp(), model.compile_dlogp()({"F_rate": np.array(0.8)})
    sides = [log_density({"F_rate": np.array(at)}) for at in (0.8 - 1e-5, 0.8 + 1e-5)]
    np.testing.assert_allclose(slope, (sides[1] - sides[0]) / 2e-5, rtol=1e-6)


def test_a_panel_with_events_of_each_record_is_the_sum_of_its_records():
    one = record_of_two()
    other = record_of_two(events={"time": [], "dose": [], "rinse": []})
    params = {"k": 0.8, "s": 0.2, "share": 0.4}
    alone = [psf.log_likelihood(TWO, psf.EKF(), params, **own) for own in (one, other)]
    both = one | {
        "times": np.tile(one["times"], 2),
        "panel": np.repeat(["a", "b"], 5),
        "observed": np.tile(one["observed"], (2, 1)),
        "events": {"b": other["events"], "a": pd.DataFrame(one["events"])},
    }
    found = psf.log_likelihood(TWO, psf.EKF(), params, **both)
    np.testing.assert_allclose(found, np.concatenate(alone), rtol=1e-13)
    shared = psf.log_likelihood(TWO, psf.EKF(), params, **both | {"events": one["events"]})
    np.testing.assert_allclose(shared, np.tile(alone[0], 2), rtol=1e-13)
    in_order = both | {"events": [pd.DataFrame(one["events"]).set_index("time"), {}]}
    found = psf.log_likelihood(TWO, psf.EKF(), params, **in_order)
    np.testing.assert_allclose(found, np.concatenate(alone), rtol=1e-13)
    wrong = both | {"events": [one["events"], {"time": [1.0]}]}
    with pytest.raises(psf.errors.ModelError, match=r"record 'b'.*must have the columns"):
        psf.log_likelihood(TWO, psf.EKF(), params, **wrong)


def test_tables_in_long_format_are_a_panel_with_events():
    frame = pd.DataFrame({"who": ["b"] * 4 + ["a"] * 4, "at": [*TIMES] * 2, "y": [*DATA[:, 0]] * 2})
    doses = pd.DataFrame({"who": "b", "at": DOSES["time"], "dose": DOSES["dose"]}).iloc[::-1]
    columns = {"record": "who", "time": "at", "values": "y"}
    panel = psf.panel_from(frame, events=doses, **columns)
    found = psf.log_likelihood(COMPARTMENT, psf.EKF(), PARAMS, **panel)
    alone = [
        psf.log_likelihood(COMPARTMENT, psf.EKF(), PARAMS, DATA, times=TIMES, events=events)
        for events in (DOSES, {})
    ]
    np.testing.assert_allclose(found, np.concatenate(alone), rtol=1e-13)
    with pytest.raises(psf.errors.ModelError, match="got 'c' in row 2"):
        psf.panel_from(frame, events=doses.assign(who=["c", "b", "b"]), **columns)
    with pytest.raises(psf.errors.ModelError, match=r"with the columns \['who', 'at'\]"):
        psf.panel_from(frame, events=DOSES, **columns)


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(64)])
@pytest.mark.parametrize("n_first", [1, 2, 3])
def test_a_run_goes_on_across_events(filter, n_first):
    given, params = record_of_two(), {"k": 0.8, "s": 0.2, "share": 0.4}
    whole = psf.run_filter(TWO, filter, params, seed=5, **given)
    times, observed = given.pop("times"), given.pop("observed")
    first = psf.run_filter(
        TWO, filter, params, seed=5, times=times[:n_first], observed=observed[:n_first], **given
    )
    second = psf.run_filter(
        TWO, filter, params, seed=5, times=times[n_first:], observed=observed[n_first:],
        state=first, **given,
    )  # fmt: skip
    terms = np.concatenate([first["log_likelihood"], second["log_likelihood"]])
    np.testing.assert_array_equal(terms, whole["log_likelihood"])


def test_a_sequential_run_goes_on_with_the_later_events_of_its_model():
    events = {"time": [1.0, 1.77, 2.05], "dose": [10.0, 5.0, 0.1], "before": [0, 0, 1]}

    def run(n_rows):
        with pm.Model() as model:
            pm.LogNormal("k", np.log(DECAY), 0.05)
            params = {name: value for name, value in PARAMS.items() if name != "k"}
            psf.StateSpace("y", COMPARTMENT, psf.EKF(), params=params, times=TIMES[:n_rows],
                           observed=DATA[:n_rows], events=events)  # fmt: skip
            return psf.sample_smc(30, data="sequential", random_seed=1, progressbar=False), model

    whole, (part, model) = run(4)[0], run(2)
    longer = psf.extend(part, model, observed=DATA[2:], times=TIMES[2:], progressbar=False)
    np.testing.assert_array_equal(longer["smc"]["score"], whole["smc"]["score"])


def test_an_event_is_of_one_part_of_a_divided_step_and_no_growth_of_a_step():
    system = one_compartment(
        psf.EulerMaruyama(lambda x, k: [-k * x[0]], lambda sigma: [[sigma]], dt=0.1),
        event=lambda x, factor: [factor * x[0]], events=["factor"],
    )  # fmt: skip
    given = {"steps": [10, 20], "observed": [0.5, 0.4], "events": {"time": [1.0], "factor": [-9.0]}}
    rows = read_record(system, GivenRecord(**given)).inputs
    np.testing.assert_array_equal(divided(system, rows, 3)[:, 0].nonzero()[0], [30])
    with pm.Model() as model:
        pm.Normal("k", 0.8)
        psf.StateSpace("y", system, psf.EKF(), params={"sigma": 0.1, "V": 1.0, "sd": 0.1}, **given)
    assert step_stability(model)(np.array([[0.8], [21.0]])).tolist() == [True, False]


@pytest.fixture(scope="module")
def fitted():
    """A model of the compartment, and two chains of two draws at known parameters."""
    with pm.Model() as model:
        k = pm.Normal("k", DECAY, 1.0)
        events = {name: [*values, value] for (name, values), value in
                  zip(DOSES.items(), (3.4, 20.0), strict=True)}  # fmt: skip
        psf.StateSpace(
            "y", COMPARTMENT, psf.EKF(), params={**PARAMS, "k": k, "sigma": 1e-6, "sd": 1e-6},
            times=TIMES, observed=amounts(TIMES)[:, None] / VOLUME, events=events,
        )  # fmt: skip
        idata = pm.sample_prior_predictive(4, random_seed=1)
    posterior = idata["prior"].to_dataset()[["k"]] * 0 + DECAY
    idata["posterior"] = posterior
    del idata["prior"], idata["prior_predictive"]
    return model, idata


@pytest.mark.parametrize("times", [[3.2, 3.5, 4.0], [3.25, 3.4, 4.0]])
def test_a_forecast_has_the_later_events_of_the_model_or_others(fitted, times):
    model, idata = fitted
    later = {name: [*values, value] for (name, values), value in
             zip(DOSES.items(), (3.4, 20.0), strict=True)}  # fmt: skip
    call = {"times": times, "random_seed": 1, "progressbar": False, "extend_inferencedata": False}
    found = psf.forecast(idata, model, **call)["predictions"]["y"]
    expected = amounts(np.array(times), later) / VOLUME
    np.testing.assert_allclose(found[0, :, :, 0], np.tile(expected, (4, 1)), rtol=1e-3)
    others = {"time": [2.9, 3.3], "dose": [7.0, 8.0]}  # the first is of the past: not looked at
    found = psf.forecast(idata, model, events=others, **call)["predictions"]["y"]
    later = {name: [*values, value] for (name, values), value in
             zip(DOSES.items(), (3.3, 8.0), strict=True)}  # fmt: skip
    expected = amounts(np.array(times), later) / VOLUME
    np.testing.assert_allclose(found[0, :, :, 0], np.tile(expected, (4, 1)), rtol=1e-3)


@pytest.mark.parametrize("times", [[3.2, 3.5], [3.25, 3.4]])
def test_a_forecast_has_an_event_at_the_last_observation(fitted, times):
    model, idata = fitted
    others = {"time": [1.0, 3.0, 3.3], "dose": [7.0, 6.0, 8.0]}
    call = {"random_seed": 1, "progressbar": False, "extend_inferencedata": False}
    found = psf.forecast(idata, model, times=times, events=others, **call)["predictions"]["y"]
    later = {name: [*values, *others[name][1:]] for name, values in DOSES.items()}
    expected = amounts(np.array(times), later) / VOLUME
    np.testing.assert_allclose(found[0, :, :, 0], np.tile(expected, (4, 1)), rtol=1e-3)


def test_a_free_run_has_the_events_of_the_model_or_others(fitted):
    model, idata = fitted
    call = {"random_seed": 1, "progressbar": False, "extend_inferencedata": False}
    found = psf.free_run(idata, model, **call)["free_run"]
    np.testing.assert_allclose(found["y"][0, 0, :, 0], amounts(TIMES) / VOLUME, rtol=1e-10)
    times, others = np.array([0.5, 1.3]), {"time": [0.0, 0.5], "dose": [4.0, 8.0]}
    found = psf.free_run(idata, model, times=times, events=others, **call)["free_run"]
    expected = amounts(times, others) / VOLUME
    np.testing.assert_allclose(found["y"][0, 0, :, 0], expected, rtol=1e-10)


def test_predictive_draws_and_states_have_the_events(fitted):
    model, idata = fitted
    with model:
        drawn = pm.sample_posterior_predictive(idata, random_seed=1, progressbar=False)
    assert drawn["posterior_predictive"]["y"][0, :, 2, 0].mean() == pytest.approx(
        amounts(TIMES)[2] / VOLUME, rel=0.2
    )
    states = psf.filtered_states(idata, model, progressbar=False, random_seed=1)
    found = states["filtered_states"]["y_mean"][0, 0, :, 0]
    np.testing.assert_allclose(found, amounts(TIMES), rtol=1e-6)  # at 1.0 before the dose there


def test_smoothed_particles_pass_an_event_before_an_observation():
    """Each path jumps by the dose alone, and the paths have the mean of an exact smoother."""
    given = {"times": TIMES, "events": DOSES | {"before": [1, 0, 0]}}
    given["observed"] = amounts(TIMES, before=(1.0,))[:, None] / VOLUME
    with pm.Model() as model:
        k = pm.Normal("k")
        psf.StateSpace("y", COMPARTMENT, psf.EKF(), params=PARAMS | {"k": k}, **given)
    idata = xr.DataTree.from_dict(
        {"posterior": xr.Dataset({"k": (("chain", "draw"), [[DECAY] * 50])})}
    )
    call = {"at": "steps", "random_seed": 1, "progressbar": False, "extend_inferencedata": False}
    found = psf.smoothed_states(idata, model, filter=psf.BootstrapPF(2000), **call)
    exact = psf.smoothed_states(idata, model, **call)["smoothed_states"]["y_mean"]
    found = found["smoothed_states"]
    paths, at_one = found["y_states"][0, :, :, 0].values, np.flatnonzero(found["y_time"] == 1.0)
    jumps = paths[:, at_one[1]] - paths[:, at_one[0]]
    np.testing.assert_allclose(jumps, SHARE * DOSES["dose"][0], rtol=1e-12)
    np.testing.assert_allclose(found["y_mean"].mean("draw"), exact.mean("draw"), atol=0.01)


BAD = {
    "no table": (None, "must be a table with the columns"),
    "a list": ([1.0, 2.0], "must be a table with the columns"),
    "no times": ({"dose": [1.0]}, "none of the name 'time'"),
    "no doses": ({"time": [1.0]}, "none of the name 'dose'"),
    "another column": (DOSES | {"rate": [1, 2, 3]}, "also 'rate'"),
    "one too few": ({"time": [1.0, 2.0, 3.0], "dose": [1.0, 2.0]}, "each of the 3 times"),
    "no number": (DOSES | {"dose": [1.0, np.nan, 3.0]}, "dose.*finite"),
    "texts": (DOSES | {"time": ["1", "2", "3"]}, "got text"),
    "dates": (DOSES | {"time": pd.date_range("2020", periods=3)}, "must be numbers"),
    "out of order": (DOSES | {"time": [1.0, 3.0, 2.0]}, "3.0 followed by 2.0 in row 2"),
    "twice": (DOSES | {"time": [1.0, 2.0, 2.0]}, "merge those of one time"),
    "nearly twice": (DOSES | {"time": [0.3, 0.1 * 3, 3.0]}, "a millionth of a step apart"),
    "about nothing": (DOSES | {"time": [1.0, 1.77, 1.77], "before": [0, 1, 0]}, "merge them into"),
    "before the start": (DOSES | {"time": [-1.0, 2.0, 3.0]}, "before t0 = 0.0"),
    "a flag": (DOSES | {"before": [0, 2, 0]}, "must be 1 where.*got 2 in row 1"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_table_of_events_is_refused(case):
    events, message = BAD[case]
    with pytest.raises(psf.errors.ModelError, match=message):
        psf.log_likelihood(COMPARTMENT, psf.EKF(), PARAMS, DATA, times=TIMES, events=events)


def test_a_system_with_wrong_events_is_refused():
    for arguments, message in [
        ({"event": None}, "event must be the function"),
        ({"events": ["amount"]}, "must name arguments of event"),
        ({"events": ["time"]}, "must not have the name 'time'"),
        ({"events": ["x"]}, "must not have the name 'x'"),
        ({"event": lambda x, q, dose: [x[0] + dose]}, "'q' is reserved"),
        ({"event": lambda x, dose: [x[0], dose]}, r"event must have shape \(1,\)"),
        ({"event": lambda x, k: [x[0] + k], "events": ["k"]}, "rename one"),
    ]:
        with pytest.raises(psf.errors.ModelError, match=message):
            one_compartment(**arguments)
    plain = one_compartment(event=None, events=())
    with pytest.raises(psf.errors.ModelError, match="must be None for a system without events"):
        psf.log_likelihood(plain, psf.EKF(), PARAMS, DATA, times=TIMES, events=DOSES)


def test_online_refuses_events():
    with pytest.raises(psf.errors.ModelError, match="online takes no events"):
        psf.online(COMPARTMENT, psf.EKF(), PARAMS)


def test_an_event_may_have_no_numbers_and_a_record_no_events():
    system = one_compartment(event=lambda x: [0.5 * x[0]], events=())
    params = {name: value for name, value in PARAMS.items() if name != "F"}
    call = {"params": params, "times": TIMES, "noise": False}
    halved = psf.simulate(system, events={"time": [0.5, 1.0]}, **call)["observations"].values
    whole = psf.simulate(system, events={"time": []}, **call)["observations"].values
    np.testing.assert_allclose(halved / whole, [[1], [0.5], [0.25], [0.25]], rtol=1e-13)


def test_an_event_that_is_undefined_without_a_dose_leaves_gradients_finite():
    system = one_compartment(event=lambda x, dose, F: [x[0] + pt.exp(F * pt.log(dose))])
    with pm.Model() as model:
        pm.Normal("F", 1.0)
        params = {name: value for name, value in PARAMS.items() if name != "F"}
        psf.StateSpace("y", system, psf.EKF(), params=params, times=TIMES, observed=DATA,
                       events=DOSES)  # fmt: skip
    assert np.isfinite(model.compile_dlogp()({"F": np.asarray(0.9)})).all()


def test_events_have_dates_as_times_have():
    days = pd.Timestamp("2024-01-01") + pd.to_timedelta(TIMES, unit="D")
    events = DOSES | {"time": pd.Timestamp("2024-01-01") + pd.to_timedelta(DOSES["time"], unit="D")}
    found = psf.log_likelihood(
        COMPARTMENT, psf.EKF(), PARAMS, DATA, times=days, t0=pd.Timestamp("2024-01-01"), unit="D",
        events=events,
    )  # fmt: skip
    assert found.sum() == pytest.approx(log_density(), abs=1e-9)
