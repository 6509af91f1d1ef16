"""The scan for parameters that vary, against exact derivatives and data of known changes."""

from functools import cache

import numpy as np
import pandas as pd
import pymc as pm
import pytest
from scipy.stats import kstest

import pymc_statespace_filters as psf
from pymc_statespace_filters.diagnostics import drift_scan
from pymc_statespace_filters.diagnostics.constancy.statistics import (
    ConstancyTest,
    Statistics,
    _from_each_row,
    constancy,
    p_values,
)
from pymc_statespace_filters.diagnostics.constancy.table import (
    TimeAxis,
    _changes,
    _turns,
    sentences,
)
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.pymc_model.term_scores import ScoredVariable
from tests.systems import DUFFING, driven, driven_by_wandering_gain

N_ROWS = 100
FORCE = np.random.default_rng(0).normal(size=(N_ROWS, 1))
STEPS = np.arange(1, N_ROWS + 1)
TRUE = {"a": 0.7, "gain": 1.0, "sigma": 0.3}
AT_TRUE = np.array([0.7, np.log(0.3), 1.0])  # of the free variables, unconstrained


def simulated(random_seed, strength=0.0, **changes):
    values = {"strength": strength} | TRUE | changes
    run = psf.simulate(
        driven_by_wandering_gain(), values, steps=STEPS, inputs=FORCE, random_seed=random_seed
    )
    return run["observations"].values[:, 0]


def jumping(random_seed, to, at=60):
    """A record whose gain jumps."""
    rng, x, observed = np.random.default_rng(random_seed), 0.0, []
    for k in range(N_ROWS):
        gain = TRUE["gain"] if k < at else to
        x = TRUE["a"] * x + gain * FORCE[k, 0] + TRUE["sigma"] * rng.normal()
        observed.append(x + 0.2**0.5 * rng.normal())
    return np.array(observed)


def driven_model(observed, **settings):
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.3)
        pm.HalfNormal("sigma", 1.0)
        pm.Normal("gain", 0, 2)
        record = {"steps": STEPS, "inputs": FORCE, "observed": observed} | settings
        psf.StateSpace("d", driven(), record.pop("filter", psf.EKF()), **record)
    return model


@cache
def constant_record():
    """The variable of a model, in which data are replaced, and the durations of its rows."""
    model = driven_model(simulated(1))
    variable = ScoredVariable(model, "d")
    return variable, TimeAxis.of(model, variable).durations


class Point:
    """A point estimate, as that of `maximum_likelihood`."""

    unconstrained = AT_TRUE


def test_statistic_is_the_derivative_by_the_variance_of_a_walk():
    """Exact where a term depends on the parameter of its own step alone, a = 0. The parameter has
    not moved yet in the first step. Rows are up to four steps apart.
    """
    steps = STEPS[np.cumsum(np.random.default_rng(2).integers(1, 5, 38)) - 1]
    model = driven_model(simulated(1)[steps - 1], steps=steps)
    variable = ScoredVariable(model, "d")
    durations = TimeAxis.of(model, variable).durations - np.eye(len(steps))[0]
    x, scale = np.array([[0.0, np.log(0.3), 1.0]]), np.full(len(variable.labels), 0.03)
    scores = variable.scores(x, variable.observed[None], scale)
    found = constancy(scores, durations, variable.of_rows)
    free = constancy(scores._replace(by_x=0 * scores.by_x), durations, variable.of_rows)
    index = variable.labels.index("gain")
    values = {"a": 0.0, "sigma": 0.3, "gain": 1.0}

    def log_likelihood(strength):
        terms = psf.log_likelihood(
            driven_by_wandering_gain(), psf.EKF(), values | {"strength": strength},
            variable.observed, steps=steps, inputs=FORCE,
        )  # fmt: skip
        return terms.sum()

    gained = [(log_likelihood(s) - log_likelihood(0.0)) / s**2 for s in (2e-3, 1e-3)]
    exact = gained[1] + (gained[1] - gained[0]) / 3
    scaled = free.statistic[0, index] * scores.curvature[0, :, index].sum()
    np.testing.assert_allclose(scaled * durations.sum() / 2, exact, rtol=1e-3)
    # at a point that is no estimate the projection takes the sums of all scores away
    estimated = [variable.labels.index(name) for name in TRUE]
    np.testing.assert_allclose(found.remaining[0, 0, estimated], 0, atol=1e-5)


def test_scores_of_a_panel_are_summed_within_each_record():
    values, of_rows = np.arange(1.0, 7.0)[None, :, None], np.array([0, 0, 0, 1, 2, 2])
    np.testing.assert_array_equal(_from_each_row(values, of_rows)[0, :, 0], [6, 5, 3, 4, 11, 6])


def test_p_values_by_hand():
    simulated = np.array([[1.0, 5.0], [2.0, 6.0], [3.0, 7.0]])
    alone, adjusted = p_values(np.array([2.5, 9.0]), simulated)
    np.testing.assert_allclose(alone, [0.5, 0.25])
    # the smallest p-values are 1/4 of the data; 4/4, 3/4 and 1/4 of the others
    np.testing.assert_allclose(adjusted, [0.5, 0.5])


def p_values_of_constant_records(n_records, n_simulated):
    variable, durations = constant_record()
    observed, found = variable.observed, []
    try:
        for i in range(n_records):
            variable.observed = simulated(5000 + i)[:, None]
            test = ConstancyTest(variable, durations, AT_TRUE)
            result = test.run(np.arange(3), n_simulated, np.random.default_rng(i))
            values = p_values(result.data, result.simulated)
            found.append([*values.alone, values.adjusted.min()])
    finally:
        variable.observed = observed
    spread = np.random.default_rng(1).random((n_records, 4)) / (n_simulated + 1)
    return np.array(found) - spread


def test_p_values_of_constant_parameters_are_uniform():
    """Fails by chance once in 2500, four comparisons together."""
    found = p_values_of_constant_records(40, 19)
    assert min(kstest(column, "uniform").pvalue for column in found.T) > 1e-4


def test_a_jump_is_found_with_its_time_and_size():
    scan = drift_scan(Point(), driven_model(jumping(3, to=2.0)), random_seed=1)
    first = scan.iloc[0]
    assert scan.index[0] == "gain"
    assert set(scan.index) == {"a", "gain", "sigma"}  # and not the mean of the start
    assert first["p_value"] <= 0.01
    assert abs(first["time"] - 61) <= 8
    assert 0.5 < first["change"] < 1.5
    assert "gain varies: if it is one jump, it rises" in repr(scan)
    assert (scan["p_alone"] <= scan["p_value"]).all()
    # of a Brownian bridge the largest exceeds 1.36 with probability 5 %; of 100 rows it is lower
    assert 1.23 < scan.paths["band"].mean() < 1.40
    path = scan.paths["cumulated"].sel(parameter="gain")
    assert abs(path).max() > scan.paths["band"].sel(parameter="gain")
    turn = scan.paths["turn"].sel(parameter="gain")
    assert float(path["time"][turn]) == first["time"]
    assert path[turn] < 0  # before the jump the gain is below its estimate


def test_jumps_of_expected_sums_have_their_time_and_size():
    """Information grows by one a row; the sums of a jump, to first order, are a tent."""
    information = np.arange(40.0, 0.0, -1.0)
    for at, change in ((30, 0.7), (8, -0.2)):
        after = information[at]
        sums = change * np.minimum(information * (1 - after / 40), after * (1 - information / 40))
        found = Statistics(
            *np.zeros((2, 1)), sums[:, None], np.zeros((1, 1)), information[:, None], np.array([40])
        )
        assert _turns(found, 1) == [at]
        np.testing.assert_allclose(_changes(found, np.array([at])), [change])


def test_a_turn_is_where_a_jump_gains_most():
    """By R^2 / [A (1 - A / V)]: 64 / 0.09 of a tenth of the information, 100 / 0.25 of half."""
    information, sums = np.arange(40.0, 0.0, -1.0), np.zeros(40)
    sums[36], sums[20] = 8.0, 10.0
    found = Statistics(
        *np.zeros((2, 1)), sums[:, None], np.zeros((1, 1)), information[:, None], np.array([40])
    )
    assert _turns(found, 1) == [36]


def test_data_are_simulated_at_the_posterior_mode():
    """That of a prior beside which the data weigh little."""
    with pm.Model() as model:
        pm.Normal("a", 0.2, 0.01)
        pm.HalfNormal("sigma", 1.0)
        pm.Normal("gain", 0, 2)
        psf.StateSpace("d", driven(), psf.EKF(), steps=STEPS, inputs=FORCE, observed=simulated(1))
    variable = ScoredVariable(model, "d")
    start = np.array([0.4, np.log(0.3), 1.0])
    test = ConstancyTest(variable, TimeAxis.of(model, variable).durations, start)
    at = test.variable.labels.index("a")
    assert variable.theta(test.mode.x).reshape(-1, len(variable.labels))[0, at] == pytest.approx(
        0.2, abs=0.05
    )


def test_simulated_data_are_missing_and_unscored_as_the_data():
    observed = simulated(1)
    observed[[5, 30]] = np.nan
    variable = ScoredVariable(driven_model(observed, score_from=3), "d")
    drawn = variable.simulate(AT_TRUE, 2, np.random.default_rng(1))
    np.testing.assert_array_equal(np.isnan(drawn), np.isnan([observed[:, None]] * 2))
    terms = variable.terms(variable.theta(AT_TRUE[None])[[0, 0]], drawn)
    np.testing.assert_array_equal(np.flatnonzero(terms[0] == 0), [0, 1, 2, 5, 30])
    assert (drawn[0, 0] != drawn[1, 0]).all()


def test_draws_and_an_estimate_give_the_same():
    model = driven_model(simulated(2))
    draws = psf.sample_dram(200, tune=200, model=model, random_seed=1, progressbar=False)
    tables = [drift_scan(one, model, n_simulated=39, random_seed=3) for one in (draws, Point())]
    statistics = [table["statistic"].sort_index() for table in tables]
    np.testing.assert_allclose(*statistics, rtol=0.1, atol=0.1)


def test_the_record_of_a_panel_that_changes_is_named():
    records = [simulated(1), jumping(3, to=2.0), simulated(2)]
    observed = np.concatenate(records)
    observed[[5, 130]] = np.nan
    panel = np.repeat(["A", "B", "C"], N_ROWS)
    model = driven_model(observed, panel=panel, steps=np.tile(STEPS, 3), score_from=2)
    scan = drift_scan(Point(), model, n_simulated=99, random_seed=1)
    first = scan.iloc[0]
    assert (scan.index[0], first["record"]) == ("gain", "B")
    assert first["p_alone"] <= 0.01
    assert abs(first["time"] - 61) <= 8
    assert "in record 'B'" in repr(scan).replace("\n ", "")
    assert scan.paths.sizes["row"] == 3 * N_ROWS


def time_axis(model):
    return TimeAxis.of(model, ScoredVariable(model, "d"))


def test_times_of_a_panel_are_dates_since_the_start_of_each_record():
    dates = pd.to_datetime(["2024-01-03", "2024-01-05", "2025-03-02", "2025-03-03"])
    record = {"steps": None, "times": dates, "unit": "D", "t0": 1, "panel": ["A", "A", "B", "B"]}
    axis = time_axis(driven_model([0.1, 0.2, np.nan, 0.4], **record))
    np.testing.assert_array_equal(axis.shown, dates)
    np.testing.assert_allclose(axis.durations, [0, 2, 0, 1])
    assert axis.labels == ["A", "B"]


def test_times_of_a_panel_off_the_grid():
    times = [0.313, 0.511, 0.257]
    with pm.Model() as model:
        k = pm.LogNormal("k", 0, 1)
        psf.StateSpace(
            "d", DUFFING, psf.EKF(), panel=["A", "A", "B"], times=times, observed=np.zeros((3, 2)),
            params={"k": k, "c": 0.3, "s": 0.5, "b": 0.1, "r": 0.1, "m": 0.0, "v": 1.0},
        )  # fmt: skip
    axis = time_axis(model)
    np.testing.assert_allclose(axis.shown, times)
    np.testing.assert_allclose(axis.durations, [0.313, 0.198, 0.257])


def test_times_of_a_panel_whose_rows_are_data():
    with pm.Model() as model:
        gain = pm.Normal("gain", 0, 2)
        psf.StateSpace(
            "d", driven(), psf.EKF(), panel=pm.Data("panel", [3, 3, 7]), inputs=FORCE,
            steps=pm.Data("steps", [1, 4, 2]), observed=[0.1, 0.2, 0.3],
            params={"a": 0.7, "gain": gain, "sigma": 0.3},
        )  # fmt: skip
    axis = time_axis(model)
    np.testing.assert_allclose(axis.shown, [1, 4, 2])
    np.testing.assert_allclose(axis.durations, [1, 3, 2])
    assert axis.labels == [3, 7]


def test_chosen_parameters():
    model = driven_model(simulated(2))
    scan = drift_scan(Point(), model, parameters="gain", n_simulated=19, random_seed=1)
    assert list(scan.index) == ["gain"]
    assert scan["p_value"].iloc[0] == scan["p_alone"].iloc[0]
    # fixed at a number, of the sensor
    fixed = drift_scan(Point(), model, parameters=["sensor"], n_simulated=19, random_seed=1)
    assert list(fixed.index) == ["sensor"]


def test_bad_arguments():
    model = driven_model(simulated(2))
    with pytest.raises(ModelError, match=r"parameters must be some of \['a', .*got \['b'\]"):
        drift_scan(Point(), model, parameters=["b"])
    with pytest.raises(ModelError, match=r"after the start of a record, got \['start'\]"):
        drift_scan(Point(), model, parameters=["start"])
    with pytest.raises(ModelError, match="n_simulated must be an integer of at least 19, got 5"):
        drift_scan(Point(), model, n_simulated=5)
    with pytest.raises(ModelError, match="var_name"):
        drift_scan(Point(), model, var_name="y")
    with pytest.raises(ModelError, match="idata must be a DataTree"):
        drift_scan(1.0, model)
    noisy = driven_model(simulated(2), filter=psf.BootstrapPF(100))
    with pytest.raises(ModelError, match=r"must have a gradient.*BootstrapPF\(100\).*EKF"):
        drift_scan(Point(), noisy)


def test_one_that_varies_is_to_be_mended_before_others_are_believed():
    table = pd.DataFrame(
        {
            "p_value": [0.01, 0.02, 0.5],
            "p_alone": [0.01, 0.01, 0.4],
            "statistic": [49.7, 20.0, 0.1],
            "time": [61, 30, 5],
            "change": [-243.0, 0.0013, 1.0],
        },
        index=["level", "noise", "rate"],
    )
    _, first, second, advice = sentences(table, 99)
    assert first == "level varies: if it is one jump, it falls by about 240 before the row at 61."
    assert "noise varies: if it is one jump, it rises by about 0.0013" in second
    assert advice.startswith("Begin with level: ")
    assert len(sentences(table.iloc[1:], 99)) == 2
    # Equal p-values and statistics of about one size: either may be the one.
    _, first, _, advice = sentences(table.assign(statistic=[49.7, 45.7, 0.1]), 99)
    assert first.startswith("level may vary: ")
    assert advice.startswith("The scan cannot tell level and noise apart: ")
    table["time"] = pd.date_range("2024-05-01", periods=3, freq="30h")
    _, first, second, _ = sentences(table, 99)
    assert first.endswith("before the row at 2024-05-01.")
    assert second.endswith("before the row at 2024-05-02 06:00:00.")
    _, first, *_ = sentences(table.assign(time=[1234.3 + 0.2, 1.0, 2.0]), 99)
    assert first.endswith("before the row at 1234.5.")


def test_a_noise_at_zero_is_left_out_and_named():
    """A normal prior, and data without noise of the process: the mode is at zero, a saddle."""
    rng = np.random.default_rng(1)
    observed = 3 * 0.95 ** np.arange(1, 61) + 0.3 * rng.standard_normal(60)
    system = psf.StateSpaceModel(
        transition=lambda x, q, a, s: [a * x[0] + s * q[0]],
        process_noise=[[1.0]],
        observation=lambda x: [x[0]],
        observation_noise=[[0.09]],
        initial_mean=[3.0],
        initial_cov=[[0.1]],
    )
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.5)
        pm.Normal("s", 0.0, 1.0)
        psf.StateSpace("d", system, psf.EKF(), steps=range(1, 61), observed=observed)
    start = Point()
    start.unconstrained = np.array([0.95, 1e-10])
    scan = drift_scan(start, model, n_simulated=19, random_seed=1, progressbar=False)
    assert list(scan.index) == ["a"]
    assert np.isfinite(scan.paths["cumulated"]).all()
    assert "Left out: s. At the estimate" in repr(scan)
    with pytest.raises(ModelError, match="has an effect on the likelihood at the estimate"):
        drift_scan(start, model, parameters="s", n_simulated=19)
