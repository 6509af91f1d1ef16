"""Records at any times and at dates, against exact likelihoods and records on a grid."""

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.clock import clock_and_start
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.record import read_record
from pymc_statespace_filters.system.time_axis import divided_axis

THETA = {"a": 0.7, "s": 0.5}
NOISE = 0.1
SETTINGS = {
    "observation": lambda x: [x[0]],
    "observation_noise": [[NOISE]],
    "initial_mean": [0.3],
    "initial_cov": [[1.0]],
}
EXACT = psf.StateSpaceModel(
    transition=psf.ExactLinear(lambda a: [[-a]], lambda s: [[s]], dt=0.5), **SETTINGS
)
RNG = np.random.default_rng(1)
TIMES = np.sort(RNG.uniform(0.0, 12.0, 20))
DATA = RNG.normal(size=20)
DATA[4] = np.nan


def exact_terms(times=TIMES, data=DATA, a=THETA["a"], s=THETA["s"], mean=0.3, t0=0.0):
    """Kalman's formulas for an Ornstein-Uhlenbeck process."""
    variance, t, terms = 1.0, t0, []
    for time, value in zip(times, data, strict=True):
        decay = np.exp(-a * (time - t))
        mean, t = decay * mean, time
        variance = decay**2 * variance + s**2 * (1 - decay**2) / (2 * a)
        if np.isnan(value):
            terms.append(0.0)
            continue
        total = variance + NOISE
        terms.append(-0.5 * (np.log(2 * np.pi * total) + (value - mean) ** 2 / total))
        gain = variance / total
        mean, variance = mean + gain * (value - mean), variance * (1 - gain)
    return np.array(terms)


# The axis of time.


def test_a_gap_is_divided_into_the_fewest_equal_steps_of_at_most_dt():
    axis = divided_axis(np.array([0.0, 0.3, 1.5]), t0=0.0, dt=0.5, breaks=np.array([0.9]))
    np.testing.assert_array_equal(axis.steps, [0, 1, 5])
    np.testing.assert_allclose(axis.starts, [0.0, 0.3, 0.6, 0.9, 1.2, 1.5], rtol=1e-15)
    np.testing.assert_allclose(axis.lengths, [0.3, 0.3, 0.3, 0.3, 0.3, 0.0], rtol=1e-14)


def test_a_gap_of_whole_steps_has_so_many():
    axis = divided_axis(np.array([0.1 * 3, 0.7]), t0=0.0, dt=0.1, breaks=np.empty(0))
    np.testing.assert_array_equal(axis.steps, [3, 7])


def test_a_record_on_the_grid_has_the_system_and_the_arrays_of_its_steps():
    by_times = read_record(EXACT, GivenRecord(DATA[:3], times=[0.5, 1.0 + 1e-8, 3.0]))
    by_steps = read_record(EXACT, GivenRecord(DATA[:3], steps=[1, 2, 6]))
    assert by_times.system is EXACT
    for one, other in zip(by_times.arguments, by_steps.arguments, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.1, 0.35, 0.2], r"times\[1\] = 0.35 followed by 0.2 in row 2"),
        ([0.1, 0.1], r"times\[0\] = 0.1 followed by 0.1 in row 1"),
        ([-0.2, 0.1], r"times must not lie before t0 = 0.*times\[0\] = -0.2"),
        ([0.1, 1e12], "steps must be at most"),
    ],
)
def test_times_that_are_refused(times, message):
    with pytest.raises(ModelError, match=message):
        psf.log_likelihood(EXACT, psf.EKF(), THETA, [0.0] * len(times), times=times)


def test_a_function_has_whole_steps_and_an_integrator_of_one_length_is_named():
    class Fixed:
        dt, equations = 0.5, ()

        def substep(self):
            return self

        refined = substep

        def noise_size(self, values):
            return 1

        def step(self, values):
            return [0.5 * values["x"][0] + values["q"][0]]

        def is_stable_at(self, eigenvalues):
            return eigenvalues == 0

    by_function = {"transition": lambda x, q: [x[0] + q[0]], "process_noise": [[1.0]]}
    cases = [(by_function, "a transition that is a function"), ({"transition": Fixed()}, "Fixed")]
    for transition, name in cases:
        system = psf.StateSpaceModel(**transition, **SETTINGS)
        with pytest.raises(ModelError, match=rf"times\[0\] = 0.3 is off the grid.*{name}"):
            psf.log_likelihood(system, psf.EKF(), {}, [0.0], times=[0.3])


def test_a_record_off_the_grid_names_its_rows_and_the_call_that_rounds():
    system = psf.StateSpaceModel(
        transition=lambda x, q: [x[0] + q[0]], process_noise=[[1.0]], **SETTINGS
    )
    start = pd.Timestamp("2024-05-01")
    dates = pd.DatetimeIndex(["2024-05-01", "2024-05-01 05:00", "2024-05-02"])
    given = dict(times=dates, unit="h", t0=start - pd.Timedelta("1h"))
    with pytest.raises(ModelError, match=r"^times\[1\] = .*05:00.* is off") as caught:
        psf.log_likelihood(system, psf.EKF(), {}, np.zeros(3), times=dates, unit=pd.Timedelta("2h"))
    assert "t0 = 2024-05-01T00:00" in str(caught.value)
    assert "nearest_steps(dates, dt, t0=t0, unit=pd.Timedelta('0 days 02:00:00'))" in str(
        caught.value
    )
    with pytest.raises(ModelError, match='unit="h"'):
        psf.log_likelihood(
            system, psf.EKF(), {}, np.zeros(3), **given | {"times": dates + pd.Timedelta("7min")}
        )
    with pytest.raises(ModelError, match=r"all 2 rows of times, the first at 0\.3, are off"):
        psf.log_likelihood(system, psf.EKF(), {}, np.zeros(2), times=[0.3, 0.7])


# Likelihoods.


@pytest.mark.parametrize(("filter", "error"), [(psf.EKF(), 1e-12), (psf.GridFilter(), 1e-10)])
def test_an_exact_integrator_has_the_exact_likelihood_at_any_times(filter, error):
    terms = psf.log_likelihood(EXACT, filter, THETA, DATA, times=TIMES)
    np.testing.assert_allclose(terms, exact_terms(), rtol=0, atol=error)


def test_a_guided_filter_is_exact_too():
    found = psf.log_likelihood(EXACT, psf.GuidedPF(50), THETA, DATA, times=TIMES).sum()
    assert found == pytest.approx(exact_terms().sum(), abs=1e-9)


@pytest.mark.parametrize("stiff", [1.0, 200.0])
def test_an_exact_step_of_any_length_is_that_of_a_grid(stiff):
    """Two states and an offset; each time is on the grid of one system alone."""
    systems = [
        psf.StateSpaceModel(
            transition=psf.ExactLinear(
                lambda a, c=stiff: [[0.0, 1.0], [-a, -c]], [[0.0], [0.4]], dt=dt, offset=[0.1, -0.3]
            ),
            **SETTINGS | {"initial_mean": [0.3, 0.0], "initial_cov": np.eye(2)},
        )
        for dt in (0.25, 0.3)
    ]
    times = 0.25 * np.array([1, 2, 5, 9])
    records = [read_record(system, GivenRecord(DATA[:4], times=times)) for system in systems]
    assert [record.system.is_at_any_times for record in records] == [False, True]
    terms = [
        psf.log_likelihood(system, psf.EKF(), {"a": 2.0}, DATA[:4], times=times)
        for system in systems
    ]
    np.testing.assert_allclose(*terms, rtol=0, atol=1e-11)


def test_local_linearization_is_exact_for_a_linear_equation():
    assert error_of(psf.LocalLinearization, 0.3) < 1e-11


def error_of(integrator, dt):
    system = psf.StateSpaceModel(
        transition=integrator(lambda x, a: [-a * x[0]], lambda s: [[s]], dt=dt), **SETTINGS
    )
    terms = psf.log_likelihood(system, psf.EKF(), THETA, DATA, times=TIMES)
    return np.abs(terms - exact_terms()).max()


def test_euler_maruyama_converges_with_its_order():
    # With equal steps in each gap, an error of order h has a ratio near 4 for a quarter of dt.
    assert 3.3 < error_of(psf.EulerMaruyama, 0.04) / error_of(psf.EulerMaruyama, 0.01) < 4.7


def test_runge_kutta_without_noise_converges_with_its_order():
    times, at = np.array([0.13, 0.7, 1.9, 2.45, 4.0]), []
    for dt in (0.4, 0.2, 0.1):
        system = psf.StateSpaceModel(
            transition=psf.RungeKutta4(lambda x, t: [-x[0] + t * t], dt=dt), **SETTINGS
        )
        at.append(psf.simulate(system, {}, times=times, noise=False)["observations"].values[:, 0])
    exact = times**2 - 2 * times + 2 + (0.3 - 2) * np.exp(-times)
    errors = [np.abs(one - exact).max() for one in at]
    assert errors[0] / errors[2] > 120  # 4th order: 256
    assert errors[2] < 1e-5


def test_the_panel_is_the_sum_of_its_records():
    labels = np.repeat(["A", "B"], [12, 8])
    found = psf.log_likelihood(EXACT, psf.EKF(), THETA, DATA, panel=labels, times=TIMES)
    parts = [exact_terms(TIMES[:12], DATA[:12]), exact_terms(TIMES[12:], DATA[12:])]
    np.testing.assert_allclose(found, np.concatenate(parts), rtol=0, atol=1e-12)


def test_accumulators_and_times_are_columns_of_their_own():
    system = psf.StateSpaceModel(
        transition=psf.EulerMaruyama(lambda x: [1.0], [[0.0]], dt=0.2),
        accumulators=["x0"],
        **SETTINGS | {"initial_mean": [0.0], "initial_cov": [[0.0]]},
    )
    sim = psf.simulate(system, {}, times=[0.3, 0.75, 1.0], noise=False)
    np.testing.assert_allclose(sim["observations"][:, 0], [0.3, 0.45, 0.25], rtol=1e-12)


# Inputs with times of their own.

DRIVEN = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(lambda x, u: [u[0]], [[0.0]], dt=0.5),
    inputs=["rate"],
    **SETTINGS | {"initial_mean": [0.0], "initial_cov": [[0.0]]},
)


def total(inputs, input_times, inputs_at="hold", times=(0.7, 2.0), **settings):
    sim = psf.simulate(
        DRIVEN, {}, times=times, inputs=inputs, input_times=input_times, inputs_at=inputs_at,
        noise=False, **settings,
    )  # fmt: skip
    return sim["observations"].values[:, 0]


def test_held_inputs_change_within_a_step():
    np.testing.assert_allclose(total([1.0, 3.0], [0.0, 0.9]), [0.7, 0.9 + 3.3], rtol=1e-12)
    # On the grid too, where the change makes the steps.
    found = total([1.0, 3.0], [-1.0, 0.9], times=(0.5, 2.0))
    np.testing.assert_allclose(found, [0.5, 0.9 + 3.3], rtol=1e-12)


def test_linear_inputs_are_those_of_the_middle_of_a_step():
    # The integral of a linear function is exact.
    np.testing.assert_allclose(total([0.0, 2.0], [0.0, 2.0], "linear"), [0.245, 2.0], rtol=1e-12)


STAR = psf.StateSpaceModel(
    transition=psf.EulerMaruyama(lambda x: [0.0], [[0.0]], dt=1.0),
    inputs=["error"],
    **SETTINGS
    | {
        "observation_noise": lambda u: [[u[0] ** 2]],
        "initial_mean": [0.0],
        "initial_cov": [[0.0]],
    },
)


def errors_used(times=None, panel=None, n=3, **settings):
    """The standard deviation of each observation, from its term: data and states are zeros."""
    data = pd.Series(np.zeros(n), times) if panel is None else np.zeros(n)
    settings |= {} if panel is None else {"panel": panel, "times": times}
    terms = psf.log_likelihood(STAR, psf.EKF(), {}, data, **settings)
    return np.exp(-terms) / np.sqrt(2 * np.pi)


@pytest.mark.parametrize("inputs_at", ["hold", "linear"])
@pytest.mark.parametrize("end", [3.0, 3.25], ids=["grid", "any times"])
def test_an_observation_has_the_inputs_of_its_time(inputs_at, end):
    run = psf.run_filter(
        STAR, psf.EKF(), {}, np.zeros(3), times=[1.0, 2.0, end],
        inputs=[0.1, 0.1, 1.0, 0.2], input_times=[0.0, 1.0, 2.0, end], inputs_at=inputs_at,
    )  # fmt: skip
    sd = np.exp(-run["log_likelihood"]) / np.sqrt(2 * np.pi)
    np.testing.assert_allclose(sd, [0.1, 1.0, 0.2], rtol=1e-12)


def test_inputs_bring_their_dates():
    days = pd.date_range("2024-01-02", periods=3)
    dated = pd.DataFrame(
        {"error": np.arange(1.0, 11.0)}, index=pd.date_range("2023-12-30", periods=10)
    )
    settings = {"unit": "D", "t0": pd.Timestamp("2024-01-01")}
    found = errors_used(days, inputs=dated, **settings)
    np.testing.assert_allclose(found, [4.0, 5.0, 6.0], rtol=1e-12)
    found = errors_used(days, inputs=dated["error"], inputs_at="linear", **settings)
    np.testing.assert_allclose(found, [4.0, 5.0, 6.0], rtol=1e-12)
    panel = {"panel": ["A", "A", "B"], **settings}
    found = errors_used(days, inputs=dated, **panel)
    np.testing.assert_allclose(found, [4.0, 5.0, 6.0], rtol=1e-12)
    found = errors_used(days, inputs={"A": dated["error"], "B": 2 * dated["error"]}, **panel)
    np.testing.assert_allclose(found, [4.0, 5.0, 12.0], rtol=1e-12)
    with pytest.raises(ModelError, match="inputs must have dates as their index in all records"):
        errors_used(days, inputs={"A": dated, "B": dated.to_numpy()}, **panel)


@pytest.mark.parametrize(
    ("inputs", "input_times", "settings", "message"),
    [
        ([1.0, 2.0], [0.1, 1.0], {}, "input_times must begin at or before the first step, at 0"),
        ([1.0, 2.0], [0.0, 1.0], {"inputs_at": "linear"}, "input_times must reach"),
        ([1.0, 2.0], [1.0, 0.0], {}, r"input_times\[0\] = 1.0 followed by 0.0"),
        ([1.0], [0.0, 1.0], {}, r"inputs must have shape \(2, 1\)"),
        ([1.0, 2.0], [0.0, 1.0], {"inputs_at": "before"}, "inputs_at must be one of"),
        ([1.0, 2.0, 3.0], None, {}, "inputs must have times of their own.*each of the 5 steps"),
    ],
)
def test_inputs_that_are_refused(inputs, input_times, settings, message):
    with pytest.raises(ModelError, match=message):
        total(inputs, input_times, **settings)


def test_inputs_by_step_fit_where_there_are_as_many_as_steps():
    np.testing.assert_allclose(total([1.0] * 5, None), [0.7, 2.0], rtol=1e-12)


# Dates.

START = np.datetime64("2020-03-01T06:00", "s")
DATES = START + np.round(TIMES * 86400).astype("timedelta64[s]")
DAYS = (DATES - DATES[0]) / np.timedelta64(1, "D")


@pytest.mark.parametrize(
    "dates",
    [
        DATES,
        pd.DatetimeIndex(DATES),
        pd.Series(DATES),
        pd.DatetimeIndex(DATES, tz="UTC").tz_convert("Europe/Paris"),
        xr.DataArray(DATES, dims="time"),
        [pd.Timestamp(date).to_pydatetime() for date in DATES],
    ],
    ids=["array", "index", "series", "zone", "xarray", "datetimes"],
)
def test_dates_have_the_bits_of_equal_numbers(dates):
    placed = read_record(EXACT, GivenRecord(DATA, times=dates, unit="D"))
    expected = read_record(EXACT, GivenRecord(DATA, times=DAYS))
    for one, other in zip(placed.arguments, expected.arguments, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(placed.times([placed.axes[0].steps]), DATES)


def test_a_series_brings_its_dates():
    series = pd.Series(DATA, index=pd.DatetimeIndex(DATES))
    found = psf.log_likelihood(EXACT, psf.EKF(), THETA, series, unit="D")
    np.testing.assert_allclose(found, exact_terms(DAYS), rtol=0, atol=1e-12)


def test_a_start_before_the_first_date():
    found = psf.log_likelihood(EXACT, psf.EKF(), THETA, DATA, times=DATES, unit="D", t0=START)
    since = (DATES - START) / np.timedelta64(1, "D")
    np.testing.assert_allclose(found, exact_terms(since), rtol=0, atol=1e-12)


def test_a_number_as_t0_is_the_time_at_the_first_date():
    clock, t0 = clock_and_start([DATES], 3.0, "D")
    np.testing.assert_allclose(clock.numbers("times", DATES), 3.0 + DAYS, rtol=1e-12)
    assert t0 == 3.0


def test_records_of_a_panel_start_at_their_own_first_dates():
    dates = np.array(["2020-01-01", "2020-01-04", "2021-06-01", "2021-06-02"], "datetime64[D]")
    settings = {"panel": ["A", "A", "B", "B"], "unit": "D"}
    found = psf.log_likelihood(EXACT, psf.EKF(), THETA, DATA[:4], times=dates, **settings)
    parts = [exact_terms([0.0, 3.0], DATA[:2]), exact_terms([0.0, 1.0], DATA[2:4])]
    np.testing.assert_allclose(found, np.concatenate(parts), rtol=0, atol=1e-12)
    sim = psf.simulate(EXACT, THETA, times=dates, random_seed=1, **settings)
    np.testing.assert_array_equal(sim["obs_time"], dates)
    given = {"observed": sim["observations"], **settings}  # brings its dates
    by_dates, by_times = (
        psf.log_likelihood(EXACT, psf.EKF(), THETA, times=times, **given) for times in (None, dates)
    )
    np.testing.assert_array_equal(by_dates, by_times)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"times": DATES}, "unit must be the duration of one unit of model time"),
        ({"times": DATES, "unit": "Y"}, r"unit must be a duration.*got 'Y'"),
        ({"times": DATES, "unit": "MS"}, r"unit must be a duration.*got 'MS'"),
        ({"times": DATES, "unit": 3}, r"unit must be a duration.*got 3"),
        ({"times": TIMES, "unit": "D"}, "unit must be None where times are not dates"),
        ({"times": DATES.astype(str)}, "got text"),
        ({"times": DATES.astype(str), "unit": "D"}, "got text"),
        ({"times": DATES - START}, "got durations"),
        ({"times": TIMES, "t0": START}, "t0 must be a number"),
        ({"times": DATES, "unit": "D", "t0": DATES[3]}, "times must not lie before t0"),
        ({"times": DATES, "unit": "D", "t0": "2020-01-01"}, r"write pd.Timestamp\('2020-01-01'\)"),
        (
            {"times": DATES, "unit": "D", "t0": DATES[3]},
            "before t0 = 2020-03-03T.*got times.0. = 2020-03-01T",
        ),
        (
            {"times": pd.DatetimeIndex(DATES, tz="UTC"), "unit": "D", "t0": START},
            "t0 must have a time zone, as times",
        ),
        (
            {"times": DATES, "unit": "D", "t0": pd.Timestamp(START, tz="UTC")},
            "times must have a time zone, as t0",
        ),
        (
            {"times": np.append(DATES[:-1], np.datetime64("NaT", "s")), "unit": "D"},
            "got none in row 19",
        ),
    ],
)
def test_dates_that_are_refused(settings, message):
    with pytest.raises(ModelError, match=message):
        read_record(EXACT, GivenRecord(DATA, **settings))


def test_dates_of_the_data_are_those_of_the_times():
    series = pd.Series(DATA, index=pd.DatetimeIndex(DATES))
    expected = read_record(EXACT, GivenRecord(series, unit="D")).observed
    found = read_record(EXACT, GivenRecord(series, times=list(DATES), unit="D"))
    np.testing.assert_array_equal(found.observed, expected)
    other = pd.DatetimeIndex(DATES) + pd.Timedelta("1h")
    for observed, times in ((series, other), (series[::-1], DATES)):
        with pytest.raises(
            ModelError, match=r"times must be the dates of observed, got times.0. ="
        ):
            read_record(EXACT, GivenRecord(observed, times=times, unit="D"))
    with pytest.raises(ModelError, match="the dates of observed must increase"):
        read_record(EXACT, GivenRecord(series[::-1], steps=np.arange(DATA.size)))


def test_rows_of_tables_are_in_one_order():
    table = pd.DataFrame({"time": TIMES[::-1], "y": DATA[::-1]})
    in_order = table.sort_values("time")
    found = read_record(EXACT, GivenRecord(in_order["y"], times=in_order["time"]))
    np.testing.assert_array_equal(found.observed[:, 0], DATA)
    with pytest.raises(ModelError, match="times must have its rows in the order of observed"):
        read_record(EXACT, GivenRecord(table["y"], times=in_order["time"]))
    read_record(EXACT, GivenRecord(table["y"].to_numpy(), times=in_order["time"]))


def test_an_index_without_dates_is_named():
    for index in (DATES.astype(str), None, pd.period_range("2020", periods=DATA.size, freq="M")):
        with pytest.raises(ModelError, match=r"brings no dates.*pd.to_datetime.*got the index"):
            read_record(EXACT, GivenRecord(pd.Series(DATA, index=index)))


def test_missing_values_of_pandas_are_missing():
    series = pd.Series([1, None, 3], dtype="Int64")
    record = read_record(EXACT, GivenRecord(series, steps=[0, 1, 2]))
    np.testing.assert_array_equal(record.observed[:, 0], [1.0, np.nan, 3.0])


def test_panel_from_a_table_with_dates():
    frame = pd.DataFrame(
        {
            "who": ["B", "A", "B"],
            "when": pd.to_datetime(["2020-01-03", "2021-01-01", "2020-01-01"]),
            "y": [1.0, 2.0, 3.0],
        }
    )
    columns = {"record": "who", "time": "when", "values": "y", "unit": "D"}
    as_is = psf.panel_from(frame, **columns)
    np.testing.assert_array_equal(as_is["times"], frame["when"][[2, 0, 1]])
    np.testing.assert_array_equal(as_is["observed"][:, 0], [3.0, 1.0, 2.0])
    found = psf.log_likelihood(EXACT, psf.EKF(), THETA, **as_is)
    rounded = psf.panel_from(frame, dt=0.5, **columns)
    np.testing.assert_array_equal(rounded["steps"], [0, 4, 0])
    np.testing.assert_allclose(
        psf.log_likelihood(EXACT, psf.EKF(), THETA, **rounded), found, atol=1e-12
    )


# A run that goes on.


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(1500)])
@pytest.mark.parametrize("times", [TIMES, DATES], ids=["numbers", "dates"])
def test_a_run_goes_on_as_one_run(filter, times):
    settings = {"unit": "D"} if times is DATES else {}
    whole = psf.run_filter(EXACT, filter, THETA, DATA, times=times, **settings)
    first = psf.run_filter(EXACT, filter, THETA, DATA[:9], times=times[:9], **settings)
    rest = psf.run_filter(EXACT, filter, THETA, DATA[9:], times=times[9:], state=first, **settings)
    terms = np.concatenate([first["log_likelihood"], rest["log_likelihood"]])
    np.testing.assert_array_equal(terms, whole["log_likelihood"])
    np.testing.assert_array_equal(rest["obs_time"], whole["obs_time"][9:])
    if times is DATES:
        later = pd.DatetimeIndex(DATES[9:], tz="Europe/Paris")
        with pytest.raises(ModelError, match="times must have no time zone"):
            psf.run_filter(EXACT, filter, THETA, DATA[9:], times=later, state=first, unit="D")


@pytest.mark.parametrize("kind", ["datetime64[D]", "datetime64[s]", object])
def test_dates_before_1678_may_be_numbers(kind):
    """The error says how: by its own call, the days since the first."""
    days = np.array(["1601-01-01", "1601-01-03"], "datetime64[D]")
    given = days.astype(kind)
    system = psf.StateSpaceModel(
        psf.EulerMaruyama(lambda x, a: [-a * x[0]], [[0.3]], dt=0.5), observation=lambda x: [x[0]],
        observation_noise=[[0.1]], initial_mean=[1.0], initial_cov=[[0.1]],
    )  # fmt: skip
    with pytest.raises(ModelError, match="dates from 1678 to 2261") as refusal:
        psf.log_likelihood(system, psf.EKF(), {"a": 0.1}, [1.0, 0.9], times=given, unit="D")
    call = str(refusal.value).split("the days ")[1].split(" of dates")[0]
    times = eval(call, {"np": np, "dates": np.array(given, "datetime64[D]")})
    terms = psf.log_likelihood(system, psf.EKF(), {"a": 0.1}, [1.0, 0.9], times=times)
    by_steps = psf.log_likelihood(system, psf.EKF(), {"a": 0.1}, [1.0, 0.9], steps=[0, 4])
    np.testing.assert_array_equal(terms, by_steps)
