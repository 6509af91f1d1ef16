"""States, forecasts and free runs of records at any times and at dates."""

import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from tests.states.models import posterior
from tests.system.test_times import DATA, DATES, DAYS, DRIVEN, EXACT, NOISE, THETA, exact_terms

pytestmark = pytest.mark.usefixtures("interpreted")

SERIES = pd.Series(DATA, index=pd.DatetimeIndex(DATES))
IDATA = {name: np.full((2, 400), value) for name, value in THETA.items()}
# Given all data, at the last date: the state, and its law after one day and a half.
LATER = DATES[-1] + np.timedelta64(36, "h")


def ou_model(**settings):
    with pm.Model() as model:
        pm.HalfNormal("a")
        pm.HalfNormal("s")
        psf.StateSpace("d", EXACT, psf.EKF(), **settings)
    return model


@pytest.fixture(scope="module")
def model():
    return ou_model(observed=SERIES, unit="D")


def last_moments():
    """Mean and variance of the state at the last observation, by `run_filter` with numbers."""
    run = psf.run_filter(EXACT, psf.EKF(), THETA, DATA, times=DAYS)
    return float(run["mean"][-1, 0]), float(run["cov"][-1, 0, 0])


def test_the_density_and_the_coordinates_of_a_series(model):
    np.testing.assert_array_equal(np.array(model.coords["d_time"], "datetime64[s]"), DATES)
    other = ou_model(observed=DATA, times=DAYS)
    at = {"a_log__": np.log(THETA["a"]), "s_log__": np.log(THETA["s"])}
    terms = [m.compile_logp(m.observed_RVs, sum=False)(at)[0] for m in (model, other)]
    np.testing.assert_array_equal(*terms)
    np.testing.assert_allclose(terms[0], exact_terms(DAYS), rtol=0, atol=1e-12)


@pytest.mark.parametrize("moment", [psf.filtered_states, psf.smoothed_states])
def test_states_are_at_the_dates_of_the_data_and_of_all_steps(model, moment):
    idata = moment(posterior(**IDATA), model, n_draws=4, random_seed=1)
    group = idata[moment.__name__]
    np.testing.assert_array_equal(group["d_time"], DATES)
    assert np.issubdtype(group["d_time"].dtype, np.datetime64)
    steps = moment(posterior(**IDATA), model, at="steps", n_draws=4, random_seed=1)
    at_steps = steps[moment.__name__].to_dataset()
    assert at_steps.sizes["d_time"] > DATES.size
    same = at_steps["d_mean"].sel(d_time=DATES)
    np.testing.assert_allclose(same, group["d_mean"], rtol=1e-12)


def test_a_forecast_at_a_date_has_its_law_and_survives_a_file(model, tmp_path):
    idata = psf.forecast(posterior(**IDATA), model, times=[LATER], random_seed=1)
    group = idata["predictions"]
    np.testing.assert_array_equal(group["d_time"], [LATER])
    mean, variance = last_moments()
    decay = np.exp(-THETA["a"] * 1.5)
    sd = np.sqrt(decay**2 * variance + THETA["s"] ** 2 * (1 - decay**2) / (2 * THETA["a"]) + NOISE)
    drawn = group["d"].values.ravel()
    assert abs(drawn.mean() - decay * mean) < 4 * sd / np.sqrt(drawn.size)
    assert abs(drawn.std() / sd - 1) < 4 / np.sqrt(2 * drawn.size)
    idata.to_netcdf(tmp_path / "forecast.nc")
    with xr.open_datatree(tmp_path / "forecast.nc") as again:
        np.testing.assert_array_equal(again["predictions"]["d_time"], [LATER])


def test_steps_of_the_future_are_as_long_as_dt(model):
    idata = psf.forecast(posterior(**IDATA), model, n_steps=3, n_draws=2, random_seed=1)
    expected = DATES[-1] + 12 * np.arange(1, 4) * np.timedelta64(1, "h")
    np.testing.assert_array_equal(idata["predictions"]["d_time"], expected)


@pytest.mark.parametrize("zone", [None, "Europe/Paris"])
def test_later_dates_have_a_zone_if_the_data_have_one(zone):
    there = pd.DatetimeIndex(DATES, tz=zone)
    model = ou_model(observed=pd.Series(DATA, index=there), unit="D")
    idata, later = posterior(**IDATA), there[-1:] + pd.Timedelta("36h")
    found = psf.forecast(idata, model, times=later, n_draws=2, random_seed=1)
    utc = later if zone is None else later.tz_convert("UTC").tz_localize(None)
    np.testing.assert_array_equal(found["predictions"]["d_time"], utc)
    other = later.tz_localize("UTC") if zone is None else later.tz_localize(None)
    for call in (psf.forecast, psf.free_run):
        with pytest.raises(ModelError, match=r"times must have (a|no) time zone"):
            call(idata, model, times=other, n_draws=2)


def test_a_record_on_the_grid_is_forecast_at_any_time():
    grid = ou_model(observed=DATA[:4], times=[0.5, 1.0, 2.5, 3.0])
    idata = psf.forecast(posterior(**IDATA), grid, times=[3.2, 4.7], n_draws=2, random_seed=1)
    np.testing.assert_allclose(idata["predictions"]["d_time"], [3.2, 4.7], rtol=1e-15)


def test_a_free_run_at_dates(model):
    idata = psf.free_run(posterior(**IDATA), model, n_draws=2)
    group = idata["free_run"]
    np.testing.assert_array_equal(group["d_time"], DATES)
    np.testing.assert_allclose(group["d"][0, 0, :, 0], 0.3 * np.exp(-THETA["a"] * DAYS))
    later = psf.free_run(posterior(**IDATA), model, times=[LATER], n_draws=2)["free_run"]
    days = (LATER - DATES[0]) / np.timedelta64(1, "D")
    np.testing.assert_allclose(later["d"][0, 0, 0, 0], 0.3 * np.exp(-THETA["a"] * days))


def test_inputs_with_times_in_a_model_and_in_its_future():
    with pm.Model() as model:
        pm.Normal("a")
        psf.StateSpace(
            "d", DRIVEN, psf.EKF(), times=[0.7, 2.0], observed=[0.6, 1.0],
            inputs=[1.0, 3.0], input_times=[0.0, 0.9],
        )  # fmt: skip
    idata = posterior(a=np.zeros((2, 2)))
    forces = {"inputs": [1.0, 3.0, 5.0], "input_times": [0.0, 0.9, 2.3]}
    found = psf.forecast(idata, model, times=[2.5], random_seed=1, **forces)["predictions"]
    start = 0.9 + 1.1 * 3.0
    np.testing.assert_allclose(found["d_states"], start + 0.3 * 3.0 + 0.2 * 5.0, rtol=1e-9)
    run = psf.free_run(idata, model, times=[1.0, 2.5], **forces)["free_run"]
    expected = np.array([0.9 + 0.3, start + 0.9 + 1.0])
    np.testing.assert_allclose(run["d"][0, 0, :, 0], expected, rtol=1e-12)
    # Other times have other steps, of which the model's inputs give the rows.
    run = psf.free_run(idata, model, times=[0.8, 1.0])["free_run"]
    np.testing.assert_allclose(run["d"][0, 0, :, 0], [0.8, 1.2], rtol=1e-12)


def test_rows_of_inputs_are_not_those_of_other_steps():
    with pm.Model() as model:
        pm.Normal("a")
        record = {"steps": [1, 2], "observed": [0.5, 1.0], "inputs": [1.0, 1.0, 1.0]}
        psf.StateSpace("d", DRIVEN, psf.EKF(), **record)
    with pytest.raises(ModelError, match="inputs must be given, with input_times"):
        psf.free_run(posterior(a=np.zeros((2, 2))), model, times=[0.3, 0.9])


@pytest.mark.parametrize("inputs_at", ["hold", "linear"])
def test_inputs_with_times_go_on_in_a_forecast(inputs_at):
    with pm.Model() as model:
        pm.Normal("a")
        psf.StateSpace(
            "d", DRIVEN, psf.EKF(), times=[0.7, 2.0], observed=[0.6, 1.0],
            inputs=[3.0, 3.0, 5.0], input_times=[0.0, 2.0, 2.3], inputs_at=inputs_at,
        )  # fmt: skip
    idata = posterior(a=np.zeros((2, 2)))
    on = psf.forecast(idata, model, times=[2.3, 2.5], random_seed=1)["predictions"]["d_states"]
    first = 6.0 + 0.3 * (3.0 if inputs_at == "hold" else 4.0)
    np.testing.assert_allclose(on[0, 0, :, 0], [first, first + 0.2 * 5.0], rtol=1e-9)
    others = {"inputs": [1.0, 1.0], "input_times": [2.0, 3.0], "inputs_at": inputs_at}
    on = psf.forecast(idata, model, times=[2.5], random_seed=1, **others)["predictions"]
    np.testing.assert_allclose(on["d_states"], 6.0 + 0.5, rtol=1e-9)
    others["inputs_at"] = "linear" if inputs_at == "hold" else "hold"
    with pytest.raises(ModelError, match="as that of the model"):
        psf.forecast(idata, model, times=[2.5], random_seed=1, **others)


def test_a_panel_has_the_dates_of_each_record():
    dates = np.array(["2020-01-01", "2020-01-04T06", "2021-06-01", "2021-06-02"], "datetime64[h]")
    model = ou_model(observed=DATA[:4], times=dates, unit="D", panel=["A", "A", "B", "B"])
    idata = psf.filtered_states(posterior(**IDATA), model, n_draws=2, random_seed=1)
    np.testing.assert_array_equal(idata["filtered_states"]["d_time"], dates)
    idata = psf.forecast(idata, model, n_steps=1, n_draws=2, random_seed=1)
    expected = dates[[1, 3]] + np.timedelta64(12, "h")
    np.testing.assert_array_equal(idata["predictions"]["d_time"], expected)
