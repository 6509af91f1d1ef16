"""The race of samplers: who gives the draws, that no clock decides it, and what is said of it."""

import logging
import time
from functools import partial
from pathlib import Path

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters import advice
from pymc_statespace_filters.advice.remedies import reparametrise
from pymc_statespace_filters.sampling import chosen_sampler, race
from pymc_statespace_filters.sampling.choice import why_not_after_all
from pymc_statespace_filters.sampling.nuts.sample_nuts import sample_nuts
from pymc_statespace_filters.sampling.run import driver
from pymc_statespace_filters.sampling.run.request import RunArguments
from tests.interrupts import interrupt
from tests.sampling.test_nuts_starts import schools

CALL = {"random_seed": 1, "progressbar": False}


def stiff(n=30):
    """Normal, of widths from 1 to 1000: too many dimensions for the walk, few for NUTS.

    The axes are mirrored, which is no product of matrices: numba compiles none in half a minute.
    """
    axis = np.random.default_rng(0).normal(size=n)
    axis /= np.linalg.norm(axis)
    with pm.Model() as model:
        x = pm.Normal("x", 0, 1, shape=n)
        mirrored = x - 2.0 * axis * (axis * x).sum()
        pm.Normal("y", mirrored * np.geomspace(1.0, 1000.0, n), 1.0, observed=np.zeros(n))
    return model


def staircase():
    """Two levels before and after a year, of which 250 iterations of the walk are too few."""
    years = np.arange(30.0)
    with pm.Model() as model:
        year, low, high = pm.Uniform("year", 0, 30), pm.Normal("low"), pm.Normal("high")
        pm.Normal("y", pt.switch(year > years, low, high), 1.0, observed=np.sin(years) + years / 20)
    return model


def run(model, caplog, **call):
    caplog.clear()
    with caplog.at_level(logging.DEBUG, logger="pymc"):
        idata = psf.sample(model=model, **CALL | call)
    return idata, [r.getMessage() for r in caplog.records]


@pytest.fixture
def other_clock(monkeypatch):
    """Seconds a hundred times as long, as on a machine that others use."""
    for clock in (time.process_time, time.perf_counter, time.thread_time):
        monkeypatch.setattr(time, clock.__name__, partial(lambda of: 100.0 * of(), clock))


@pytest.fixture
def nuts_follows(monkeypatch):
    """NUTS follows a walk of as many iterations as draws, however long it takes."""
    for name, value in {"_FIRST": 1, "_WALK": 1, "_MARGIN": np.inf, "_MOST_SPENT": np.inf}.items():
        monkeypatch.setattr(race, name, value)


@pytest.fixture
def walks(monkeypatch):
    """The requests of the walks, as they are made."""
    made, sample_models = [], race.sample_models

    def noted(models, requests, *given):
        made.extend(requests)
        return sample_models(models, requests, *given)

    monkeypatch.setattr(race, "sample_models", noted)
    return made


def test_a_walk_that_is_quick_is_not_raced(caplog):
    idata, said = run(schools(centred=False), caplog)
    assert idata.attrs["sampler"] == "dram"
    assert idata.attrs["sampler_reason"].startswith("DRAM gave")
    assert not any("NUTS, started from its points" in text for text in said)


def test_a_walk_goes_on_longer_from_its_own_points(caplog, walks, monkeypatch):
    """With other random numbers, and by the draws of the last one alone, which reach the goal."""
    monkeypatch.setattr(race, "_FIRST", 1)
    idata, said = run(schools(centred=True), caplog)
    assert idata.attrs["sampler"] == "dram"
    assert idata.attrs["sampler_reason"].startswith("DRAM, restarted from its own points, gave")
    assert not any("NUTS, started from its points" in text for text in said)
    assert [walk.max_draws for walk in walks] == [1000 * 4**i for i in range(len(walks))]
    assert len({tuple(walk.entropy) for walk in walks}) == len(walks) > 1
    assert walks[0].pilot is None
    assert np.shape(walks[1].pilot) == (4000, 10)


def test_what_a_race_takes_is_bounded(caplog, walks):
    """Draws that are never worth enough: the walks at the end take no more than all before them."""
    call = {"draws": 20, "tune": 40, "chains": 2, "until_ess": 40.0}
    _, said = run(schools(centred=False), caplog, **call)
    (told,) = (
        text for text in said if text.startswith("DRAM, restarted from its own points, needs")
    )
    assert "DRAM, restarted from the better points," in told
    made = [walk.max_draws // 20 for walk in walks]
    assert made[:4] == [4, 16, 64, 256]
    most = 340 * (1 + race._MOST_SPENT) + 2000  # which NUTS makes before it is looked at
    assert 0 < sum(made[4:]) < 4 / 3 * most


def test_nuts_from_the_points_of_a_slow_walk(caplog, nuts_follows):
    idata, said = run(stiff(), caplog, draws=250)
    (told,) = (text for text in said if "NUTS, started from its points, gave" in text)
    assert idata.attrs["sampler_reason"] == told.removesuffix(".")
    assert not any("until_ess" in text for text in said)  # what the other lacks nobody needs


def test_in_very_many_dimensions_nuts_follows_the_first_walk(caplog, walks):
    """140 normal parameters, widths from 1 to 0.001: means are zero, within four errors."""
    idata, _ = run(stiff(140), caplog, draws=250, tune=400, chains=2)
    assert len(walks) == 1
    assert idata.attrs["sampler"] == "nuts"
    x = idata["posterior"]["x"].values
    assert abs(x.mean(axis=(0, 1)) / x.std(axis=(0, 1))).max() < 4 / np.sqrt(250)


def test_no_clock_decides(request, caplog, nuts_follows, monkeypatch):
    monkeypatch.setattr(chosen_sampler, "TIME_LIMIT", np.inf)  # which alone depends on one
    call = {"draws": 100, "tune": 200}
    first = run(stiff(8), caplog, **call)[0]
    assert "NUTS" in first.attrs["sampler_reason"]
    request.getfixturevalue("other_clock")
    again = run(stiff(8), caplog, **call)[0]
    assert again.attrs["sampler_reason"] == first.attrs["sampler_reason"]
    xr.testing.assert_equal(again["posterior"].to_dataset(), first["posterior"].to_dataset())


def test_the_walk_goes_on_where_nuts_diverges(caplog, nuts_follows):
    """At a neck, from the draws of NUTS; each has been tried, so no message sends to the other."""
    idata, said = run(schools(centred=True), caplog, draws=250)
    (told,) = (text for text in said if "DRAM, restarted from the better points," in text)
    assert "NUTS, started from its points, diverged in" in told
    assert idata.attrs["sampler_reason"] == told.removesuffix(".")
    assert idata.attrs["sampler"] in told.lower()
    assert not any("sampler=" in text or "psf.sample" in text for text in said)


def test_why_nuts_cannot_follow_after_all():
    assert why_not_after_all(staircase()) == "the likelihood is a staircase of year"
    assert why_not_after_all(stiff(2)) == ""


def test_the_walk_goes_on_from_its_own_points_where_nuts_cannot_follow(caplog, nuts_follows):
    idata, said = run(staircase(), caplog, draws=250)
    assert idata.attrs["sampler"] == "dram"
    assert idata.attrs["sampler_reason"] == "the likelihood is a staircase of year"
    assert any(text.startswith("DRAM, restarted from its own points, gave") for text in said)
    assert not any("NUTS, started from its points, " in text for text in said[1:])


@pytest.mark.parametrize("most", [500.0, 3000.0, np.inf])
def test_nuts_ends_where_it_takes_more_than_it_may(most):
    """In its warm-up, which leaves nothing, and later; how fast it runs counts for nothing."""
    points, runs = np.random.default_rng(0).normal(size=(400, 8)), []
    given = RunArguments(draws=100, tune=100, until_ess=399, max_draws=100, **CALL)
    options = given.options(None)._replace(told=lambda fact, begin: runs.append(fact))
    request = given.request()._replace(doubles_thin=True, max_draws=800)
    sample_nuts(stiff(8), request, options, "", points, most)
    (nuts,) = runs
    assert nuts.is_beaten == (most < np.inf)
    if nuts.is_beaten:  # whenever that was seen
        assert nuts.n_gradients == most + 1
    assert (nuts.n_gradients > most) == nuts.is_beaten
    assert (nuts.convergence is None) == nuts.is_beaten  # so that no walk starts from its draws


def test_no_words_name_a_sampler_as_a_remedy():
    for path in Path(advice.__file__).parent.glob("*.py"):
        assert "sampler=" not in path.read_text(), path


def test_parameters_that_move_together_are_named():
    rng = np.random.default_rng(1)
    common = rng.normal(size=(1000, 1))
    x = np.hstack([common + 0.1 * rng.normal(size=(1000, 3)), rng.normal(size=(1000, 1))])
    names = ["mass", "stiffness", "gain", "noise"]
    text = reparametrise(names, x, "gain")
    assert text.startswith("fix one of mass, stiffness and gain, which move together (correl")
    assert reparametrise(names, x, "noise") == "reparametrise noise"


@pytest.mark.usefixtures("interrupts_arrive")
def test_an_interrupted_race_says_nothing_of_the_limits_that_it_had(monkeypatch, caplog):
    """The first walk is complete and worth too little, and all that follows is interrupted."""
    n_walks, run_chains = 0, driver.run_chains

    def interrupted(*given, **settings):
        nonlocal n_walks
        n_walks += 1
        if n_walks > 1:
            interrupt()
        return run_chains(*given, **settings)

    monkeypatch.setattr(driver, "run_chains", interrupted)
    idata, said = run(stiff(), caplog, draws=100, tune=100, until_ess=100)
    assert (n_walks, idata["posterior"].sizes["draw"]) == (2, 100)
    assert any("400 draws in all are too few" in text for text in said)
    assert not any("until_ess=100 was not reached" in text for text in said)


def test_one_chain_of_nuts_is_one(caplog):
    _, said = run(schools(centred=False), caplog, draws=20, tune=20, chains=1, sampler="nuts")
    assert any(text.startswith("1 chain of 20 draws") for text in said)


def test_a_race_that_nobody_wins_does_not_say_that_it_took_too_long(caplog):
    """NUTS diverges in the neck of a funnel, and the walks after it are bounded by their number."""
    with pm.Model() as model:
        pm.Normal("x", 0, pm.math.exp(pm.Normal("v", 0, 3) / 2), shape=9)
    _, said = run(model, caplog, draws=200)
    (text,) = [text for text in said if "until_ess=400 was not reached" in text]
    assert "longer than it may" not in text
