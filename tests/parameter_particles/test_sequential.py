"""Sequential runs against the exact evidence after each row, and their extension."""

import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import kstest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.parameter_particles import output, sequential_run
from pymc_statespace_filters.parameter_particles.observed_rows import ObservedRows
from pymc_statespace_filters.parameter_particles.sequential_run import _variance
from pymc_statespace_filters.pymc_model.density import ModelDensity
from pymc_statespace_filters.pymc_model.posterior_draws import unconstrained_draws
from pymc_statespace_filters.smc.merging import merged_log_evidence
from pymc_statespace_filters.smc.particles import Populations
from tests.interrupts import interrupt
from tests.parameter_particles.autoregression import DATA, STEPS, exact, exact_transforms, model
from tests.systems import FORCED, FREE, counts, pair

FILTERS = [psf.EKF(), psf.BootstrapPF(6), psf.GuidedPF(6), psf.GridFilter()]
SETTINGS = {"data": "sequential", "random_seed": 2, "progressbar": False}


@pytest.fixture(scope="module")
def by_filter():
    """Runs over all rows: the noisier filter has its members doubled on the way."""
    return {filter: psf.sample_smc(100, model=model(filter), **SETTINGS) for filter in FILTERS}


@pytest.fixture(scope="module")
def run_of_rows():
    """A run of the first rows, and the same extended."""
    short = model(psf.EKF(), 9)
    first = psf.sample_smc(50, model=short, **SETTINGS)
    more = {"observed": DATA[9:12], "steps": STEPS[9:12], "progressbar": False}
    return {9: first, 12: psf.extend(first, short, **more)}


@pytest.mark.parametrize("filter", FILTERS)
def test_evidences_scores_and_posterior_are_exact(by_filter, filter):
    """At each of 24 rows within 4.5 errors, of 10 populations, of quadrature."""
    found, truth = by_filter[filter], exact()
    course = found["smc"].to_dataset()
    scores = np.diff(truth.path, prepend=0.0)
    assert (abs(course["score"] - scores) <= 4.5 * course["score_se"] + 1e-12).all()
    assert abs(found.attrs["log_evidence"] - truth.path[-1]) < 4 * found.attrs["log_evidence_se"]
    error = found["mcse"]["a"].item()
    assert abs(found["posterior"]["a"].mean().item() - truth.mean) < 4 * error < 0.2
    np.testing.assert_allclose(course["score"].sum(), found.attrs["log_evidence"])
    assert course["score"][7] == course["score_se"][7] == 0.0  # a missing row
    assert 0 < course["n_stages"].sum() < 24


@pytest.mark.usefixtures("interrupts_arrive")
def test_an_interrupt_keeps_the_rows_seen(run_of_rows, monkeypatch, caplog):
    """The result is that of a run of these rows alone, and goes on."""
    next_row, built = sequential_run._next_row, model(psf.EKF(), 12)

    def interrupted(progress, request):
        if progress.n_rows == 9:
            interrupt()
        return next_row(progress, request)

    with monkeypatch.context() as patch:
        patch.setattr(sequential_run, "_next_row", interrupted)
        found = psf.sample_smc(50, model=built, **SETTINGS)
    assert caplog.messages == [
        "The run was interrupted: the result knows 9 of 12 observations. psf.extend goes on from "
        "there."
    ]
    longer = psf.extend(found, built, observed=DATA[:12], steps=STEPS[:12], progressbar=False)
    for tree, expected in ((found, run_of_rows[9]), (longer, run_of_rows[12])):
        assert tree.attrs["log_evidence"] == expected.attrs["log_evidence"]
        for group in ("posterior", "smc", "observed_data"):
            assert tree[group].to_dataset().equals(expected[group].to_dataset())


@pytest.mark.parametrize("filter", FILTERS)
def test_transforms_are_exact(by_filter, filter):
    """A rank among 1000 draws has a deviation of .014 in the root mean square of all rows.

    23 rows are within 4.5 of them, but for chance once in 6000 tests.
    """
    found = by_filter[filter]["smc"]["pit"].sel(observable="y0").values
    assert np.isnan(found[7])
    np.testing.assert_allclose(found, exact_transforms(), atol=0.065)


@pytest.mark.filterwarnings("ignore:the log-evidence")  # few particles
def test_transforms_of_counts_are_uniform():
    """Parameters from the prior, data from the model: Kolmogorov's test, wrong once in 1000."""
    system, steps, pits = counts(level=0.5, noise_var=0.25), np.arange(1, 26), []
    for seed, a in enumerate(np.random.default_rng(5).uniform(size=4)):
        observed = psf.simulate(system, {"a": a}, steps=steps, random_seed=seed)["observations"]
        with pm.Model() as built:
            pm.Uniform("a")
            psf.StateSpace("d", system, psf.BootstrapPF(20), steps=steps, observed=observed)
        found = psf.sample_smc(
            40, model=built, data="sequential", populations=2, random_seed=seed, progressbar=False
        )
        pits.append(found["smc"]["pit"].values.ravel())
    assert kstest(np.concatenate(pits), "uniform").pvalue > 1e-3


def test_deviations_give_the_errors_of_any_sum_of_scores(by_filter):
    course = by_filter[psf.EKF()]["smc"].to_dataset()
    sums = course["score_deviation"].cumsum("row")
    _, errors = merged_log_evidence(course["log_evidence_so_far"].values)
    np.testing.assert_allclose((sums**2).sum("population") ** 0.5, errors)
    squares = (course["score_deviation"] ** 2).sum("population")
    np.testing.assert_allclose(squares**0.5, course["score_se"])


def test_members_are_doubled_and_the_stored_estimates_are_theirs(by_filter):
    found = by_filter[psf.BootstrapPF(6)]
    course = found["smc"].to_dataset()
    n_members = int(course["n_members"][-1])
    assert n_members > 6
    doubled = np.diff(course["n_members"], prepend=6) > 0
    np.testing.assert_array_equal(doubled, course["variance"] > 2)
    assert f"BootstrapPF({n_members})" in found.attrs["filter"]
    built = model(psf.BootstrapPF(n_members))
    x = unconstrained_draws(found, built).reshape(-1, 1)
    stats = found["sample_stats"]
    recomputed = ModelDensity(built).evaluate(x, stats["d_seed"].values.reshape(-1, 1))
    np.testing.assert_allclose(stats["lp"].values.ravel(), recomputed, rtol=1e-9)


@pytest.mark.filterwarnings("ignore:the log-evidence")  # few particles
def test_every_update_of_a_filter_is_counted(monkeypatch):
    """Those of moves, of the variance at fixed parameters and of doubled members too."""
    filtered, made = ObservedRows.filtered, []

    def counted(rows, x, seeds, states, begin, end):
        made.append(len(x) * (end - begin))
        return filtered(rows, x, seeds, states, begin, end)

    monkeypatch.setattr(ObservedRows, "filtered", counted)
    found = psf.sample_smc(
        20, model=model(psf.BootstrapPF(6), 12), data="sequential", populations=2, random_seed=2,
        progressbar=False, compute_convergence_checks=False,
    )["smc"]  # fmt: skip
    assert found["n_members"][-1] > 6
    assert found["n_updates"].sum() == sum(made)


def test_members_are_judged_by_the_variance_at_fixed_parameters():
    """Not by that over parameters, which is larger."""
    rows, rng = ObservedRows.of(model(psf.BootstrapPF(50), 5)), np.random.default_rng(1)
    a = np.linspace(-1.5, 1.5, 8)[:, None]
    pilot = Populations.of_equal_weights(rows.drawn(8, rng)._replace(x=a), 1)
    values = rows.estimated(np.repeat(a, 100, axis=0), 5, rng)[0].reshape(8, 100)
    expected = values.var(axis=1, ddof=1).mean()
    assert values.mean(axis=1).var(ddof=1) > 4 * expected
    assert 0.5 < _variance(rows, pilot, 5, rng) / expected < 2  # of 8 times 8 estimates


def test_states_and_forecasts_follow_from_the_draws(by_filter):
    found, built = by_filter[psf.EKF()].copy(), model(psf.EKF())
    ahead = psf.forecast(found, built, n_steps=2, n_draws=20, random_seed=1, progressbar=False)
    assert ahead["predictions"]["d"].sizes["d_time"] == 2


@pytest.mark.parametrize(
    "of_draws",
    [
        lambda *of: psf.forecast(*of, n_steps=2, random_seed=1, progressbar=False),
        lambda *of: psf.filtered_states(*of, random_seed=1, progressbar=False),
        lambda *of: psf.estimate_evidence(*of, random_seed=1, progressbar=False),
        lambda *of: psf.check_filter(*of, random_seed=1, progressbar=False),
    ],
)
@pytest.mark.parametrize(
    ("n_seen", "n_own", "message"),
    [
        (12, 9, "made with 11 rows that are not missing, and the model has 8: build the model"),
        (9, 12, "made with 8 rows that are not missing, and the model has 11: go on .* psf.extend"),
    ],
)
def test_a_model_of_other_rows_is_refused(run_of_rows, of_draws, n_seen, n_own, message):
    with pytest.raises(DataMismatchError, match=message):
        of_draws(run_of_rows[n_seen], model(psf.EKF(), n_own))


def test_a_model_of_the_same_or_of_other_values(run_of_rows):
    """Rows that are left out are as good as missing ones."""
    keep = ~np.isnan(DATA[:9, 0])
    same = model(psf.EKF(), steps=STEPS[:9][keep], observed=DATA[:9][keep])
    psf.filtered_states(run_of_rows[9], same, n_draws=2, random_seed=1, progressbar=False)
    other = model(psf.EKF(), 9, observed=DATA[:9] + 1)
    with pytest.raises(DataMismatchError, match="the model has other values in them: build"):
        psf.filtered_states(run_of_rows[9], other, random_seed=1)


@pytest.mark.filterwarnings("ignore:the log-evidence")  # few particles
@pytest.mark.parametrize("filter", FILTERS)
def test_a_run_that_is_extended_is_one_run(filter, tmp_path):
    """Also where members are doubled in each part."""
    whole, first = (
        psf.sample_smc(40, model=model(filter, n), populations=3, **SETTINGS) for n in (24, 9)
    )
    first.to_netcdf(tmp_path / "run.nc")
    first = xr.load_datatree(tmp_path / "run.nc")
    # Rows that were seen may come again.
    longer = psf.extend(
        first, model(filter, 9), observed=DATA[5:15], steps=STEPS[5:15], progressbar=False
    )
    longer = psf.extend(
        longer, model(filter), observed=DATA[15:], steps=STEPS[15:], progressbar=False
    )
    if filter == psf.BootstrapPF(6):
        assert 6 < first["smc"]["n_members"][-1] < whole["smc"]["n_members"][-1]
    assert longer.attrs == whole.attrs
    for name in whole.children:
        if name != "predictions":
            assert longer[name].to_dataset().equals(whole[name].to_dataset())


def _leaking(**settings):
    """Counts what has left between two rows; steps of any length, or of a grid."""
    system = psf.StateSpaceModel(
        psf.EulerMaruyama(
            lambda x, k: [-k * x[0], k * x[0]], lambda: [[0.2, 0.0], [0.0, 0.01]], dt=0.5
        ),
        observation=lambda x: [x[1]],
        observation_noise=[[0.05]],
        initial_mean=[1.0, 0.0],
        initial_cov=[[0.1, 0.0], [0.0, 0.001]],
        accumulators=["x1"],
    )
    with pm.Model() as built:
        pm.HalfNormal("k", 2)
        psf.StateSpace("d", system, psf.EKF(), **settings)
    return built


def _forced(**settings):
    with pm.Model() as built:
        pm.Normal("a", 0, 1)
        psf.StateSpace("d", FORCED, psf.EKF(), **settings)
    return built


OFF_GRID = np.array([0.4, 1.1, 1.3, 2.9, 3.0, 4.2, 5.1])
DATES = np.datetime64("2024-01-01") + np.array([0, 2, 3, 7, 8, 12, 13]).astype("m8[D]")
FORCE = np.sin(np.arange(20.0))
RECORDS = {
    "off the grid": (_leaking, {"times": OFF_GRID}, {}),
    "dates": (_leaking, {"times": DATES}, {"unit": "D"}),
    "accumulated": (_leaking, {"steps": np.arange(2, 16, 2)}, {}),
    "with inputs": (_forced, {"steps": np.arange(2, 16, 2)}, {"inputs": FORCE}),
}


@pytest.mark.filterwarnings("ignore:the log-evidence")  # few particles
@pytest.mark.parametrize("record", list(RECORDS))
def test_records_with_times_and_inputs_go_on(record):
    build, at, others = RECORDS[record]
    (name, when), y = next(iter(at.items())), DATA[8:15]
    settings = SETTINGS | {"draws": 30, "populations": 2}
    whole = psf.sample_smc(model=build(observed=y, **at, **others), **settings)
    short = build(observed=y[:4], **{name: when[:4]}, **others)
    first = psf.sample_smc(model=short, **settings)
    more = {key: value for key, value in others.items() if key == "inputs"}
    longer = psf.extend(first, short, observed=y[4:], **{name: when[4:]}, **more, progressbar=False)
    assert longer["observed_data"].to_dataset().equals(whole["observed_data"].to_dataset())
    assert longer["posterior"].to_dataset().equals(whole["posterior"].to_dataset())
    assert longer["evidence"].to_dataset().equals(whole["evidence"].to_dataset())


def test_an_extension_that_disagrees_is_refused(by_filter):
    found, built = by_filter[psf.EKF()], model(psf.EKF())

    def refused(error, match, of=built, **arguments):
        with pytest.raises(error, match=match):
            psf.extend(found, of, progressbar=False, **arguments)

    refused(DataMismatchError, r"observed\[0\] = \[9.0\] disagrees", observed=[9.0], steps=[3])
    refused(DataMismatchError, r"steps\[0\] = 0 lies before", observed=[9.0], steps=[0])
    seen = {"observed": DATA[-2:], "steps": STEPS[-2:]}
    refused(ModelError, "go on after the last row seen", **seen)
    refused(ModelError, "observed brings no dates: give steps or times", observed=[9.0])
    new = {"observed": [9.0], "steps": [30]}
    refused(DataMismatchError, "model must be that of idata", of=model(psf.UKF()), **new)
    with pm.Model() as other:
        pm.Normal("a", 0, 1)
        psf.StateSpace("d", FREE, psf.EKF(), steps=STEPS, observed=DATA)
    refused(DataMismatchError, "model must be that of idata", of=other, **new)
    tempered = psf.sample_smc(50, model=built, populations=2, random_seed=1, progressbar=False)
    with pytest.raises(ModelError, match="idata must have the group 'smc_state'"):
        psf.extend(tempered, built, **new)


WEEKS = pd.date_range("2024-01-07", periods=6, freq="W", tz="Asia/Tokyo")


def _weekly(begin, end):
    series = pd.Series(DATA[8:14, 0], index=WEEKS)[begin:end]
    return series, model(psf.EKF(), steps=None, observed=series, unit="W")


@pytest.mark.filterwarnings("ignore:the log-evidence")  # few particles
def test_dates_count_from_the_origin_of_the_run():
    settings = SETTINGS | {"draws": 20, "populations": 2}
    first = psf.sample_smc(model=_weekly(0, 4)[1], **settings)
    whole = psf.sample_smc(model=_weekly(0, 6)[1], **settings)
    later, window = _weekly(3, 6)
    longer = psf.extend(first, window, observed=later, progressbar=False)
    assert longer["posterior"].to_dataset().equals(whole["posterior"].to_dataset())
    assert longer["smc"].to_dataset().equals(whole["smc"].to_dataset())
    assert longer["smc_state"]["record_steps"].values.tolist() == list(range(6))
    with pytest.raises(ModelError, match="times must have a time zone"):
        psf.extend(first, window, observed=later.tz_localize(None), progressbar=False)


@pytest.mark.filterwarnings("ignore:the log-evidence")  # few particles
def test_values_of_data_are_part_of_the_model():
    with pm.Model() as built:
        scale = pm.Data("scale", 2.0)
        pm.Normal("a", 0, scale)
        psf.StateSpace("d", FREE, psf.EKF(), steps=STEPS[:3], observed=DATA[:3])
    first = psf.sample_smc(model=built, **SETTINGS | {"draws": 20, "populations": 2})
    new = {"observed": DATA[3:4], "steps": STEPS[3:4], "progressbar": False}
    psf.extend(first, built, **new)
    scale.set_value(3.0)
    with pytest.raises(DataMismatchError, match=r"values of pm\.Data are others"):
        psf.extend(first, built, **new)


@pytest.mark.filterwarnings("ignore:the log-evidence")  # few particles
def test_a_row_that_is_impossible_is_named():
    built = model(psf.EKF(), 3)
    first = psf.sample_smc(model=built, **SETTINGS | {"draws": 20, "populations": 2})
    with pytest.raises(ModelError, match=r"observed\[3\] = \[1e\+200\] at 4.* above zero at 0 of"):
        psf.extend(first, built, observed=[1e200], steps=[4], progressbar=False)


def test_data_that_do_not_come_row_by_row_are_refused():
    def refused(match, build):
        with pytest.raises(ModelError, match=rf"data='sequential' needs .*{match}"):
            psf.sample_smc(20, model=build, **SETTINGS)

    refused("score_from=0", model(psf.BootstrapPF(20), score_from=2))
    with model(psf.EKF()) as two:
        psf.StateSpace("e", FREE, psf.EKF(), steps=STEPS, observed=DATA)
    refused(r"got \['d', 'e'\]", two)
    with model(psf.EKF()) as bent:
        pm.Potential("bent", -(bent["a"] ** 4))
    refused(r"got \['d', 'bent'\]", bent)
    refused("got a panel in 'd'", model(psf.EKF(), panel=np.repeat([0, 1], 12)))
    with pm.Model() as moving:
        a = pm.Normal("a")
        psf.StateSpace(
            "d", FORCED, psf.EKF(), steps=STEPS, observed=DATA, inputs=a * np.ones((24, 1))
        )
    refused("inputs that do not depend", moving)


def test_doubts_of_the_evidence_point_at_the_call(monkeypatch):
    monkeypatch.setattr(output, "MAX_SPREAD", 0.0)
    built, more = model(psf.EKF(), 3), {"observed": DATA[3:4], "steps": STEPS[3:4]}
    settings = SETTINGS | {"draws": 20, "populations": 2, "model": built}

    def warned(call, *arguments, **named):
        with pytest.warns(psf.errors.EvidenceWarning, match="a few of them decide") as caught:
            found = call(*arguments, **named)
        assert [one.filename for one in caught] == [__file__]
        return found

    first = warned(psf.sample_smc, **settings)
    warned(psf.extend, first, built, progressbar=False, **more)
    warned(psf.sample_smc, **settings | {"data": "tempered"})


def test_a_score_counts_from_a_row_on():
    """The evidence is then p(d_3 .. d_J | d_1, d_2, prior), as in the model's log-density."""
    built = model(psf.EKF(), score_from=2)
    both = [
        psf.sample_smc(100, model=built, **SETTINGS | {"data": data})
        for data in ("tempered", "sequential")
    ]
    one, other = (found.attrs for found in both)
    error = np.hypot(one["log_evidence_se"], other["log_evidence_se"])
    assert abs(one["log_evidence"] - other["log_evidence"]) < 4 * error < 1.0
    assert (both[1]["smc"]["score"][:2] == 0).all()
    assert np.isnan(both[1]["smc"]["pit"][:4, 0]).values.tolist() == [True, True, False, False]


def test_a_filter_that_has_failed_at_a_row_without_a_score_has_failed():
    rows = ObservedRows.of(model(psf.EKF(), score_from=1))
    terms, states = np.array([[-np.inf, -1.0], [-2.0, np.nan]]), np.zeros((2, 1))
    rows.__dict__["_run"] = lambda *arguments: (terms, states)
    found, _ = rows.filtered(np.zeros((2, 1)), np.empty((2, 0), int), states, 0, 2)
    np.testing.assert_array_equal(found, [[-np.inf, -1.0], [0.0, -np.inf]])


def test_several_parameters_and_observables():
    with pm.Model() as built:
        pm.Normal("a", 0.5, 0.5)
        pm.Normal("b", 0, 0.5)
        record = psf.simulate(pair(), {"a": 0.5}, steps=STEPS, random_seed=3)["observations"]
        psf.StateSpace("d", pair(), psf.EKF(), steps=STEPS, observed=record)
    found = [
        psf.sample_smc(100, model=built, **SETTINGS | {"data": data}).attrs
        for data in ("tempered", "sequential")
    ]
    error = np.hypot(*(one["log_evidence_se"] for one in found))
    assert abs(found[0]["log_evidence"] - found[1]["log_evidence"]) < 4 * error < 1.0
