"""Whole chains by noisy likelihoods, screened and correlated, against an exact posterior."""

import logging

import arviz as az
import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling.kernel.state import STAGE
from pymc_statespace_filters.sampling.run.chain import Chain
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from pymc_statespace_filters.sampling.target.target import Target
from tests.kernels import with_kernel
from tests.sampling.test_state_space import DATA, LINEAR, STEPS, linear_model
from tests.systems import autoregression, counts

FEW = psf.BootstrapPF(30)


def sample_dram(**settings):
    return psf.sample_dram(**with_kernel(settings))


def chains(draws=4000, tune=1000, model=None, **settings):
    return psf.sample_dram(
        draws,
        tune,
        chains=2,
        model=model or linear_model(FEW),
        random_seed=4,
        progressbar=False,
        **with_kernel(settings),
    )


def exact_moments():
    """Means and standard deviations by quadrature over the exact Kalman likelihood."""
    phi, spread = np.linspace(-1.5, 2.0, 161), np.linspace(0.005, 4.0, 200)
    grid = np.meshgrid(phi, spread, indexing="ij")
    params = dict(zip(("phi", "spread"), grid, strict=True))
    terms = psf.log_likelihood(LINEAR, psf.EKF(), params, DATA, steps=STEPS)
    log_posterior = terms.sum(axis=-1) - 0.5 * ((grid[0] - 0.5) / 0.5) ** 2 - 0.5 * grid[1] ** 2
    weight = np.exp(log_posterior - log_posterior.max())
    weight /= weight.sum()
    moments = {}
    for name, values in params.items():
        mean = np.sum(weight * values)
        moments[name] = mean, np.sqrt(np.sum(weight * (values - mean) ** 2))
    return moments


def worst_deviations(idata):
    """Largest error of a mean and of a standard deviation, in Monte Carlo standard errors."""
    in_mean, in_sd = [], []
    for name, (mean, sd) in exact_moments().items():
        draws = idata["posterior"][name].to_numpy()
        in_mean.append(abs(draws.mean() - mean) / az.mcse(draws, method="mean"))
        in_sd.append(abs(draws.std() - sd) / az.mcse(draws, method="sd"))
    return max(in_mean), max(in_sd)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"screen": psf.EKF(), "screen_power": 0.5, "stages": 3},
        {"screen": psf.EnKF(20), "screen_power": 1.0},  # on the model's seed, far from exact
        {"correlation": 0.95, "stages": 1, "screen": psf.EKF(), "screen_power": 0.5},
    ],
    ids=["fresh", "tempered", "noisy_screen", "correlated_screened"],
)
def test_exact_posterior(settings):
    """Four comparisons at 4.5 standard errors, four cases: one false alarm in 9000 seeds."""
    assert max(worst_deviations(chains(**settings))) < 4.5


def test_the_same_test_finds_held_noise():
    """One seed's error stays in the posterior: common random numbers are not exact."""
    idata = chains(refresh_noise=False)
    assert max(worst_deviations(idata)) > 6.0


@pytest.mark.parametrize("screen", [psf.EKF(), psf.EnKF(20)], ids=["EKF", "EnKF"])
def test_the_target_is_evaluated_only_where_the_screen_has_moved(screen):
    idata = chains(300, 300, screen=screen, stages=2)
    stats = idata["sample_stats"]
    calls, moved, screened = (
        stats[name].to_numpy() for name in ("n_evaluations", "accepted", "n_screened")
    )
    walked = stats["independent"].to_numpy() == 0
    assert set(np.unique(calls)) == {0, 1}
    assert set(np.unique(screened)) == {1, 2}
    assert np.all(moved <= calls)
    # The first proposal's rejections are certain, as the second one was made.
    assert np.all(calls[walked & (screened == 1)] == 1)
    # A proposal of the mixture has no second one.
    assert np.all(screened[~walked] == 1)
    assert 0 < np.mean(calls[~walked]) < 1
    assert 0 < np.mean(calls[screened == 2]) < 1


class TestRefusals:
    """What cannot be right, or cannot be computed, is refused alike by both entry points."""

    @pytest.mark.parametrize("entry", [psf.DRAM, sample_dram])
    def test_a_screen_that_cannot_treat_the_system(self, entry):
        with pm.Model():
            pm.Normal("level")
            psf.StateSpace("d", counts(), FEW, steps=[1, 2], observed=[1, 0])
            with pytest.raises(ModelError, match=r"screen=EKF\(\): EKF needs .*Gaussian noise"):
                entry(screen=psf.EKF())

    @pytest.mark.parametrize("entry", [psf.DRAM, sample_dram])
    def test_a_screen_without_state_space(self, entry):
        with pm.Model():
            pm.Normal("mu")
            with pytest.raises(
                ModelError, match=r"screen needs a model with a StateSpace variable, got EKF\(\)"
            ):
                entry(screen=psf.EKF())


def kinked(x, q, phi):
    """The derivative at zero, where the EKF begins, is 0/0 for phi above 0.5."""
    kink = pt.sqrt(x[0] ** 2 + pt.switch(phi > 0.5, 0.0, 1.0))
    return [phi * x[0] + 1e-9 * kink + q[0]]


def kinked_model():
    system = autoregression(transition=kinked, spread=0.5**0.5)
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 0.5)
        psf.StateSpace("d", system, FEW, steps=STEPS, observed=DATA)
    return model


def test_a_screen_that_fails_cuts_off_and_says_so(caplog):
    start = {"phi": 0.3}
    with caplog.at_level(logging.WARNING, logger="pymc.stats.convergence"):
        free = chains(500, 500, kinked_model(), initvals=start)
        assert "screen" not in caplog.text
        screened = chains(500, 500, kinked_model(), initvals=start, screen=psf.EKF())
    assert np.mean(free["posterior"]["phi"] > 0.5) > 0.1
    assert np.all(screened["posterior"]["phi"] <= 0.5)
    stats = screened["sample_stats"]
    assert stats["n_failed"].sum() == 0
    failed, proposals = (int(stats[name][0].sum()) for name in ("n_screen_failed", "n_screened"))
    assert f"Chains 0 and 1: The screen failed in {failed} of {proposals}" in caplog.text
    assert "Use another screen" in caplog.text


def test_the_step_method_says_so_too(caplog):
    with kinked_model(), caplog.at_level(logging.WARNING, logger="pymc.stats.convergence"):
        pm.sample(
            200,
            tune=200,
            chains=1,
            step=psf.DRAM(screen=psf.EKF()),
            initvals={"phi": 0.3},
            random_seed=1,
            progressbar=False,
            compute_convergence_checks=False,
        )
    assert "The screen failed in" in caplog.text


def test_screen_and_target_of_the_same_system():
    """A screen that is the target's own deterministic filter passes nothing in vain."""
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 0.5)
        pm.HalfNormal("spread", 1.0)
        psf.StateSpace("d", LINEAR, psf.EKF(), steps=STEPS, observed=DATA)
    stats = chains(300, 300, model, screen=psf.EKF(), screen_power=1.0)["sample_stats"]
    np.testing.assert_array_equal(stats["n_evaluations"], stats["accepted"])


def test_no_correlation_is_fresh_noise():
    assert RandomWalkSettings(correlation=0.0) == RandomWalkSettings()


def brittle(x, q, phi, narrow):
    """No number for a member of the screen's ensemble, one for the mean at which the EKF looks."""
    gone = pt.switch((narrow > 0.5) & pt.neq(x[0], 0.0), np.nan, 0.0)
    return [phi * x[0] + gone + q[0]]


@pytest.mark.usefixtures("interpreted")
def test_a_screen_that_fails_where_another_step_moved():
    """DRAM waits there; what it notes down is the density of the target."""
    system = autoregression(transition=brittle, spread=0.5**0.5)
    with pm.Model() as model:
        phi, narrow = pm.Normal("phi", 0.5, 0.5), pm.Normal("narrow", 0.5, 0.3)
        psf.StateSpace("d", system, psf.EKF(), steps=[1], observed=[[0.4]])
        idata = pm.sample(
            400,
            tune=200,
            chains=1,
            cores=1,
            step=[pm.Metropolis([narrow]), psf.DRAM([phi], screen=psf.EnKF(50))],
            initvals={"narrow": 0.2},
            random_seed=1,
            progressbar=False,
            compute_convergence_checks=False,
        )
    draws, stats = idata["posterior"], idata["sample_stats"]
    phi, narrow = draws["phi"][0].to_numpy(), draws["narrow"][0].to_numpy()
    waits = (narrow > 0.5)[1:]
    assert 0.2 < waits.mean() < 0.8
    moved = phi[1:] != phi[:-1]
    assert not moved[waits].any()
    assert moved[~waits].mean() > 0.1
    log_density = model.compile_logp()
    expected = [log_density({"phi": p, "narrow": n}) for p, n in zip(phi, narrow, strict=True)]
    np.testing.assert_allclose(stats["lp"][0], expected, rtol=1e-9)
    assert stats["n_failed"].sum() == 0


def test_the_noise_of_a_proposal_is_as_correlated_as_it_is_asked_to_be():
    """2080 normals and more: 0.02 is four standard errors at most."""
    settings = RandomWalkSettings(stages=1, correlation=0.9)
    target = Target(linear_model(psf.EnKF(30)), None, settings)
    target.prepare()
    chain = Chain(target, np.array([1, 2], dtype=np.uint64), 200, 0)
    chain.start([np.array([0.7, -0.4])], (), np.random.default_rng(1))
    before, agreements = chain.state.carried.copy(), []
    for i in range(200):
        chain.advance(False, i, i, 1)
        if chain.draws.counts[i, STAGE]:
            agreements.append(np.corrcoef(before, chain.state.carried)[0, 1])
        else:
            np.testing.assert_array_equal(chain.state.carried, before)
        before = chain.state.carried.copy()
    assert before.size > 2000
    assert len(agreements) > 10
    np.testing.assert_allclose(agreements, 0.9, atol=0.02)
