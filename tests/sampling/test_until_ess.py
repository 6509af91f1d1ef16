"""Sampling until an effective sample size is reached: where it stops, and that nothing else counts.

The draws of a seed do not depend on how many are made, so that a long run contains every shorter
one: it says where a run with ``until_ess`` has to stop.
"""

import itertools
import logging

import arviz as az
import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import DataMismatchError
from pymc_statespace_filters.sampling.output.chain_bars import ChainProgress
from pymc_statespace_filters.sampling.output.convergence import MAX_RHAT, convergence
from pymc_statespace_filters.sampling.run import chain_task, model_task, scheduler
from pymc_statespace_filters.sampling.run.thread_pool import ChainPool
from tests.interrupts import interrupt
from tests.sampling.test_dram import simple_model
from tests.sampling.test_sample_dram import LOGGER, assert_identical, sample_dram

RULE = {"draws": 100, "tune": 200, "chains": 3, "until_ess": 300}


def plane():
    """A model without transforms, so that R-hat is the same on the unconstrained space."""
    with pm.Model() as model:
        pm.Normal("a")
        pm.Normal("b", shape=2)
    return model


def line():
    """A model that stops sooner."""
    with pm.Model() as model:
        pm.Normal("a")
    return model


def draws_of(tree):
    """Draws of all parameters, shape (chains, n, d)."""
    stacked = tree["posterior"].to_dataset().to_stacked_array("x", ["chain", "draw"])
    return stacked.transpose("chain", "draw", "x").to_numpy()


def lengths():
    """Draws after which the rule looks: half as many again each time."""
    n = RULE["draws"]
    while True:
        yield n
        n += (n + 1) // 2


@pytest.fixture(scope="module")
def model():
    return plane()


@pytest.fixture(scope="module")
def stopped(model):
    return sample_dram(model, **RULE)


# The diagnostics.


def test_diagnostics_are_those_of_arviz(stopped):
    """Of az.ess(method="bulk") and az.rhat(method="rank"), their defaults."""
    draws = draws_of(stopped)
    found = convergence(list(draws))
    for values, function in ((found.ess, az.ess), (found.rhat, az.rhat)):
        of_arviz = function(stopped["posterior"].to_dataset())
        expected = np.concatenate([np.ravel(of_arviz[name]) for name in ("a", "b")])
        np.testing.assert_allclose(values, expected, rtol=1e-12)
    alone = convergence([draws[0]])
    n = draws.shape[1] // 2
    halves = draws[0, : 2 * n].reshape(2, n, -1)
    np.testing.assert_allclose(alone.rhat, convergence(list(halves)).rhat, rtol=1e-12)
    of_first = az.ess(stopped["posterior"].to_dataset().isel(chain=[0]))
    assert alone.ess[0] == pytest.approx(float(of_first["a"]), rel=1e-12)


def test_the_effective_sample_size_of_a_scale_is_that_of_its_logarithm():
    tree = sample_dram(simple_model(), draws=300)
    draws = draws_of(tree)
    logs = np.where([False, True], np.log(np.abs(draws)), draws)  # mu, sigma
    expected = az.ess(tree["posterior"].to_dataset())
    found = convergence(list(logs)).ess
    np.testing.assert_allclose(found, [expected["mu"], expected["sigma"]], rtol=1e-12)


def test_chains_of_different_lengths_and_chains_that_never_moved():
    rng = np.random.default_rng(1)
    chains = [rng.normal(size=(n, 2)) for n in (300, 250, 3)]
    np.testing.assert_array_equal(
        convergence(chains), convergence([chain[:250] for chain in chains[:2]])
    )
    assert convergence([chain[:3] for chain in chains]) is None
    still = convergence([np.ones((100, 1)), np.ones((100, 1))])
    assert (still.ess, still.rhat) == (0.0, np.inf)
    apart = convergence([np.ones((100, 1)), np.zeros((100, 1))])
    assert not apart.reaches(1e-9)


def test_chains_that_disagree_are_not_converged():
    """Two modes: enough draws of each, and R-hat above the limit."""
    rng = np.random.default_rng(2)
    found = convergence([rng.normal(loc=m, size=(100_000, 1)) for m in (0.0, 0.3)])
    assert found.ess[0] > 40.0
    assert found.rhat[0] > MAX_RHAT
    assert not found.reaches(40.0)


def test_few_draws_of_many_say_nearly_the_same(stopped):
    chains = list(draws_of(stopped))
    few = convergence(chains, most_draws=len(chains[0]) // 3)
    assert 0.3 < few.ess.min() / convergence(chains).ess.min() < 1.1


# While chains run.


def test_the_bar_shows_what_the_draws_so_far_say(model, stopped, monkeypatch):
    """In each round; at the end it is what ArviZ says of the draws that are returned."""
    shown, show = [], ChainProgress.show_convergence

    def watched(bars, number, rhat, ess):
        shown.append((rhat, ess))
        show(bars, number, rhat, ess)

    monkeypatch.setattr(scheduler, "_SECONDS", 0.0)
    monkeypatch.setattr(scheduler, "_SHARE", 1e9)
    monkeypatch.setattr(ChainProgress, "show_convergence", watched)
    assert_identical(sample_dram(model, **RULE | {"progressbar": True}), stopped)
    found = convergence(list(draws_of(stopped)))
    assert shown[-1] == (found.rhat.max(), found.ess.min())
    assert len(shown) > 3


def test_the_seconds_of_all_rounds_count(model, monkeypatch):
    """They are the speed that the bar of a quick chain shows."""
    ended, update = {}, ChainProgress.update

    def watched(bars, number, done, stats, seconds):
        ended.setdefault(number, []).append(seconds)
        update(bars, number, done, stats, seconds)

    monkeypatch.setattr(ChainProgress, "update", watched)
    sample_dram(model, **RULE)
    for seconds in ended.values():
        lasting = [value for value in seconds if value > 0.0]
        assert len(lasting) > 2
        assert lasting == sorted(lasting)


def test_without_a_bar_or_checks_nothing_is_computed(model, monkeypatch):
    monkeypatch.setattr(model_task, "convergence", None)
    run = {"compute_convergence_checks": False, "draws": 50}
    for progressbar in (False, "split"):
        sample_dram(model, progressbar=progressbar, **run)


# Where it stops.


def test_it_stops_at_the_first_length_that_suffices(model, stopped):
    n = stopped["posterior"].sizes["draw"]
    assert n > RULE["draws"]
    long = sample_dram(model, **RULE | {"until_ess": None, "draws": n})
    assert_identical(stopped, long)
    for length in itertools.takewhile(lambda length: length <= n, lengths()):
        found = convergence(list(draws_of(long)[:, :length]))
        suffices = found.ess.min() >= RULE["until_ess"] and found.rhat.max() <= MAX_RHAT
        assert suffices == (length == n)


def test_nothing_is_added_to_draws_that_suffice(model, stopped, caplog):
    """And no limit was met."""
    n = stopped["posterior"].sizes["draw"]
    with caplog.at_level(logging.WARNING, logger=LOGGER):
        again = sample_dram(model, **RULE | {"draws": n, "max_draws": n})
    assert_identical(again, stopped)
    assert "until_ess" not in caplog.text


@pytest.mark.parametrize("changes", [{"cores": 1, "progressbar": True}, {"cores": 5}])
def test_threads_and_bars_change_nothing(model, stopped, changes):
    assert_identical(sample_dram(model, **RULE | changes), stopped)


def test_the_warm_up_is_kept(model, stopped):
    tree = sample_dram(model, **RULE | {"discard_tuned_samples": False})
    np.testing.assert_array_equal(draws_of(tree), draws_of(stopped))
    assert tree["warmup_posterior"].sizes["draw"] == RULE["tune"]
    assert "draw" not in tree["sample_stats"]["proposal_cov"].dims


def test_each_model_stops_on_its_own(model, stopped):
    models = {"one": model, "other": line()}
    trees = psf.run_models(
        models, sampler="dram", random_seed=1, progressbar=False, cores=2, **RULE
    )
    assert_identical(trees["one"], stopped)
    alone = sample_dram(models["other"], **RULE)
    assert_identical(trees["other"], alone)
    assert alone["posterior"].sizes["draw"] != stopped["posterior"].sizes["draw"]


def test_a_limit_is_said_with_what_was_reached(model, caplog):
    with caplog.at_level(logging.WARNING, logger=LOGGER):
        tree = sample_dram(model, **RULE | {"max_draws": 170})
    assert tree["posterior"].sizes["draw"] == 170
    (message,) = [text for text in caplog.messages if "until_ess" in text]
    found = convergence(list(draws_of(tree)))
    assert "until_ess=300 was not reached with 170 iterations of each chain" in message
    assert f"effective sample size is {found.ess.min():.0f} (" in message
    assert f"R-hat {found.rhat.max():.3f} (" in message


# Interruptions.


@pytest.fixture
def often(monkeypatch):
    monkeypatch.setattr(chain_task, "CHECKPOINT_SECONDS", 0.0)


@pytest.mark.parametrize("blocks", [1, 20])
def test_a_run_that_died_goes_on_as_if_it_had_not(
    model, stopped, tmp_path, often, monkeypatch, blocks
):
    """In the first round and in a later one, with another number of threads."""
    made, advance = itertools.count(), chain_task.ChainTask._advance

    def die(self):
        if next(made) == blocks:
            raise MemoryError("no more")
        advance(self)

    with monkeypatch.context() as patch:
        patch.setattr(chain_task.ChainTask, "_advance", die)
        with pytest.raises(MemoryError):
            sample_dram(model, checkpoint=tmp_path, **RULE | {"cores": 1})
    found = sample_dram(model, checkpoint=tmp_path, **RULE)
    assert_identical(found, stopped)
    monkeypatch.setattr(chain_task.ChainTask, "_advance", None)  # it is read back
    assert_identical(sample_dram(model, checkpoint=tmp_path, **RULE), stopped)


@pytest.mark.usefixtures("interrupts_arrive")
def test_ctrl_c_in_a_later_round_returns_what_is_there(model, stopped, tmp_path, monkeypatch):
    finished, go_on, rounds = ChainPool.finished, ChainPool.go_on, []

    def counted(pool, number, goal):
        if goal is not None and goal[0] > RULE["tune"] + RULE["draws"]:
            rounds.append(goal[0])
        go_on(pool, number, goal)

    def interrupted(pool, *seconds):
        if rounds:
            interrupt()
        return finished(pool, *seconds)

    with monkeypatch.context() as patch:
        patch.setattr(ChainPool, "go_on", counted)
        patch.setattr(ChainPool, "finished", interrupted)
        part = draws_of(sample_dram(model, checkpoint=tmp_path, **RULE))
    assert rounds[:1] == [RULE["tune"] + 150]
    assert 100 <= part.shape[1] <= 150
    # Of chains of different lengths those are returned that together have most draws.
    begun = [whole[: part.shape[1]] for whole in draws_of(stopped)]
    same = [[i for i, one in enumerate(begun) if np.array_equal(one, own)] for own in part]
    assert all(len(found) == 1 for found in same)
    assert len({found[0] for found in same}) == len(part) >= 2
    assert_identical(sample_dram(model, checkpoint=tmp_path, **RULE), stopped)


def test_a_checkpoint_of_another_rule(model, tmp_path):
    sample_dram(model, checkpoint=tmp_path, **RULE)
    for changes, message in (
        ({"until_ess": 301}, r"until_ess: the checkpoint has 300.0, this run has 301.0"),
        ({"max_draws": 1000}, r"max_draws: the checkpoint has 2000, this run has 1000"),
        ({"until_ess": None}, r"until_ess: the checkpoint has 300.0, this run has null"),
    ):
        with pytest.raises(DataMismatchError, match=message):
            sample_dram(model, checkpoint=tmp_path, **RULE | changes)
