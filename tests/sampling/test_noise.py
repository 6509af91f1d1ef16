"""DRAM with a noisy likelihood: the estimate stays with its point, and the law is exact."""

import arviz as az
import numpy as np
import pymc as pm
import pytest

from pymc_statespace_filters.sampling import DRAM
from pymc_statespace_filters.sampling.target.initial_points import N_COMPARED
from tests.sampling.noisy_toy import Recorder, exact_posterior, noisy_model


@pytest.fixture
def toy(monkeypatch):
    """A function that makes the noisy model and lets DRAM know its seed."""

    def make(noise_sd, *, records=False):
        model, seed = noisy_model(noise_sd, records=records)
        monkeypatch.setattr(
            "pymc_statespace_filters.sampling.target.sampled_model.noise_seeds",
            lambda model: {"d": seed},
        )
        return model

    return make


def sample(step, draws, cores=1):
    return pm.sample(
        draws,
        tune=1000,
        chains=2,
        cores=cores,
        step=step,
        random_seed=3,
        progressbar=False,
        compute_convergence_checks=False,
    )


class Redrawing(DRAM):
    """The common mistake: the current point's likelihood is estimated anew."""

    def _move_to(self, point):
        self._has_started = False
        return super()._move_to(point)


def deviations(idata):
    """Mean and standard deviation of mu: their errors in Monte Carlo standard errors."""
    draws = idata["posterior"]["mu"].to_numpy()
    mean, sd = exact_posterior()
    return (
        (draws.mean() - mean) / az.mcse(draws, method="mean"),
        (draws.std() - sd) / az.mcse(draws, method="sd"),
    )


@pytest.mark.parametrize("stages", [1, (2, 2)])
def test_exact_posterior_from_a_noisy_likelihood(toy, stages):
    """Log-likelihood of variance 1.7; 4 standard errors, 6e-5 a comparison, two comparisons."""
    with toy(noise_sd=1.3):
        idata = sample(DRAM(stages=stages), draws=8000)
    in_mean, in_sd = deviations(idata)
    assert abs(in_mean) < 4.0
    assert abs(in_sd) < 4.0
    assert az.mcse(idata["posterior"]["mu"].to_numpy(), method="sd") < 0.08 * exact_posterior()[1]


def test_the_same_test_finds_redrawn_estimates(toy):
    with toy(noise_sd=1.3):
        idata = sample(Redrawing(stages=(2, 2)), draws=8000)
    assert deviations(idata)[1] > 6.0


def test_the_seed_behind_each_draw_reproduces_its_estimate(toy):
    with toy(noise_sd=1.3) as model:
        idata = sample(DRAM(), draws=200)
    logp = model.compile_logp()
    (seed,) = [v for v in logp.f.get_shared() if v.name == "d_seed"]
    stats = idata["sample_stats"]
    assert stats["d_seed"].dtype == np.int64
    for draw in range(0, 200, 20):
        seed.set_value(stats["d_seed"][0, draw].to_numpy())
        at = {"mu": idata["posterior"]["mu"][0, draw].to_numpy()}
        np.testing.assert_allclose(logp(at), stats["lp"][0, draw], rtol=1e-12)


def test_every_proposal_has_noise_of_its_own(toy):
    with toy(noise_sd=1.3):
        stats = sample(DRAM(stages=(2, 2)), draws=500)["sample_stats"]
    seeds, accepted = stats["d_seed"].to_numpy(), stats["accepted"].to_numpy()
    changed = seeds[:, 1:] != seeds[:, :-1]
    np.testing.assert_array_equal(changed, accepted[:, 1:] == 1.0)
    assert len(np.unique(seeds)) == 2 + accepted[:, 1:].sum()


def test_held_noise_is_the_models(toy):
    """Common random numbers: one seed for all; the noise of this toy then cancels."""
    with toy(noise_sd=1.3):
        step = DRAM(refresh_noise=False)
        idata = sample(step, draws=4000)
        step._target._seeds["d"].set_value(np.array(21))
        again = sample(step, draws=10)
    assert np.all(idata["sample_stats"]["d_seed"] == 20)
    assert np.all(again["sample_stats"]["d_seed"] == 21)
    assert max(map(abs, deviations(idata))) < 4.0


def test_another_variables_move_keeps_the_noise(toy):
    """The prior of the other variable is re-evaluated, the estimate is not."""
    with toy(noise_sd=1.3) as model:
        other = pm.Normal("other", model["mu"], 1.0)
        idata = sample([DRAM([model["mu"]]), pm.Metropolis([other])], draws=4000)
    assert max(map(abs, deviations(idata))) < 4.0
    draws = idata["posterior"]["other"].to_numpy()
    mean, sd = exact_posterior()
    assert abs(draws.mean() - mean) < 4.0 * az.mcse(draws, method="mean")
    assert abs(draws.std() - np.hypot(sd, 1.0)) < 4.0 * az.mcse(draws, method="sd")


def test_every_evaluation_is_of_another_proposal_with_noise_of_its_own(toy):
    """Of every stage; and none is made for nothing."""
    Recorder.seen.clear()
    with toy(noise_sd=1.3, records=True):
        step = DRAM(stages=(3, 2), compile_kwargs={"mode": "FAST_COMPILE"})
        idata = pm.sample(
            50, tune=50, chains=1, step=step, random_seed=1, progressbar=False, quiet=True,
            compute_convergence_checks=False, discard_tuned_samples=False,
        )  # fmt: skip
    proposals = evaluations = 0
    for group, n_stages in (("warmup_sample_stats", 3), ("sample_stats", 2)):
        stage = idata[group]["stage"].to_numpy()
        proposals += np.where(stage > 0, stage, n_stages).sum()
        evaluations += idata[group]["n_evaluations"].to_numpy().sum()
    # A start from the prior is the best of a few.
    assert evaluations == proposals + N_COMPARED
    # One more learns the shapes, before the chain begins.
    assert len(Recorder.seen) == evaluations + 1
    assert len(set(Recorder.seen)) == len(Recorder.seen)
