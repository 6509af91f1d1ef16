"""suggest_particles on real models: the number it suggests does what it says."""

import warnings

import numpy as np
import pymc as pm
import pytensor
import pytest
from scipy.optimize import minimize

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import FilterWarning, ModelError
from pymc_statespace_filters.sampling.output.likelihood_variance import SeedSpread
from pymc_statespace_filters.sampling.particle_number import suggest as particle_budget
from pymc_statespace_filters.sampling.particle_number.effort import Effort, OutOfTimeError
from pymc_statespace_filters.sampling.particle_number.noisy_likelihood import NoisyLikelihood
from pymc_statespace_filters.sampling.particle_number.search import Row
from pymc_statespace_filters.sampling.target.variables import RaveledVariables
from tests.systems import autoregression, log_likelihoods, simulated
from tests.test_readme import run_code_of

pytestmark = pytest.mark.usefixtures("interpreted")

STEPS = np.arange(1, 61)
LINEAR = autoregression(observation_noise=0.2)
TRUTH = {"phi": 0.8, "spread": 0.7}
DATA = simulated(STEPS, 5, **TRUTH, observation_noise=0.2)


def linear_model(filter):
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 0.5)
        pm.HalfNormal("spread", 1.0)
        psf.StateSpace("d", LINEAR, filter, steps=STEPS, observed=DATA)
    return model


def exact_mode():
    """Parameters at the highest exact density on the unconstrained space."""
    model = linear_model(psf.EKF())
    point = model.initial_point()
    raveled, logp = RaveledVariables(model.value_vars, point), model.compile_logp()
    best = minimize(
        lambda x: -logp(raveled.unravel(x)), raveled.ravel(point), method="Nelder-Mead"
    ).x
    return {"phi": best[0], "spread": np.exp(best[1])}


def measured_variance(filter, params, n_seeds=600):
    seeds = np.arange(10_000, 10_000 + n_seeds)
    return log_likelihoods(LINEAR, filter, params, seeds, observed=DATA, steps=STEPS).var(ddof=1)


@pytest.mark.parametrize("first", [25, pytest.param(2000, marks=pytest.mark.slow)])
def test_the_suggestion_is_in_the_target_at_the_exact_mode(first):
    """Fresh seeds; the variance of the estimates has errors of some 10 % on either side."""
    table = psf.suggest_particles(linear_model(psf.BootstrapPF(first)), random_seed=1)
    suggested = table.attrs["n_particles"]
    variance = measured_variance(psf.BootstrapPF(suggested), exact_mode())
    assert 1.0 < variance < 3.3
    assert first in table.index
    assert list(table.index) == sorted(set(table.index))
    assert table.index.name == "n_particles"
    assert list(table.index[table["suggested"]]) == [suggested]
    row = table.loc[suggested]
    assert row["variance_low"] < variance < row["variance_high"] or (
        abs(np.log(variance / row["variance_centre"])) < 0.5
    )
    assert row["variance_tail"] > 0.0
    assert (table["seconds"] > 0.0).all()
    assert (table["n_failed"] == 0).all()


def at_initial_point(monkeypatch, model):
    """No pilot: the point at which a model begins is the centre and the tail."""
    point = model.initial_point()
    centre = RaveledVariables(model.value_vars, point).ravel(point)
    monkeypatch.setattr(NoisyLikelihood, "points", lambda self: (centre, [centre]))


def test_a_panel_is_tuned_on_its_noisiest_record_unless_parameters_are_shared(monkeypatch):
    """Six like records; the last has no observation but one, and hardly any noise."""
    n, rows = 6, np.tile(STEPS[:10], 6)
    labels = np.repeat(np.arange(n), 10)
    observed = np.tile(DATA[:10], n)
    observed[-9:] = np.nan
    found = {}
    for name in ("own", "shared"):
        with pm.Model() as model:
            pm.Normal("phi", 0.8, 0.2, shape=n)
            spread = 0.7 if name == "own" else pm.TruncatedNormal("s", 0.7, 0.01, lower=0.1)
            psf.StateSpace(
                "d",
                LINEAR,
                psf.BootstrapPF(20),
                panel=labels,
                steps=rows,
                observed=observed,
                params={"spread": spread},
            )
        at_initial_point(monkeypatch, model)
        table = psf.suggest_particles(model, random_seed=1, progressbar=False)
        found[name] = table.loc[20, "variance_centre"], table.attrs["n_particles"]
    assert 3.0 < found["shared"][0] / found["own"][0] < 7.0  # five noisy records
    assert found["shared"][1] > 2.5 * found["own"][1]


def two_records(a, b):
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 0.5)
        pm.HalfNormal("spread", 1.0)
        psf.StateSpace("a", LINEAR, a, steps=STEPS[:20], observed=DATA[:20], seed=1)
        psf.StateSpace("b", LINEAR, b, steps=STEPS[:20], observed=DATA[:20], seed=2)
    return model


def test_one_of_two_noisy_variables_is_tuned_on_its_own_noise():
    """The spread is to the rounding what it is where the other variable has no noise."""
    few, at = psf.BootstrapPF(4), np.array([0.6, -0.2])
    spreads = [
        NoisyLikelihood(model, "a", np.random.default_rng(1), Effort(60.0)).spread(30, at, 40)
        for model in (two_records(few, few), two_records(few, psf.EKF()))
    ]
    np.testing.assert_allclose(spreads[0].variance, spreads[1].variance, rtol=1e-9)
    assert spreads[0].mean != spreads[1].mean
    with pytest.raises(
        ModelError, match=r"var_name must be one of 'a', 'b', as several variables are noisy"
    ):
        psf.suggest_particles(two_records(few, few))


@pytest.mark.slow
def test_the_table_is_a_function_of_the_seed():
    model = linear_model(psf.BootstrapPF(50))
    one, same, other = (
        psf.suggest_particles(model, random_seed=seed).drop(columns="seconds") for seed in (3, 3, 4)
    )
    assert one.equals(same)
    assert not one.equals(other)


def test_models_without_noise_have_nothing_to_tune():
    with pytest.raises(
        ModelError, match=r"must have a StateSpace variable with a noisy likelihood"
    ):
        psf.suggest_particles(linear_model(psf.EKF()))
    with pm.Model() as model:
        pm.Normal("x")
    with pytest.raises(
        ModelError, match=r"must have a StateSpace variable with a noisy likelihood"
    ):
        psf.suggest_particles(model)


def test_other_bad_arguments():
    model = linear_model(psf.BootstrapPF(20))
    with pytest.raises(ModelError, match=r"var_name must be .* noisy filter, 'd', got 'phi'"):
        psf.suggest_particles(model, var_name="phi")
    with pytest.raises(ModelError, match=r"model must be a pymc.Model, got 'd'"):
        psf.suggest_particles("d")
    with pytest.raises(ModelError, match=r"random_seed must be .* got 'x'"):
        psf.suggest_particles(model, random_seed="x")
    with pm.Model() as fixed:
        psf.StateSpace("d", LINEAR, psf.EnKF(20), params=TRUTH, steps=STEPS, observed=DATA)
    with pytest.raises(ModelError, match=r"at least one free variable"):
        psf.suggest_particles(fixed)


def test_a_reading_is_a_warning_and_the_table_is_there(monkeypatch):
    noisy = SeedSpread(100, -1.0, 40.0, 30.0, 50.0, 0)
    rows = [Row(20, noisy, np.nan, 3, 1e-3), Row(200, noisy, np.nan, 1, 1e-2)]
    monkeypatch.setattr(NoisyLikelihood, "points", lambda self: (None, []))
    monkeypatch.setattr(particle_budget, "search", lambda measure, first, target: rows)
    with pytest.warns(FilterWarning, match=r"d: the variance .* does not decrease to 3.3"):
        table = psf.suggest_particles(linear_model(psf.BootstrapPF(20)))
    assert table.attrs == {"n_particles": 200, "extrapolated": False, "noisiest": {}}
    assert list(table["suggested"]) == [False, True]
    assert list(table["n_failed"]) == [3, 1]


SURPRISES = {20: 7.0, 41: -8.0}  # additions to two rows


def surprising_model(filter=None):
    """Two rows far from the prediction, where few of the particles are."""
    data = DATA.copy()
    for row, shift in SURPRISES.items():
        data[row] += shift
    with pm.Model() as model:
        pm.Normal("phi", 0.8, 0.05)
        psf.StateSpace(
            "d",
            LINEAR,
            filter or psf.BootstrapPF(20),
            params={"phi": model["phi"], "spread": 0.7},
            steps=STEPS,
            observed=data,
        )
    return model


def with_points(monkeypatch, *points):
    """No pilot: these points (1,) are the centre and the tail."""
    first, *tail = (np.array([x]) for x in points)
    monkeypatch.setattr(NoisyLikelihood, "points", lambda self: (first, tail))


def after_evaluations(monkeypatch, n, reason):
    """Raise when a result is there and n more evaluations have been made."""
    made = []

    def advance(self, count):
        made.extend([None] * (count if self.is_limited else 0))
        if len(made) > n:
            raise reason

    monkeypatch.setattr(Effort, "advance", advance)


@pytest.mark.parametrize(
    ("reason", "words"),
    [(OutOfTimeError(), "stopped after max_seconds=180"), (KeyboardInterrupt(), "interrupted")],
)
def test_a_search_that_is_stopped_gives_what_it_knows(monkeypatch, reason, words):
    with_points(monkeypatch, 0.8)
    after_evaluations(monkeypatch, 10, reason)
    model = surprising_model()
    with pytest.warns(FilterWarning, match=f"d: {words}, with one number .* to 1/N") as caught:
        table = psf.suggest_particles(model, random_seed=1, progressbar=False)
    assert list(table.index) == [20]
    assert not table["suggested"].any()
    ratio = table.attrs["n_particles"] / 20
    assert ratio == pytest.approx(table["variance_centre"].iloc[0] / (3.3 / 1.2**2), rel=0.2)
    assert table.attrs["extrapolated"]
    assert "the largest shares of the variance are" in str(caught[0].message)
    assert set(table.attrs["noisiest"]) <= set(SURPRISES)
    assert sum(table.attrs["noisiest"].values()) > 0.5


def test_an_interrupt_before_the_first_result_is_one(monkeypatch):
    def points(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(NoisyLikelihood, "points", points)
    with pytest.raises(KeyboardInterrupt):
        psf.suggest_particles(surprising_model(), random_seed=1)


def test_a_filter_is_named_if_it_has_been_seen_to_cope(monkeypatch):
    """The search ends at the largest number, 16 000; on this linear system an EKF is exact."""
    with_points(monkeypatch, 0.8)
    noisy = SeedSpread(100, -1.0, 40.0, 30.0, 50.0, 0)

    def search(measure, first, target):
        return [measure(first)._replace(centre=noisy)]

    monkeypatch.setattr(particle_budget, "search", search)
    with pytest.warns(FilterWarning, match=r"41 \(.* %\).*EKF\(\) computes .* without noise"):
        psf.suggest_particles(surprising_model(), random_seed=1, progressbar=False)


def test_a_noisy_pilot_is_repeated_by_a_filter_of_the_same_posterior(monkeypatch):
    model, used = surprising_model(), []
    pilot = NoisyLikelihood._pilot

    def watched(self, filter, start, share):
        used.append(filter)
        return pilot(self, filter, start, share)

    monkeypatch.setattr(NoisyLikelihood, "_pilot", watched)
    likelihood = NoisyLikelihood(model, None, np.random.default_rng(1), Effort(600.0))
    centre, _ = likelihood.points()
    assert used == [psf.BootstrapPF(200), psf.EKF()]
    exact = surprising_model(psf.EKF()).compile_logp()
    grid = np.linspace(0.6, 1.0, 401)
    best = grid[np.argmax([exact({"phi": x}) for x in grid])]
    assert centre[0] == pytest.approx(best, abs=0.01)


def test_the_pilot_keeps_to_its_share_of_the_limit():
    """With no time at all: 25 iterations or a few more, of 500."""
    effort = Effort(1e-9)
    likelihood = NoisyLikelihood(surprising_model(), None, np.random.default_rng(1), effort)
    pilot = likelihood._pilot(psf.BootstrapPF(2000), np.array([0.8]), 0.25)
    assert 25 <= pilot.n_iterations < 500
    assert not pilot.is_complete
    assert len(pilot.positions) > 0


def test_the_bar_begins_with_the_call_and_names_the_work(monkeypatch):
    shown = []

    class Bar:
        __enter__ = __exit__ = lambda self, *_: self

        def add_task(self, task, completed, total):
            shown.append([task, completed, total])
            return 0

        def advance(self, row, advance):
            shown[-1][1] += advance

    monkeypatch.setattr("pymc_statespace_filters.progress.create_simple_progress", Bar)
    with_points(monkeypatch, 0.8, 0.7)
    monkeypatch.setattr(particle_budget, "search", lambda measure, first, target: [measure(3000)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FilterWarning)
        psf.suggest_particles(linear_model_of_phi(), random_seed=1)
    compiled, measured = shown[:2]
    assert compiled == ["Compiling BootstrapPF, 3000 particles", 1, 1]
    assert measured == ["3000 particles", 25, 25]


def linear_model_of_phi():
    with pm.Model() as model:
        phi = pm.Normal("phi", 0.5, 0.5)
        params = {"phi": phi, "spread": 0.7}
        psf.StateSpace("d", LINEAR, psf.BootstrapPF(20), params=params, steps=STEPS, observed=DATA)
    return model


def test_estimates_that_are_off_whatever_their_variance_are_doubted(monkeypatch):
    """The sensor loses the sign, which an ensemble of normal members does not."""
    monkeypatch.setattr(particle_budget, "search", lambda measure, first, target: [measure(60)])
    squared = autoregression(spread=1.0, observation=lambda x: [x[0] ** 2])
    steps = STEPS[:30]
    observed = simulated(steps, 5, phi=0.9, spread=1.0, observation_noise=0.0) ** 2
    with pm.Model() as model:
        pm.Uniform("phi")
        params = {"observation_noise": 0.1}
        settings = {"steps": steps, "observed": observed, "params": params}
        psf.StateSpace("d", squared, psf.EnKF(60), **settings)
    with pytest.warns(FilterWarning, match=r"d: .*EnKF\(\d+\) is .* nats .*Use ") as caught:
        psf.suggest_particles(model, random_seed=1, progressbar=False)
    assert len(caught) == 1


@pytest.mark.slow
def test_a_variance_that_stays_warns_and_leaves_a_table():
    """A precise sensor far from where the particles start: one of them decides at once."""
    system = autoregression(spread=1e-2, observation_noise=1e-8)
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 0.5)
        psf.StateSpace("d", system, psf.BootstrapPF(10), steps=[1, 2, 3], observed=[3.0, -2.0, 4.0])
    with pytest.warns(FilterWarning, match=r"d: the variance .* does not decrease to 3.3"):
        table = psf.suggest_particles(model, random_seed=1)
    assert table.attrs["n_particles"] == table.index[-1]
    assert table["variance_centre"].iloc[-1] > 3.3


@pytest.mark.slow
def test_ensemble_filters_are_tuned_too():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FilterWarning)
        for filter in (psf.EnKF(40), psf.PFEnKF(40)):
            table = psf.suggest_particles(linear_model(filter), random_seed=2)
            assert 40 in table.index
            assert np.isfinite(table["variance_centre"]).all()


def short_run_by(sample):
    """The sampler with fewer draws than it is asked for."""

    def short_run(*draws, tune=50, **settings):
        return sample(100, tune=100, **settings)

    return short_run


def test_the_pages_on_sampling_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # one writes a checkpoint
    for module, name in ((psf, "sample"), (psf, "sample_dram"), (pm, "sample")):
        monkeypatch.setattr(module, name, short_run_by(getattr(module, name)))
    with pytensor.config.change_flags(mode="NUMBA"):
        names = run_code_of("docs/howto/sampling.md", "docs/explanation/noisy-likelihoods.md")
    table = names["table"]
    assert 1.0 < table.loc[table.attrs["n_particles"], "variance_centre"] < 3.3
    assert (tmp_path / "first-run").is_dir()
