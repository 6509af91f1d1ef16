"""Percentiles of replicated panels against their exact laws, and what is not drawn anew."""

import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import beta, norm

import pymc_statespace_filters as psf
from pymc_statespace_filters import plot_forecast
from pymc_statespace_filters.errors import ModelError, ModelWarning
from tests.plots.drawn import drawn

pytestmark = pytest.mark.usefixtures("interpreted")

PERCENTILES = (5, 50, 95)
OF_PREDICTIONS = {"group": "posterior_predictive", "backend": "none"}


def a_panel(data, draws, times, records, posterior=None, effects=None):
    """Data (rows, observables) and replicates (draws, rows, observables) as PyMC stores them."""
    names = [f"y{i}" for i in range(data.shape[1])]
    rows, observable = ("d_obs", "observable"), {"observable": names}
    sample = {"chain": [0], "draw": np.arange(len(draws))}
    groups = {
        "observed_data": xr.Dataset({"d": (rows, data)}, observable),
        "constant_data": xr.Dataset({"d_panel": ("d_obs", records), "d_time": ("d_obs", times)}),
        "posterior_predictive": xr.Dataset(
            {"d": (("chain", "draw", *rows), draws[None])}, observable | sample
        ),
        "posterior": xr.Dataset(coords=sample),
    }
    for group, values in (("posterior", posterior), ("posterior_predictive", effects)):
        if values is not None:
            groups[group]["z"] = ("chain", "draw", "person"), values[None]
    return xr.DataTree.from_dict(groups)


def bands(collection, variable="y0"):
    """Lower ends, medians, upper ends and data, (4, bins, 3), with the times of the bins."""
    parts = []
    for one in PERCENTILES:
        band, median, data = (
            drawn(collection, f"{visual}_{one}")[variable] for visual in ("band", "median", "data")
        )
        for curve in filter(None, (median, data)):
            np.testing.assert_array_equal(curve["x"], band["x"])
        parts.append([band["y_bottom"], median["y"], band["y_top"], data["y"]])
    return band["x"], np.moveaxis(parts, 0, -1)


N_PEOPLE, N_DRAWS = 201, 3000
SPREAD, NOISE = 2.0, 0.5


@pytest.fixture(scope="module")
def gaussian():
    """Replicates 1 + time + eta + e of new people, at three times each."""
    rng = np.random.default_rng(1)
    people, times = np.repeat(np.arange(N_PEOPLE), 3), np.tile([0.0, 1.0, 5.0], N_PEOPLE)
    effects = SPREAD * rng.normal(size=(N_DRAWS, N_PEOPLE))
    draws = 1.0 + times + effects[:, people] + NOISE * rng.normal(size=(N_DRAWS, people.size))
    data = np.sort(rng.normal(size=people.size))[:, None]
    return a_panel(data, draws[..., None], times, people, rng.normal(size=effects.shape), effects)


def test_percentiles_of_replicates_have_the_law_of_order_statistics(gaussian):
    """Of 201 people the percentiles are the 11th, the 101st and the 191st, whose laws are exact.

    Within 5 standard errors; a right implementation fails once in 60 000 runs of all 27.
    """
    times, found = bands(plot_forecast(gaussian, bins=3, **OF_PREDICTIONS))
    np.testing.assert_array_equal(times, [0.0, 1.0, 5.0])
    scale = np.hypot(SPREAD, NOISE)
    for p, rank in enumerate((11, 101, 191)):
        law = beta(rank, N_PEOPLE + 1 - rank)
        for q, level in enumerate((0.05, 0.5, 0.95)):
            uniform = law.ppf(level)
            exact = norm.ppf(uniform)
            density = law.pdf(uniform) * norm.pdf(exact)
            error = np.sqrt(level * (1 - level) / N_DRAWS) / density
            np.testing.assert_array_less(
                np.abs((found[q, :, p] - 1.0 - times) / scale - exact), 5 * error
            )
    data = gaussian["observed_data"]["d"].values.reshape(N_PEOPLE, 3)
    np.testing.assert_allclose(found[3], np.percentile(data, PERCENTILES, axis=0).T)


def test_missing_data_are_missing_in_replicates():
    """A value that is missing is left out of each replicate, though it is the largest there."""
    rng = np.random.default_rng(2)
    data, draws = rng.normal(size=(40, 2)), rng.normal(size=(30, 40, 2))
    data[::4, 0], draws[:, ::4, 0] = np.nan, 1e6
    data[20:, 1] = np.nan
    tree = a_panel(data, draws, np.repeat([0.0, 1.0], 20), np.tile(np.arange(20), 2))
    collection = plot_forecast(tree, bins=2, **OF_PREDICTIONS)
    _, found = bands(collection)
    seen = np.arange(20) % 4 > 0
    for b, rows in enumerate((slice(20), slice(20, 40))):
        replicated = np.percentile(draws[:, rows, 0][:, seen], PERCENTILES, axis=-1)
        np.testing.assert_allclose(found[:3, b], np.quantile(replicated, [0.05, 0.5, 0.95], axis=1))
        np.testing.assert_allclose(found[3, b], np.percentile(data[rows, 0][seen], PERCENTILES))
    points = drawn(collection, "data")
    assert points["y0"]["x"].size == 6
    np.testing.assert_array_equal(points["y1"]["x"], np.zeros(3))  # nothing in the second bin


def middle_of(times, bins):
    """The mean times of bins, and the medians of data that are their own numbers."""
    n = len(times)
    data = np.arange(n, dtype=float)[:, None]
    tree = a_panel(data, data + np.zeros((4, 1, 1)), times, np.zeros(n, int))
    shown, found = bands(plot_forecast(tree, bins=bins, **OF_PREDICTIONS))
    np.testing.assert_array_equal(found[1, :, 1], found[3, :, 1])
    return shown, found[3, :, 1].tolist()


def test_rows_of_bins():
    times = np.array([9.0, 0.0, 1.0, 2.0, 4.0, 6.0])
    shown, medians = middle_of(times, 3)  # two rows each, sorted by time
    np.testing.assert_allclose(shown, [0.5, 3.0, 7.5])
    assert medians == [1.5, 3.5, 2.5]
    shown, medians = middle_of(times, [0, 2, 3, 6])  # 6 is in the last bin, 9 in none
    np.testing.assert_allclose(shown, [0.5, 2.0, 5.0])
    assert medians == [1.5, 3.0, 4.5]
    shown, _ = middle_of(np.repeat([1.0, 2.0], [25, 5]), 3)
    np.testing.assert_allclose(shown, [1.0, 2.0])  # rows of one time are not divided


def test_bins_of_dates():
    dates = pd.date_range("2026-01-01", periods=6, freq="D").to_numpy()
    shown, medians = middle_of(dates, ["2026-01-01", "2026-01-03", "2026-01-06"])
    np.testing.assert_array_equal(
        shown, [dates[0] + np.timedelta64(12, "h"), dates[3] + np.timedelta64(12, "h")]
    )
    assert medians == [0.5, 3.5]
    shown, _ = middle_of(dates, 2)
    np.testing.assert_array_equal(shown, [dates[1], dates[4]])


def test_correction_takes_the_dose_out():
    """Of data and replicates in proportion to a dose, corrected percentiles are those of dose 1."""
    rng = np.random.default_rng(3)
    times = np.tile([0.5, 1.0, 3.0, 3.5], 15)
    curve = np.where(times < 2, 1.0, 0.25)  # the same in a bin
    dose = np.repeat(2.0 ** np.arange(-7, 8), 4)  # of median 1
    noise, of_data = np.exp(rng.normal(size=(400, 60))), np.exp(rng.normal(size=60))
    noise /= np.median(noise, axis=0)  # the median replicate of a row is dose times curve
    found = []
    for one in (dose, np.ones(60)):
        data, draws = one * curve * of_data, one * curve * noise
        tree = a_panel(data[:, None], draws[..., None], times, np.repeat(np.arange(15), 4))
        collection = plot_forecast(tree, bins=[0, 2, 4], corrected=True, **OF_PREDICTIONS)
        found.append(bands(collection)[1])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12)
    plain = bands(plot_forecast(tree, bins=[0, 2, 4], **OF_PREDICTIONS))[1]
    np.testing.assert_allclose(found[1], plain, rtol=1e-12)  # nothing to correct
    assert drawn(collection, "y_label")["y0"]["string"] == "corrected y0"


def test_correction_needs_positive_data(gaussian):
    with pytest.raises(
        ModelError, match=r"corrected needs positive data, got -\d.* of 'y0' at time 0.*exp if"
    ):
        plot_forecast(gaussian, bins=3, corrected=True, **OF_PREDICTIONS)
    collection = plot_forecast(gaussian, bins=3, corrected=True, transform=np.exp, **OF_PREDICTIONS)
    assert drawn(collection, "y_label")["y0"]["string"] == "corrected exp(y0)"
    data, draws = np.ones((3, 1)), np.zeros((5, 3, 1))
    tree = a_panel(data, draws, np.array([0.0, 1.0, 2.0]), np.arange(3))
    with pytest.raises(ModelError, match=r"positive predictions, got 0 of 'y0' at time 1.0: leave"):
        plot_forecast(tree, bins=[1, 3], corrected=True, **OF_PREDICTIONS)


def test_censored_values_are_the_lowest():
    """What lies above every limit is as of complete data; the rest is not drawn."""
    rng = np.random.default_rng(6)
    times = np.repeat([0.0, 1.0, 2.0], 41)  # percentiles are between the 3rd and 4th, ...
    complete = np.sort(rng.uniform(size=(3, 41)), axis=1)
    limit = complete[1, 20]  # in bin 1 the median is the lowest value that is seen
    complete[0] += 1.0  # above the limit
    draws = rng.uniform(size=(50, 123, 2))
    data = np.maximum(complete, limit).reshape(-1, 1)
    flags = -1.0 * (complete < limit).reshape(-1, 1)
    data, flags = np.hstack([data, draws[0, :, :1]]), np.hstack([flags, np.zeros((123, 1))])
    tree = a_panel(data, draws, times, np.tile(np.arange(41), 3))
    tree["constant_data"] = (
        tree["constant_data"].to_dataset().assign(d_censored=(("d_obs", "observable"), flags))
    )
    collection = plot_forecast(tree, bins=3, **OF_PREDICTIONS)
    _, found = bands(collection)
    exact = np.percentile(complete, PERCENTILES, axis=1).T
    assert np.isfinite(found[3]).tolist()[:2] == [[True, True, True], [False, True, True]]
    np.testing.assert_allclose(found[3][:2], np.where(np.isfinite(found[3]), exact, np.nan)[:2])
    share = "share of y0 below its limit"
    shown = {part: drawn(collection, f"{part}_50")[share] for part in ("data", "median", "band")}
    np.testing.assert_allclose(shown["data"]["y"], (complete < limit).mean(axis=1))
    replicated = (draws[..., 0] < limit).reshape(50, 3, 41).mean(axis=-1)
    np.testing.assert_allclose(shown["median"]["y"], np.median(replicated, axis=0))
    np.testing.assert_allclose(shown["band"]["y_top"], np.quantile(replicated, 0.95, axis=0))
    labels = drawn(collection, "y_label")
    assert [labels[name]["string"].replace("\n", " ") for name in ("y0", "y1", share)] == [
        "y0",
        "y1",
        share,
    ]
    assert drawn(collection, "band_5")[share] is None


def test_limits_that_differ_leave_open_what_is_below_the_largest():
    """Of 1 to 20 those below 10.5 in one assay of two, and above 15.5 in one, are unknown."""
    values = np.arange(1.0, 21.0)
    flags = np.where((values % 2 == 0) & (values < 10.5), -1.0, 1.0 * (values > 15.5))
    flags[0] = -1.0
    data = np.where(flags < 0, 10.5, np.where(flags > 0, 15.5, values))
    data[0] = 1.5  # the limit of the other
    tree = a_panel(data[:, None], np.ones((3, 20, 1)), np.zeros(20), np.arange(20))
    tree["constant_data"] = (
        tree["constant_data"]
        .to_dataset()
        .assign(d_censored=(("d_obs", "observable"), flags[:, None]))
    )
    collection = plot_forecast(tree, bins=1, **OF_PREDICTIONS)
    # 50 % is between 10, which is open, and 11; and there is no share below limits that differ.
    assert "data" not in collection.viz.children
    assert list(drawn(collection, "y_label")) == ["y0"]
    tree = tree.isel(d_obs=slice(1, None))
    points = drawn(plot_forecast(tree, bins=1, **OF_PREDICTIONS), "data")
    np.testing.assert_array_equal(points["y0"]["y"], [11.0])


def test_chosen_records(gaussian):
    _, found = bands(plot_forecast(gaussian, bins=3, records=[7, 9], **OF_PREDICTIONS))
    data = gaussian["observed_data"]["d"].values.reshape(N_PEOPLE, 3)[[7, 9]]
    np.testing.assert_allclose(found[3], np.percentile(data, PERCENTILES, axis=0).T)


def test_a_single_bin_has_bars(gaussian):
    collection = plot_forecast(gaussian, bins=1, **OF_PREDICTIONS)
    low, high = drawn(collection, "band_50")["y0"]["y"][:2]
    assert low < drawn(collection, "median_50")["y0"]["y"][0] < high


def test_records_that_are_repeated(gaussian):
    """No new draws of what differs between people, or copies of those of the posterior."""
    forgotten = gaussian.copy(deep=True)
    forgotten["posterior_predictive"] = forgotten["posterior_predictive"].to_dataset()[["d"]]
    copied = gaussian.copy(deep=True)
    copied["posterior"] = copied["posterior_predictive"].to_dataset()[["z"]]
    thinned = copied.copy(deep=True)
    thinned["posterior_predictive"] = copied["posterior_predictive"].isel(draw=slice(0, None, 7))
    for tree in (forgotten, copied, thinned):
        with pytest.warns(ModelWarning, match=r"\['z'\] differ .*sample_vars=\['z', 'd'\], extend"):
            plot_forecast(tree, bins=3, **OF_PREDICTIONS)
    alone = gaussian.copy(deep=True)
    del alone["posterior"]
    with pytest.raises(ModelError, match="must have the posterior of a panel beside"):
        plot_forecast(alone, bins=3, **OF_PREDICTIONS)


def test_what_is_refused(gaussian):
    for settings, message in (
        ({"bins": 0}, "bins must be an integer of at least 1, got 0"),
        ({"bins": [1, 1]}, r"increasing edges, at least two and numbers or dates.*got \[1, 1\]"),
        ({"bins": ["a", "b"]}, r"increasing edges, .* got \['a', 'b'\]"),
        ({"bins": [6, 7]}, "bins from 6.0 to 7.0 must have data, got those at 0.0 to 5.0"),
        ({"bins": 3, "errors": True, "truth": 1}, "bins must be None beside truth and errors, got"),
        ({"bins": 3, "group": "predictions"}, "no group 'predictions'"),
        ({"corrected": True}, "corrected must be False without bins, got True"),
        ({"bins": 3, "records": 300}, "records must be among the labels"),
    ):
        with pytest.raises(ModelError, match=message):
            plot_forecast(gaussian, **OF_PREDICTIONS | settings)
    other = gaussian.copy(deep=True)
    other["observed_data"] = xr.Dataset()
    with pytest.raises(
        ModelError, match="at the 603 rows of 'd' in posterior_predictive with bins"
    ):
        plot_forecast(other, bins=3, **OF_PREDICTIONS)
    other["predictions"] = other["posterior_predictive"].to_dataset()
    with pytest.raises(ModelError, match=r"group must be one of .* with bins, got 'predictions'"):
        plot_forecast(other, bins=3, group="predictions")


N_FITTED, N_PER_PERSON = 40, 4
LIMIT = 2.2  # of detection


@pytest.fixture(scope="module")
def fitted():
    """A panel whose people are known exactly and alike, beside a wide population."""
    system = psf.StateSpaceModel(
        transition=lambda x: [x[0]],
        dt=1,
        observation=lambda x: x[0],
        observation_noise=[[0.25]],
        initial_mean=lambda level, shift: [level + shift],
        initial_cov=[[0.0]],
        observables=["y"],
    )
    labels = np.repeat(np.arange(N_FITTED), N_PER_PERSON)
    rng = np.random.default_rng(4)
    with pm.Model(coords={"person": np.arange(N_FITTED)}) as model:
        spread = pm.HalfNormal("spread")
        z = pm.Normal("z", dims="person")
        pm.Deterministic("level", 3.0 + spread * z, dims="person")
        pm.Normal("shift", 0.0, spread, dims="person")  # centred
        data = 3.0 + 0.5 * rng.normal(size=(labels.size, 1))
        psf.StateSpace(
            "d", system, psf.EKF(), panel=labels, steps=np.tile(np.arange(1, 5), N_FITTED),
            observed=np.maximum(data, LIMIT), censored=-1.0 * (data < LIMIT),
        )  # fmt: skip
    people = {
        name: (("chain", "draw", "person"), 0.01 * rng.normal(size=(1, 500, N_FITTED)))
        for name in ("z", "shift")
    }
    people["level"] = people["z"][0], 3.0 + 2.0 * people["z"][1]
    posterior = xr.Dataset(
        people | {"spread": (("chain", "draw"), np.full((1, 500), 2.0))},
        {"person": np.arange(N_FITTED)},
    )
    return model, posterior


def replicated(fitted, **variables):
    model, posterior = fitted
    tree = xr.DataTree.from_dict({"posterior": posterior})
    with model:
        return pm.sample_posterior_predictive(
            tree, random_seed=5, progressbar=False, extend_inferencedata=True, **variables
        )


def variance_between(tree):
    """The mean over draws of the variance between the means of people, (rows,) to one."""
    values = tree["posterior_predictive"]["d"].values.reshape(500, N_FITTED, N_PER_PERSON)
    return values.mean(axis=-1).var(axis=-1, ddof=1).mean()


def test_people_are_drawn_from_the_population(fitted):
    """The variance between people is 2 spread^2 + noise, 2 x 4 + 0.25 / 4, to 5 standard errors.

    sd of a mean of 500 variances with 39 degrees of freedom: (2 / 39 / 500)^0.5, 1 %.
    """
    model, _ = fitted
    tree = replicated(fitted, sample_vars=["z", "shift", "level", "d"])  # what the warning says
    np.testing.assert_allclose(variance_between(tree), 8.0 + 0.25 / 4, rtol=0.05)
    new = tree["posterior_predictive"]
    np.testing.assert_allclose(new["level"].values, 3.0 + 2.0 * new["z"].values)
    for given in (None, model):
        collection = plot_forecast(tree, bins=2, model=given, **OF_PREDICTIONS)
    share = {
        part: drawn(collection, f"{part}_50")["share of y below its limit"]["y"].mean()
        for part in ("data", "median")
    }
    np.testing.assert_allclose(share["data"], (tree["observed_data"]["d"].values == LIMIT).mean())
    # Replicates are not censored: their sd is that of a person's sum of effects and noise.
    np.testing.assert_allclose(share["median"], norm.cdf((LIMIT - 3.0) / 8.25**0.5), atol=0.03)
    names = {"var_names": ["z", "shift", "level", "d"]}  # shows copies of the posterior
    call = r"sample_vars=\['z', 'shift', 'level', 'd'\]"
    for variables in ({}, names):
        tree = replicated(fitted, **variables)
        np.testing.assert_allclose(variance_between(tree), 0.25 / 4, rtol=0.2)
        with pytest.warns(ModelWarning, match=call):
            plot_forecast(tree, bins=2, **OF_PREDICTIONS)
    in_part = new.to_dataset().assign(shift=fitted[1]["shift"])
    tree["posterior_predictive"] = in_part
    with pytest.warns(
        ModelWarning, match=r"\['shift'\] differ .*sample_vars=\['z', 'shift', 'd'\]"
    ):
        plot_forecast(tree, bins=2, model=model, **OF_PREDICTIONS)
    plot_forecast(tree, bins=2, **OF_PREDICTIONS)  # without the model it might be a Deterministic
