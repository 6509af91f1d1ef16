"""The DRAM step method under ``pm.sample``: the right law, and what PyMC expects of a step."""

import logging

import arviz as az
import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling import DRAM


def sample(step, draws=1000, tune=1000, chains=2, cores=1, random_seed=1, **kwargs):
    """``pm.sample`` without a bar and without its opinion on convergence."""
    return pm.sample(
        draws,
        tune=tune,
        chains=chains,
        cores=cores,
        step=step,
        random_seed=random_seed,
        progressbar=False,
        compute_convergence_checks=False,
        **kwargs,
    )


def assert_moments(draws, mean, sd):
    """Mean and standard deviation within 4.5 Monte Carlo standard errors: 7e-6 a comparison."""
    mcse_mean, mcse_sd = az.mcse(draws, method="mean"), az.mcse(draws, method="sd")
    assert abs(draws.mean() - mean) < 4.5 * mcse_mean
    assert abs(draws.std() - sd) < 4.5 * mcse_sd


def simple_model():
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 10)
        sigma = pm.HalfNormal("sigma", 2)
        pm.Normal("y", mu, sigma, observed=[1.2, 0.7, 2.9, 1.8])
    return model


@pytest.mark.parametrize(
    ("settings", "seed"),
    [({}, 1), ({"stages": 3, "stage_scale": 0.4}, 2), ({"adaptation": "continuous"}, 3)],
)
def test_correlated_normal(settings, seed):
    rng = np.random.default_rng(0)
    factor = np.tril(rng.normal(size=(3, 3))) + np.eye(3)
    mean, cov = np.array([3.0, -1.0, 0.5]), factor @ factor.T
    with pm.Model():
        pm.MvNormal("x", mean, cov)
        idata = sample(DRAM(**settings), draws=3000, random_seed=seed)
    x = idata["posterior"]["x"]
    for i in range(3):
        assert_moments(x[..., i].to_numpy(), mean[i], np.sqrt(cov[i, i]))
    # The sum sees the correlations.
    assert_moments(x.sum("x_dim_0").to_numpy(), mean.sum(), np.sqrt(cov.sum()))


def test_transforms_vectors_and_potentials():
    """A half-normal, a uniform, and a vector of two tied together by a Potential."""
    with pm.Model():
        pm.HalfNormal("scale", 2.0)
        pm.Uniform("share", -1, 3)
        pair = pm.Normal("pair", 0, 1, shape=(2,))
        pm.Potential("tie", -0.5 * (pair[0] - pair[1]) ** 2 / 0.5)
        idata = sample(DRAM(), draws=3000)
    draws = {name: idata["posterior"][name].to_numpy() for name in ("scale", "share", "pair")}
    assert_moments(draws["scale"], 2 * np.sqrt(2 / np.pi), 2 * np.sqrt(1 - 2 / np.pi))
    assert_moments(draws["share"], 1.0, 4 / np.sqrt(12))
    # Precision of the pair: [[3, -2], [-2, 3]].
    assert_moments(draws["pair"][..., 0], 0.0, np.sqrt(3 / 5))
    assert_moments(draws["pair"].sum(axis=-1), 0.0, np.sqrt(2))


def test_beside_other_step_methods():
    """Metropolis moves what DRAM does not hold; its current density follows."""
    with pm.Model() as model:
        a = pm.Normal("a", 0, 1)
        b = pm.Normal("b", a, 0.5)
        pm.Poisson("n", 3.0)
        idata = sample([DRAM([a], stages=1), pm.Metropolis([b])], draws=2500)
    assert_moments(idata["posterior"]["a"].to_numpy(), 0.0, 1.0)
    assert_moments(idata["posterior"]["b"].to_numpy(), 0.0, np.sqrt(1.25))
    assert model.free_RVs[2].name == "n"


def test_two_of_different_sizes():
    """PyMC wants one type for a statistic in all steps, so that there is no matrix here."""
    with pm.Model():
        a = pm.Normal("a", 0, 1)
        b = pm.Normal("b", a, 0.5, shape=2)
        idata = sample([DRAM([a]), DRAM([b])], draws=2500)
    assert_moments(idata["posterior"]["a"].to_numpy(), 0.0, 1.0)
    assert_moments(idata["posterior"]["b"].to_numpy()[..., 1], 0.0, np.sqrt(1.25))
    assert idata["sample_stats"]["scaling"].shape == (2, 2500, 2)
    assert "proposal_cov" not in idata["sample_stats"]


def test_lp_is_the_model_log_density():
    with simple_model() as model:
        idata = sample(DRAM(), draws=50)
    logp = model.compile_logp()
    posterior, lp = idata["posterior"], idata["sample_stats"]["lp"]
    for chain, draw in [(0, 0), (0, 49), (1, 25)]:
        at = posterior.isel(chain=chain, draw=draw)
        point = {"mu": at["mu"].to_numpy(), "sigma_log__": np.log(at["sigma"].to_numpy())}
        np.testing.assert_allclose(lp[chain, draw], logp(point), rtol=1e-12)


def test_proposals_are_frozen_after_tuning():
    with simple_model():
        idata = sample(DRAM(), draws=300, tune=450, discard_tuned_samples=False)
    kept = idata["sample_stats"]["proposal_cov"].to_numpy()
    warm = idata["warmup_sample_stats"]["proposal_cov"].to_numpy()
    assert kept.shape == (2, 300, 2, 2)
    assert kept.dtype == np.float64
    for chain in range(2):
        np.testing.assert_array_equal(kept[chain], np.broadcast_to(warm[chain, -1], (300, 2, 2)))
        assert len(np.unique(warm[chain, :, 0, 0])) >= 5
    stages = idata["warmup_sample_stats"]["stage"].to_numpy()
    assert set(np.unique(stages)) == {0, 1, 2}
    assert set(np.unique(idata["sample_stats"]["stage"].to_numpy())) == {0, 1}


def test_same_seed_same_draws_in_sequence_and_in_processes():
    with simple_model():
        step = DRAM()
        one = sample(step, draws=100, tune=200)
        two = sample(step, draws=100, tune=200, cores=2, mp_ctx="fork")
        again = sample(DRAM(), draws=100, tune=200)
        other = sample(DRAM(), draws=100, tune=200, random_seed=2)
    for name in ("mu", "sigma"):
        first = one["posterior"][name].to_numpy()
        np.testing.assert_array_equal(first, two["posterior"][name].to_numpy())
        np.testing.assert_array_equal(first, again["posterior"][name].to_numpy())
        assert not np.array_equal(first, other["posterior"][name].to_numpy())
        assert not np.array_equal(first[0], first[1])
    np.testing.assert_array_equal(
        one["sample_stats"]["proposal_cov"], two["sample_stats"]["proposal_cov"]
    )


def test_a_stored_state_goes_on_draw_for_draw():
    with simple_model() as model:
        step, twin = DRAM(), DRAM()
    step.setup_chain(np.random.default_rng(5), tune=500, draws=0)
    point = model.initial_point()
    for _ in range(130):
        point, _ = step.step(point)
    twin.sampling_state = step.sampling_state
    other = point
    for _ in range(200):
        point, stats = step.step(point)
        other, twin_stats = twin.step(other)
    assert point == other
    assert stats[0]["model_logp"] == twin_stats[0]["model_logp"]
    np.testing.assert_array_equal(stats[0]["proposal_cov"], twin_stats[0]["proposal_cov"])


def first_draws(step, **kwargs):
    # A proposal of no size: the first draw is the start.
    idata = sample(step, draws=4, chains=4, discard_tuned_samples=False, **kwargs)
    group = "warmup_posterior" if kwargs["tune"] else "posterior"
    return idata[group]["mu"].to_numpy()[:, 0]


def test_starts_are_dispersed_unless_chosen():
    still = {"proposal_cov": 1e-20 * np.eye(2)}
    with simple_model() as model:
        dispersed = first_draws(DRAM(**still), tune=4)
        given = first_draws(DRAM(**still), tune=4, initvals={"mu": 7.0})
        untuned = first_draws(DRAM(**still), tune=0)
    assert dispersed.std() > 2.0  # the prior's is 10
    np.testing.assert_allclose(given, 7.0, atol=1e-6)
    np.testing.assert_allclose(untuned, model.initial_point()["mu"], atol=1e-6)

    with pm.Model():
        pm.Normal("mu", 0, 10, initval=-3.0)
        np.testing.assert_allclose(first_draws(DRAM(proposal_cov=[[1e-20]]), tune=4), -3.0)


def test_flat_priors_start_around_the_starting_point():
    with pm.Model():
        mu = pm.Flat("mu")
        pm.Normal("y", mu, 1.0, observed=[5.0])
        starts = first_draws(DRAM(proposal_cov=[[1e-20]]), tune=4)
    assert np.all(np.abs(starts) < 1.0)
    assert len(np.unique(starts)) == 4


def test_dispersed_starts_keep_to_possible_points():
    with pm.Model():
        mu = pm.Normal("mu", 0, 10)
        pm.Potential("half", pt.switch(mu > 2.0, 0.0, -np.inf))
        assert np.all(first_draws(DRAM(proposal_cov=[[1e-20]]), tune=4) > 2.0)


def test_an_impossible_start_is_an_error():
    with pm.Model():
        mu = pm.Normal("mu", 0, 10)
        pm.Potential("never", pt.switch(mu > 1e9, 0.0, -np.inf))
        with pytest.raises(ModelError, match=r"start, \[0\.0\].*200 draws.*initvals"):
            sample(DRAM(), draws=10, tune=10)
        with pytest.raises(ModelError, match="initvals"):
            sample(DRAM(), draws=10, tune=0)


def nan_beyond(limit):
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 1)
        pm.Potential("edge", pt.switch(mu > limit, np.nan, 0.0))
    return model


def test_nan_is_impossible_and_counted(caplog):
    with nan_beyond(0.0), caplog.at_level(logging.WARNING, logger="pymc.stats.convergence"):
        idata = sample(DRAM(), draws=2500)
    stats = idata["sample_stats"]
    assert np.isfinite(stats["lp"]).all()
    assert_moments(idata["posterior"]["mu"].to_numpy(), -np.sqrt(2 / np.pi), np.sqrt(1 - 2 / np.pi))
    assert stats["n_failed"].sum() > 400
    assert set(np.unique(stats["failure"])) == {0, -1}
    assert "the log-density is NaN" in caplog.text


def test_impossible_is_not_a_failure(caplog):
    with pm.Model(), caplog.at_level(logging.WARNING, logger="pymc.stats.convergence"):
        mu = pm.Normal("mu", 0, 1)
        pm.Potential("edge", pt.switch(mu > 0.0, -np.inf, 0.0))
        idata = sample(DRAM(), draws=500)
    assert idata["sample_stats"]["n_failed"].sum() == 0
    assert caplog.text == ""


def test_a_chain_that_stands_still_says_so(caplog):
    with simple_model(), caplog.at_level(logging.WARNING, logger="pymc.stats.convergence"):
        sample(DRAM(proposal_cov=1e12 * np.eye(2)), draws=100, tune=0, cores=2)
    assert caplog.text.count("accepted 0 of 100 proposals") == 2


def test_live_columns():
    """Every column has a first value, and a draw's statistics fill all of them."""
    with simple_model() as model:
        step = DRAM()
    columns, first = step._progressbar_config(2)
    step.setup_chain(np.random.default_rng(0), tune=10, draws=10)
    _, stats = step.step(model.initial_point())
    (update,) = step._make_progressbar_update_functions()
    shown = update(stats[0])
    assert set(shown) >= set(first) | {"failing"}
    assert all(len(values) == 2 for values in first.values())
    for column in columns:
        field = column.text_format.removeprefix("{task.fields[").split("]")[0]
        assert field in first


def test_discrete_variables_are_refused():
    with pm.Model():
        pm.Normal("a")
        pm.Poisson("n", 3.0)
        with pytest.raises(ModelError, match=r"discrete: n\."):
            DRAM()


def test_scalars_in_other_precisions():
    with pytensor.config.change_flags(floatX="float32"), pm.Model():
        pm.Normal("a", 0, 1)
        idata = sample(DRAM(), draws=50, tune=50)
    assert idata["posterior"]["a"].dtype == np.float32
