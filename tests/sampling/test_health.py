"""What chains say of their health, by ``sample_dram`` and by the step method."""

import json
import logging
import re
from types import SimpleNamespace

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice import noise
from pymc_statespace_filters.facts import sentences
from pymc_statespace_filters.sampling import DRAM
from pymc_statespace_filters.sampling.kernel import state
from pymc_statespace_filters.sampling.output import likelihood_variance
from pymc_statespace_filters.sampling.output.facts import EndedChain, NoisyStart
from pymc_statespace_filters.sampling.output.likelihood_variance import spread_of
from pymc_statespace_filters.sampling.output.phase_statistics import PhaseStatistics
from pymc_statespace_filters.sampling.target.target import Growth
from tests.kernels import with_kernel
from tests.sampling.test_dram import nan_beyond, sample, simple_model
from tests.sampling.test_sample_dram import sample_dram, state_space_model
from tests.systems import autoregression

LOGGER = "pymc.stats.convergence"


def runaway():
    with pm.Model() as model:
        pm.Normal("y", shape=2)
        pm.Flat("free")
    return model


def collapsing():
    """Three observations far from where the particles are, and a parameter of no consequence."""
    with pm.Model() as model:
        params = {"phi": 0.5, "initial_mean": 1e-9 * pm.Normal("m")}
        psf.StateSpace(
            "d", autoregression(spread=1.0, observation_noise=1e-4), psf.BootstrapPF(20),
            params=params, steps=[1, 2, 3], observed=[3.0, -3, 3],
        )  # fmt: skip
    return model


def both_ways(model, caplog, **settings):
    """Messages of chain 1 by ``sample_dram``, and of any chain by the step method."""
    run = {name: settings.pop(name) for name in ("draws", "tune") if name in settings}
    with caplog.at_level(logging.WARNING, logger=LOGGER):
        sample_dram(model, **with_kernel(run), **with_kernel(settings))
        named = [re.match(r"Chains? (?:\d and )?1: (.*)", m) for m in caplog.messages]
        whole = [match[1] for match in named if match]
        caplog.clear()
        with model:
            sample(DRAM(**settings), **run)
        stepwise = list(caplog.messages)
    return whole, stepwise


@pytest.mark.parametrize(
    ("model", "settings", "found", "cure"),
    [
        (
            simple_model(),
            {"proposal_cov": 1e12 * np.eye(2), "draws": 100, "tune": 0},
            "accepted 0 of 100 proposals",
            "proposal_cov",
        ),
        (  # frozen proposals so wide that few are accepted, even of the small ones
            simple_model(),
            {"proposal_cov": 300.0**2 * np.eye(2), "stages": 1, "draws": 4000, "tune": 0},
            "of 4000 proposals after warm-up: the chain hardly moves",
            "proposal_cov",
        ),
        (runaway(), {"draws": 500, "tune": 1000}, "proposals of free have become", "proper prior"),
        (nan_beyond(0.0), {"draws": 500}, "the log-density is NaN", "truncated"),
        (
            collapsing(),
            {"draws": 300, "tune": 100, "refresh_noise": False},
            "In 300 of 300 draws the particles collapsed",
            "Use EKF(), which computes this likelihood without particles.",
        ),
    ],
)
def test_chains_name_themselves_and_the_cure(model, settings, found, cure, caplog):
    for messages in both_ways(model, caplog, **settings):
        assert messages
        assert all(found in message and cure in message for message in messages)


def test_healthy_chains_are_silent(caplog):
    for model in (simple_model(), state_space_model(psf.EKF())):
        assert both_ways(model, caplog, draws=1000, tune=1000) == ([], [])


def draws_with(stages):
    n = len(stages)
    counts = np.zeros((n, state.N_COUNTS), dtype=np.int64)
    counts[:, state.STAGE] = stages
    counts[:, state.N_ACCEPTED] = counts[:, state.STAGE] > 0
    counts[:, state.N_EVALUATIONS] = 1
    numbers = np.full((n, state.N_NUMBERS), np.inf)
    none = np.empty((n, 0))
    return state.Draws(none, numbers, counts, none.astype(np.int64), np.empty((0, 1, 1)))


@pytest.mark.parametrize(
    ("stages", "longest"),
    [
        ([0, 0, 0], 3),
        ([1, 1, 2], 1),
        ([0, 0, 1, 0, 1], 2),
        ([1, 0, 0, 0, 2, 0], 4),
        ([2, 1, 0, 0, 0], 4),
    ],
)
def test_stays_are_counted_at_once_and_one_by_one(stages, longest):
    draws = draws_with(stages)
    whole, record = PhaseStatistics.from_draws(draws, 0, len(stages)), PhaseStatistics()
    for row in range(len(stages)):
        record = record.include(draws, row)
    assert whole == record
    assert whole.longest_dwell == longest


def said_of(statistics, growth=None, filter=None):
    """The sentence about a chain, of a model with this filter; None if all is well."""
    model = simple_model() if filter is None else state_space_model(filter)
    (text, *_) = [*sentences(EndedChain(SimpleNamespace(model=model), statistics, growth)), None]
    return text


def test_a_stay_of_a_fifth_of_the_draws_is_said():
    moving = np.tile([1, 0], 400)
    stuck = np.concatenate([moving, [1], np.zeros(205, dtype=int), [1]])
    assert said_of(PhaseStatistics.from_draws(draws_with(moving), 0, 800)) is None
    phase = PhaseStatistics.from_draws(draws_with(stuck), 0, len(stuck))
    text, of_noise = said_of(phase), said_of(phase, filter=psf.BootstrapPF(20))
    assert "stayed at one point for 206 of 1007 iterations" in text
    assert "more particles" not in text
    assert "more particles" in of_noise
    # Of few draws a fifth is soon passed by chance.
    few = np.concatenate([moving[:100], np.zeros(90, dtype=int)])
    assert said_of(PhaseStatistics.from_draws(draws_with(few), 0, len(few))) is None


def test_a_chain_hardly_moves_below_the_rate_at_which_its_bar_turns_red():
    stages = np.zeros(6000, dtype=int)
    stages[:: 6000 // 59] = 1
    record = PhaseStatistics.from_draws(draws_with(stages[:5950]), 0, 5950)
    assert record.moved == 59
    assert "accepted 59 of 5950 proposals" in said_of(record)
    assert said_of(record._replace(iterations=5900)) is None


def test_growth_below_the_limit_is_silent():
    record = PhaseStatistics.from_draws(draws_with(np.tile([1, 0], 400)), 0, 800)
    assert said_of(record, Growth("x", 900.0)) is None
    assert "proposals of x" in said_of(record, Growth("x", 1100.0))


# The spread of the estimates over seeds.


def test_the_spread_at_the_highest_draw(caplog):
    """Variance of the estimates with 20 particles and with few: against many seeds at the mode."""
    model = state_space_model(psf.BootstrapPF(20))
    with caplog.at_level(logging.WARNING, logger=LOGGER):
        tree = sample_dram(model, draws=700, chains=2)
    assert "variance" not in caplog.text
    assert json.loads(tree.attrs["filter"]) == {"d0": "BootstrapPF(20)"}
    found = tree.attrs["log_likelihood_variance"]
    logp = model.compile_logp()
    (seed,) = [v for v in logp.f.get_shared() if v.name == "d0_seed"]
    best = tree["sample_stats"]["lp"].argmax(...)
    at = {"phi": tree["posterior"]["phi"].isel(best).to_numpy()}
    estimates = []
    for i in range(400):
        seed.set_value(np.array(7919 * i + 1))
        estimates.append(float(logp(at)))
    # Of 12 seeds; Gaussian errors leave these limits in 3 of 1000 runs.
    assert 0.15 < found / np.var(estimates, ddof=1) < 3.0
    again = sample_dram(model, draws=700, chains=2, cores=1)
    assert again.attrs["log_likelihood_variance"] == found


@pytest.mark.parametrize(
    ("filter", "settings"),
    [
        (psf.EKF(), {"draws": 700}),
        (psf.BootstrapPF(20), {"draws": 300}),
        (psf.BootstrapPF(20), {"draws": 700, "refresh_noise": False}),
    ],
)
def test_the_spread_is_measured_where_it_says_something(filter, settings):
    tree = sample_dram(state_space_model(filter), **with_kernel(settings))
    assert "log_likelihood_variance" not in tree.attrs


def test_spreads_far_outside_are_said(caplog, monkeypatch):
    model = state_space_model(psf.BootstrapPF(20))
    quiet = sample_dram(model, draws=700)
    monkeypatch.setattr(noise, "HOPELESS", 1e-3)
    monkeypatch.setattr(noise, "TOO_NOISY", 1e-3)
    with caplog.at_level(logging.WARNING, logger=LOGGER):
        tree = sample_dram(model, draws=700)
    assert "at the start" not in caplog.text  # which the chains have left
    assert "at its highest draw: the estimated log-likelihood has a variance of" in caplog.text
    # Measuring takes no random number from the chains.
    np.testing.assert_array_equal(tree["posterior"]["phi"], quiet["posterior"]["phi"])


def test_a_noisy_start_is_said_where_the_chain_still_stands(caplog, monkeypatch):
    monkeypatch.setattr(noise, "HOPELESS", 1e-3)
    model = state_space_model(psf.BootstrapPF(3))
    with caplog.at_level(logging.WARNING, logger=LOGGER):
        tree = sample_dram(model, draws=700, tune=0, kernel={"proposal_cov": [[1e12]]})
    stood = (tree["sample_stats"]["stage"][:, :100] == 0).all("draw").to_numpy()
    assert stood.any()
    for chain_, has_stood in enumerate(stood):
        message = f"Chain {chain_}, at the start: the estimated log-likelihood has"
        assert (message in caplog.text) == has_stood


def test_a_noisy_start_may_be_left():

    def said(estimates):
        return sentences(NoisyStart(simple_model(), 3, spread_of(estimates)))

    noisy = 6.0 * np.random.default_rng(1).normal(size=12)
    assert 10.0 < spread_of(noisy).variance < likelihood_variance.HOPELESS
    assert said(noisy) == []
    (message,) = said(3.0 * noisy)
    assert message.startswith("Chain 3, at the start:")
    assert "initvals" in message
    assert "suggest_particles" in message
    assert said(np.full(12, -np.inf)) == []
