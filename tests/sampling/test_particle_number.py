"""suggest_particles: the number that it suggests does what it says, or it names none."""

import arviz as az
import numpy as np
import pymc as pm
import pytensor
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import DataMismatchError, FilterWarning, ModelError
from pymc_statespace_filters.sampling.particle_number import (
    _Measured,
    _second_number,
    _suggestion,
)
from tests.systems import autoregression, log_likelihoods, simulated
from tests.test_public_names import run_code_of

pytestmark = pytest.mark.usefixtures("interpreted")

STEPS = np.arange(1, 61)
LINEAR = autoregression(observation_noise=0.2)
TRUTH = {"phi": 0.8, "spread": 0.7}
DATA = simulated(STEPS, 5, **TRUTH, observation_noise=0.2)
# Thirty draws near the posterior.
DRAWS = az.from_dict(
    {
        "posterior": {
            "phi": np.linspace(0.7, 0.9, 30)[None],
            "spread": np.linspace(0.75, 0.65, 30)[None],
        }
    }
)


def model_of(filter, observed=DATA):
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 0.5)
        pm.HalfNormal("spread", 1.0)
        psf.StateSpace("d", LINEAR, filter, steps=STEPS[: len(observed)], observed=observed)
    return model


def suggested(law, first, low=1.0, high=3.3):
    """The suggestion where the variance is law(N), measured without error."""
    measured = _Measured(first, law(first))
    n = _second_number(measured, low, high)
    return _suggestion(measured, _Measured(n, law(n)), low, high)


@pytest.mark.parametrize("first", [10, 250, 5000])
@pytest.mark.parametrize("scale", [25.0, 300.0, 2900.0, 90_000.0])
@pytest.mark.parametrize("band", [(1.0, 3.3), (0.2, 0.5), (3.0, 9.0)])
def test_the_variance_of_the_suggestion_is_in_the_target_where_it_falls_as_the_inverse(
    scale, first, band
):
    n_particles, reason = suggested(lambda n: scale / n, first, *band)
    assert band[0] <= scale / n_particles <= band[1] or (n_particles == 10 and scale / 10 < band[0])
    assert reason.startswith(f"the variance is {scale / first:.2g} with {first} particles")


def test_errors_of_measurement_leave_the_suggestion_in_the_target():
    """Of a fifth, in 1000 searches: the variance is out of it by half in 1 % at most."""
    rng = np.random.default_rng(1)
    scales = np.exp(rng.uniform(np.log(250.0), np.log(2e4), 1000))
    found = [suggested(lambda n, a=a: a / n * np.exp(0.2 * rng.normal()), 500)[0] for a in scales]
    true = scales / np.array(found, dtype=float)  # NaN where none is named
    assert np.mean((true > 1.0 / 1.5) & (true < 3.3 * 1.5)) > 0.99


@pytest.mark.parametrize("law", [lambda n: 30.0 + 100.0 / n, lambda n: 5000.0 / n**0.5])
def test_no_number_is_named_if_the_variance_falls_too_slowly(law):
    n_particles, reason = suggested(law, 100)
    assert n_particles is None
    assert "collapse" in reason


def test_a_law_of_another_power_is_interpolated():
    n_particles, reason = suggested(lambda n: (900.0 / n) ** 3, 200)
    assert 1.0 < (900.0 / n_particles) ** 3 < 3.3
    assert reason == (
        "the variance is 91 with 200 particles and 0.022 with 3200 particles; it should be about "
        "1.8 with 740"
    )


def test_where_estimates_fail():
    """With few particles, with all numbers tried, and without noise."""
    assert suggested(lambda n: np.inf if n < 300 else 800.0 / n, 20)[0] == 320
    assert suggested(lambda n: np.inf if n < 300 else 100.0 / n, 400)[0] == 400
    assert suggested(lambda n: np.inf, 400)[0] is None
    assert suggested(lambda n: 0.0, 1000) == (
        10,
        "the variance is 0 with 1000 particles and 0 with 62 particles; 10 are the fewest",
    )


def exact_draws(n):
    """Parameters of the exact posterior, n of the points of a fine grid."""
    grid = np.meshgrid(np.linspace(0.0, 1.5, 151), np.linspace(0.02, 2.0, 100), indexing="ij")
    params = {"phi": grid[0].ravel(), "spread": grid[1].ravel()}
    log_p = psf.log_likelihood(LINEAR, psf.EKF(), params, DATA, steps=STEPS).sum(axis=-1)
    log_p -= 0.5 * ((params["phi"] - 0.5) / 0.5) ** 2 + 0.5 * params["spread"] ** 2
    p = np.exp(log_p - log_p.max())
    chosen = np.random.default_rng(1).choice(p.size, n, p=p / p.sum())
    return {name: values[chosen] for name, values in params.items()}


def test_the_suggestion_is_in_the_target_at_exact_draws():
    """Fresh seeds at draws of the exact posterior; errors of a tenth."""
    table = psf.suggest_particles(model_of(psf.BootstrapPF(25)), random_seed=1, progressbar=False)
    row = table.loc["d"]
    points = zip(*exact_draws(10).values(), strict=True)
    variances = [
        log_likelihoods(
            LINEAR,
            psf.BootstrapPF(row["n_particles"]),
            {"phi": phi, "spread": spread},
            np.arange(200),
            observed=DATA,
            steps=STEPS,
        ).var(ddof=1)
        for phi, spread in points
    ]
    assert 1.0 < np.median(variances) < 3.3
    assert list(table.columns) == ["filter", "variance", "low", "high", "n_particles", "reason"]
    assert row["filter"] == "BootstrapPF(25)"
    assert (row["low"], row["high"]) == (1.0, 3.3)


def test_given_draws_are_the_points_and_the_seed_decides():
    model = model_of(psf.BootstrapPF(25))
    one, same, other = (
        psf.suggest_particles(model, idata=DRAWS, random_seed=seed) for seed in (3, 3, 4)
    )
    assert one.equals(same)
    assert not one.equals(other)
    with pytest.raises(DataMismatchError, match="phi"):
        psf.suggest_particles(model, idata=az.from_dict({"posterior": {"b": np.zeros((2, 30))}}))


def test_several_noisy_variables_share_the_target():
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 0.5)
        pm.HalfNormal("spread", 1.0)
        for name, filter in {"a": psf.BootstrapPF(25), "b": psf.BootstrapPF(100)}.items():
            psf.StateSpace(name, LINEAR, filter, steps=STEPS, observed=DATA)
    table = psf.suggest_particles(model, idata=DRAWS, random_seed=1)
    assert list(table.index) == ["a", "b"]
    assert (table["low"] == 0.5).all()
    assert (table["high"] == 1.65).all()
    # The variance of each is that of its own noise.
    assert 2.0 < table.loc["a", "variance"] / table.loc["b", "variance"] < 8.0
    assert 0.3 < table.loc["a", "n_particles"] / table.loc["b", "n_particles"] < 3.3


def test_a_panel_is_tuned_on_its_noisiest_record_unless_parameters_are_shared():
    """Six like records; the last has no observation but one, and hardly any noise."""
    n, rows = 6, np.tile(STEPS[:10], 6)
    labels = np.repeat(np.arange(n), 10)
    observed = np.tile(DATA[:10], n)
    observed[-9:] = np.nan
    phi = np.tile(np.linspace(0.7, 0.9, 30)[None, :, None], (1, 1, n))
    draws = az.from_dict({"posterior": {"phi": phi, "s": np.full((1, 30), 0.7)}})
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
        found[name] = psf.suggest_particles(model, idata=draws, random_seed=1).loc["d"]
    assert 3.0 < found["shared"]["variance"] / found["own"]["variance"] < 7.0  # five noisy records
    assert found["shared"]["n_particles"] > 2.5 * found["own"]["n_particles"]


def test_a_variance_that_stays_is_a_warning_with_another_filter():
    """A precise sensor far from where the particles start: one of them decides at once."""
    system = autoregression(spread=1e-2, observation_noise=1e-8)
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 0.5)
        psf.StateSpace("d", system, psf.BootstrapPF(10), steps=[1, 2, 3], observed=[3.0, -2.0, 4.0])
    draws = az.from_dict({"posterior": {"phi": np.linspace(0.2, 0.8, 30)[None]}})
    with pytest.warns(
        FilterWarning, match=r"d: the variance .* collapse .*\. Use EKF\(\), which has less"
    ):
        table = psf.suggest_particles(model, idata=draws, random_seed=1)
    assert table["n_particles"].isna().all()
    assert (table["variance"] > 3.3).all()


def test_bad_arguments():
    with pytest.raises(ModelError, match=r"must have a StateSpace variable with a noisy like"):
        psf.suggest_particles(model_of(psf.EKF()))
    model = model_of(psf.BootstrapPF(20))
    with pytest.raises(ModelError, match=r"model must be a pymc.Model, got str"):
        psf.suggest_particles("d")
    with pytest.raises(ModelError, match=r"random_seed must be .* got 'x'"):
        psf.suggest_particles(model, random_seed="x")
    with pm.Model() as fixed:
        psf.StateSpace("d", LINEAR, psf.EnKF(20), params=TRUTH, steps=STEPS, observed=DATA)
    with pytest.raises(ModelError, match=r"at least one free variable"):
        psf.suggest_particles(fixed)
    with pytest.raises(TypeError, match=r"no argument 'var_name': the table has a row for every"):
        psf.suggest_particles(model, var_name="d")


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
    assert 20 < names["table"].loc["d", "n_particles"] < 100
    assert (tmp_path / "first-run").is_dir()
