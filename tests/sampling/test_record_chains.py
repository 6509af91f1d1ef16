"""Chains that move the records of a panel one by one, against an exact posterior."""

import logging

import arviz as az
import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from tests.kernels import with_kernel
from tests.modes import AS_IT_STANDS

# The state is white noise about a level, so that a record is a sample of independent normals and
# the posterior of levels and mean, given the other variances, is Gaussian.
PROCESS_VAR, MEASUREMENT_VAR, SPREAD, PRIOR_SD = 0.5, 0.5, 0.7, 2.0
SYSTEM = psf.StateSpaceModel(
    transition=lambda x, q, level: [level + q[0]],
    process_noise=[[PROCESS_VAR]],
    observation=lambda x: [x[0]],
    observation_noise=[[MEASUREMENT_VAR]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)

LABELS, N_ROWS = ["left", "middle", "right"], 3
NOISY = psf.BootstrapPF(64)


def data_of(n_records):
    rng = np.random.default_rng(5)
    levels = rng.normal(1.0, SPREAD, n_records)
    return np.repeat(levels, N_ROWS) + rng.normal(size=n_records * N_ROWS)


def panel_model(filter, *, centred=True, labels=LABELS):
    with pm.Model(coords={"place": labels}) as model:
        mu = pm.Normal("mu", 0.0, PRIOR_SD)
        if centred:
            level = pm.Normal("level", mu, SPREAD, dims="place")
        else:
            z = pm.Normal("z", dims="place")
            level = pm.Deterministic("level", mu + SPREAD * z, dims="place")
        psf.StateSpace(
            "d",
            SYSTEM,
            filter,
            panel=np.repeat(labels, N_ROWS),
            steps=np.tile(np.arange(1, N_ROWS + 1), len(labels)),
            observed=data_of(len(labels)),
            params={"level": level},
        )
    return model


def exact():
    """Mean and covariance of mu and the levels, given the data."""
    n = len(LABELS)
    means = data_of(n).reshape(n, N_ROWS).mean(axis=1)
    precision = np.zeros((n + 1, n + 1))
    precision[0, 0] = PRIOR_SD**-2 + n * SPREAD**-2
    precision[0, 1:] = precision[1:, 0] = -(SPREAD**-2)
    of_data = N_ROWS / (PROCESS_VAR + MEASUREMENT_VAR)
    precision[1:, 1:] = np.eye(n) * (SPREAD**-2 + of_data)
    cov = np.linalg.inv(precision)
    return cov @ np.concatenate([[0.0], of_data * means]), cov


def chains(model, draws=2000, tune=800, **settings):
    options = {"chains": 4, "random_seed": 4, "progressbar": False} | settings
    return psf.sample_dram(draws, tune, model=model, **with_kernel(options))


def worst_deviation(idata):
    """Largest error of a mean or a standard deviation, in Monte Carlo standard errors."""
    mean, cov = exact()
    posterior = idata["posterior"]
    levels = posterior["level"].values
    columns = [posterior["mu"].values, *(levels[..., g] for g in range(len(LABELS)))]
    errors = []
    for i, draws in enumerate(columns):
        errors.append((draws.mean() - mean[i]) / az.mcse(draws, method="mean"))
        errors.append((draws.std() - cov[i, i] ** 0.5) / az.mcse(draws, method="sd"))
    return np.abs(errors).max()


@pytest.mark.parametrize(
    ("filter", "centred"),
    [(psf.EKF(), True), (NOISY, True), (NOISY, False)],
    ids=["EKF-centred", "BootstrapPF-centred", "BootstrapPF-non_centred"],
)
def test_exact_posterior(filter, centred):
    """Eight comparisons at 4.5 standard errors, three cases: one false alarm in 6000 seeds."""
    idata = chains(panel_model(filter, centred=centred))
    assert worst_deviation(idata) < 4.5
    stats = idata["sample_stats"]
    assert stats["record_accepted"].dims == ("chain", "draw", "d_record")
    assert stats["d_record"].values.tolist() == LABELS
    # The non-centred form is moved in centred coordinates.
    assert ("shared_accepted" in stats, "population_accepted" in stats) == (False, True)


@pytest.mark.parametrize(
    ("filter", "form"),
    [(psf.EKF(), "non-centred"), (NOISY, "non-centred"), (psf.EKF(), "Normal"),
     (psf.EKF(), "LogNormal")],
    ids=["EKF", "BootstrapPF", "centred", "centred_log"],
)  # fmt: skip
def test_a_spread_of_random_effects_by_quadrature(filter, form):
    """Twelve comparisons at 4.5 standard errors, four cases: one false alarm in 3000 seeds."""
    labels = ["a", "b", "c", "d"]
    with pm.Model(coords={"place": labels}) as model:
        mu, sd = pm.Normal("mu", 0.0, PRIOR_SD), pm.HalfNormal("sd", 1.0)
        if form == "non-centred":
            level = mu + sd * pm.Normal("z", dims="place")
        elif form == "Normal":
            level = pm.Normal("level", mu, sd, dims="place")
        else:
            level = pm.math.log(pm.LogNormal("exp_level", mu, sd, dims="place"))
        psf.StateSpace(
            "d",
            SYSTEM,
            filter,
            panel=np.repeat(labels, N_ROWS),
            steps=np.tile(np.arange(1, N_ROWS + 1), len(labels)),
            observed=data_of(len(labels)),
            params={"level": level},
        )
    idata = chains(model, 3000)
    if form != "non-centred":  # the records, and all of them once more with the standard values
        assert (idata["sample_stats"]["n_evaluations"] == 2 * len(labels)).all()
    posterior = idata["posterior"]
    expected = of_random_effects(data_of(len(labels)).reshape(-1, N_ROWS).mean(axis=1))
    mu, sd = posterior["mu"].values, posterior["sd"].values
    if form == "non-centred":
        z = posterior["z"].values
    else:
        levels = np.log(posterior["exp_level"]) if form == "LogNormal" else posterior["level"]
        z = (levels.values - mu[..., None]) / sd[..., None]
    drawn = [mu, sd, mu**2, sd**2, *np.moveaxis(z, -1, 0)]
    for draws, mean in zip(drawn, expected, strict=True):
        assert abs(draws.mean() - mean) < 4.5 * az.mcse(draws, method="mean")


@pytest.mark.parametrize("is_centred", [False, True])
def test_random_effects_that_start_at_their_mean(is_centred):
    """They have a location without parameters. Two comparisons: one false alarm in 70000 seeds."""
    labels, data = list("abcd"), data_of(4)
    with pm.Model(coords={"place": labels}) as model:
        sd = pm.HalfNormal("sd", 1.0, initval=0.5)
        if is_centred:
            level = pm.Normal("level", 1.0, sd, dims="place")
        else:
            level = 1.0 + sd * pm.Normal("z", dims="place")
        psf.StateSpace(
            "d",
            SYSTEM,
            psf.EKF(),
            panel=np.repeat(labels, N_ROWS),
            steps=np.tile(np.arange(1, N_ROWS + 1), len(labels)),
            observed=data,
            params={"level": level},
        )
    drawn = chains(model)["posterior"]["sd"].values
    grid = np.linspace(1e-4, 6.0, 20001)
    variance = grid**2 + (PROCESS_VAR + MEASUREMENT_VAR) / N_ROWS
    squares = ((data.reshape(-1, N_ROWS).mean(axis=1) - 1.0) ** 2).sum()
    weights = np.exp(-0.5 * (len(labels) * np.log(variance) + squares / variance + grid**2))
    weights /= weights.sum()
    for draws, mean in ((drawn, grid @ weights), (drawn**2, grid**2 @ weights)):
        assert abs(draws.mean() - mean) < 4.5 * az.mcse(draws, method="mean")


def of_random_effects(means):
    """E mu, E sd, E mu^2, E sd^2 and E z of each record, from the means of their rows."""
    sd = np.linspace(1e-4, 6.0, 20001)
    variance = sd**2 + (PROCESS_VAR + MEASUREMENT_VAR) / N_ROWS
    precision = PRIOR_SD**-2 + len(means) / variance
    mu = means.sum() / variance / precision
    squares = (means**2).sum() / variance - precision * mu**2
    log_weights = -0.5 * (len(means) * np.log(variance) + np.log(precision) + squares + sd**2)
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    z = sd / variance * (means[:, None] - mu)
    numbers = np.array([mu, sd, mu**2 + 1.0 / precision, sd**2, *z])
    return numbers @ weights


def test_held_noise_has_the_error_of_its_seed():
    """The noise of the model's seed, at all points; the same test finds it."""
    model = panel_model(psf.BootstrapPF(4))
    idata = chains(model, refresh_noise=False)
    assert (idata["sample_stats"]["d_seed"] == 0).all()
    assert worst_deviation(idata) > 6.0


@pytest.mark.parametrize("centred", [True, False], ids=["centred", "non_centred"])
def test_the_estimate_of_each_draw_is_that_of_its_seeds(centred):
    """A record's kept estimate is the filter's at its level with its seed."""
    model = panel_model(NOISY, centred=centred)
    idata = chains(model, 40, 40, chains=1)
    posterior, stats = idata["posterior"].isel(chain=0), idata["sample_stats"].isel(chain=0)
    prior = model.compile_fn(model.logp(vars=model.free_RVs), mode=AS_IT_STANDS)
    data = data_of(3).reshape(3, N_ROWS)
    for draw in (0, 20, 39):
        levels = posterior["level"].values[draw]
        total = prior({rv.name: posterior[rv.name].values[draw] for rv in model.free_RVs})
        for g, label in enumerate(LABELS):
            terms = psf.log_likelihood(
                SYSTEM,
                NOISY,
                {"level": levels[g : g + 1]},
                observed=data[g],
                steps=np.arange(1, N_ROWS + 1),
                panel=[label] * N_ROWS,
                seed=int(stats["d_seed"].values[draw, g]),
            )
            total += np.sum(terms)
        np.testing.assert_allclose(stats["lp"].values[draw], total, rtol=1e-10)


def test_seeds_are_new_where_a_record_has_moved_and_nowhere_else():
    idata = chains(panel_model(NOISY), 200, 100, chains=1)
    stats = idata["sample_stats"].isel(chain=0)
    changed = np.diff(stats["d_seed"].values, axis=0) != 0
    np.testing.assert_array_equal(changed, stats["record_accepted"].values[1:])
    moved = np.diff(idata["posterior"]["level"].values[0], axis=0) != 0
    np.testing.assert_array_equal(changed, moved)
    assert (stats["n_evaluations"] == len(LABELS)).all()
    np.testing.assert_allclose(stats["accepted"], stats["record_accepted"].mean("d_record"))


def test_draws_do_not_depend_on_threads_or_interruptions(tmp_path, monkeypatch):
    from pymc_statespace_filters.sampling.run import chain_task

    model = panel_model(NOISY, centred=False)
    whole = chains(model, 150, 150, chains=2, cores=1)
    threads = chains(model, 150, 150, chains=2, cores=2)

    class Killed(BaseException):
        pass

    saved = chain_task.ChainTask._save

    def killed(task):
        saved(task)
        if task.n_done > 100:
            raise Killed

    monkeypatch.setattr(chain_task, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(chain_task.ChainTask, "_save", killed)
    with pytest.raises(Killed):
        chains(model, 150, 150, chains=2, cores=1, checkpoint=tmp_path / "run")
    monkeypatch.undo()
    resumed = chains(model, 150, 150, chains=2, cores=1, checkpoint=tmp_path / "run")
    for other in (threads, resumed):
        for group in ("posterior", "sample_stats"):
            for name, values in whole[group].data_vars.items():
                np.testing.assert_array_equal(values, other[group][name], err_msg=name)


def test_acceptance_of_a_record_does_not_depend_on_how_many_there_are():
    """Records without a population: the same law of each, of two and of thirty.

    Proposals are given, so that the rates differ by chance alone, by 3 % in standard deviation.
    The noise of all thirty together has a variance of about ten: they would hardly move.
    """
    rates = {}
    for n_records in (2, 30):
        labels = list(range(n_records))
        with pm.Model() as model:
            level = pm.Normal("level", 1.0, 1.0, shape=n_records)
            psf.StateSpace(
                "d",
                SYSTEM,
                psf.BootstrapPF(16),
                panel=np.repeat(labels, N_ROWS),
                steps=np.tile(np.arange(1, N_ROWS + 1), n_records),
                observed=data_of(30)[: n_records * N_ROWS],
                params={"level": level},
            )
        cov = np.eye(n_records)
        idata = chains(model, 2000, 0, chains=2, proposal_cov=cov)
        accepted = idata["sample_stats"]["record_accepted"]
        rates[n_records] = accepted.mean(("chain", "draw")).values
    assert rates[30][:2] == pytest.approx(rates[2], rel=0.1)
    assert rates[30].min() > 0.2


def test_warnings_name_the_record_that_does_not_move(caplog):
    """Proposals of one record are far too wide, and are not adapted; the others move."""
    cov = np.diag([0.1, 0.1, 1e8, 0.1])
    with caplog.at_level(logging.WARNING, logger="pymc.stats.convergence"):
        chains(panel_model(psf.EKF()), 700, 4, chains=1, proposal_cov=cov)
    assert "Record 'middle' hardly moved: it accepted 0 of 700 proposals" in caplog.text


REFUSED = {
    "screen": ({"screen": psf.EKF()}, "screen must be None for the panel 'd'"),
    "correlation": (
        {"correlation": 0.9, "stages": 1},
        "correlation must be None for the panel 'd'",
    ),
    "stages": ({"stages": 3}, "stages must be 1 for the panel 'd'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_settings_that_records_do_not_have(case):
    settings, message = REFUSED[case]
    with pytest.raises(ModelError, match=message):
        chains(panel_model(NOISY), 10, 10, **settings)


def test_a_start_without_density_names_its_record():
    with pm.Model() as model:
        level = pm.Uniform("level", -1.0, 1.0, shape=3)
        pm.Potential("none", pm.math.switch(pm.math.eq(np.arange(3), 1), -np.inf, level))
        psf.StateSpace(
            "d",
            SYSTEM,
            psf.EKF(),
            panel=np.repeat(LABELS, N_ROWS),
            steps=np.tile(np.arange(1, N_ROWS + 1), 3),
            observed=data_of(3),
            params={"level": level},
        )
    with pytest.raises(ModelError, match="log-density of record 'middle' is not finite"):
        chains(model, 10, 10)


def test_the_covariance_of_the_user_is_that_of_the_blocks():
    idata = chains(panel_model(psf.EKF()), 4, 4, proposal_cov=np.eye(4) * 0.09, chains=1)
    np.testing.assert_allclose(idata["sample_stats"]["scaling"], 0.3)


def test_the_evidence_of_draws_by_record_is_exact():
    """Bridge sampling of the kept estimates, at four standard errors of its own."""
    model = panel_model(psf.BootstrapPF(256))
    idata = chains(model, 2000, 500)
    found = psf.estimate_evidence(idata, model, estimators=["bridge"], random_seed=2)["bridge"]
    n = len(LABELS) * N_ROWS
    of_record = np.kron(np.eye(len(LABELS)), np.full((N_ROWS, N_ROWS), SPREAD**2))
    cov = PRIOR_SD**2 + of_record + (PROCESS_VAR + MEASUREMENT_VAR) * np.eye(n)
    data = data_of(len(LABELS))
    expected = -0.5 * (
        data @ np.linalg.solve(cov, data) + np.linalg.slogdet(cov)[1] + n * np.log(2 * np.pi)
    )
    assert abs(found.log_evidence - expected) < 4.0 * found.se
    assert found.se < 0.2


def test_a_pilot_gives_each_block_proposals_of_its_own_size():
    """Those of all parameters together would be shorter, and no adaptation would lengthen them."""
    model = panel_model(psf.EKF())
    pilot = chains(model, 1000, 500, chains=2)
    idata = chains(model, 500, 1, chains=2, pilot=pilot)
    of_pilot = pilot["sample_stats"]["accepted"].values.mean()
    assert idata["sample_stats"]["accepted"].values.mean() == pytest.approx(of_pilot, abs=0.12)
