"""What chains have missed is said of a model's parameters, after a run and with an evidence."""

import logging
import re

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice import missed as end_of_run
from pymc_statespace_filters.checks.coverage import sentences
from pymc_statespace_filters.checks.coverage.sentences import store, stored, unvisited

N = 2500


def model_of(prior):
    with pm.Model() as model:
        prior()
    return model


def cut_normals():
    """Standard normals (4, N, 1) above -0.8, and their log-densities."""
    z = np.random.default_rng(1).standard_normal((4, 2 * N, 1))
    z = np.stack([one[one[:, 0] > -0.8][:N] for one in z])
    return z, -0.5 * z[..., 0] ** 2


@pytest.mark.parametrize(
    ("prior", "region"),
    [
        (lambda: pm.Normal("a"), "a is below -0."),
        (lambda: pm.LogNormal("a"), r"a is below 0\.[45]"),
        (lambda: pm.Normal("a", shape=1), r"a\[0\] is below -0."),
        (lambda: pm.TruncatedNormal("a", upper=0.0, initval=-1.0), "a is above -"),
    ],
)
def test_the_region_is_in_the_units_of_the_model(prior, region):
    """A bound from above alone is transformed by a decreasing function."""
    draws, log_density = cut_normals()
    (sentence,) = unvisited(
        model_of(prior),
        draws,
        log_density,
        lambda x, rng: -0.5 * x[:, 0] ** 2,
        100.0,
        np.random.default_rng(1),
    )
    assert re.search(region, sentence), sentence


def test_the_outcome_is_kept_with_the_draws():
    tree = xr.DataTree()
    assert stored(tree) is None
    store(tree, ["one"])
    assert stored(tree) == ["one"]


def test_an_evidence_of_draws_that_lack_a_tail_is_doubted():
    z, _ = cut_normals()
    posterior = xr.Dataset({"mu": (("chain", "draw"), z[..., 0])})
    idata = xr.DataTree.from_dict({"posterior": posterior})
    with pm.Model() as model:
        mu = pm.Normal("mu")
        pm.Potential("nothing", 0.0 * mu)
    with pytest.warns(
        psf.errors.EvidenceWarning, match="missed a part of the posterior where mu is below"
    ):
        found = psf.chib_jeliazkov(idata, model, random_seed=1, progressbar=False)
    assert "of the draws lie there" in found.doubts
    store(idata, [])  # a run that was checked is not checked again
    assert psf.chib_jeliazkov(idata, model, random_seed=1, progressbar=False).doubts == ""


@pytest.mark.parametrize("sampler", ["dram", "nuts"])
def test_a_run_warns_and_keeps_what_it_has_found(sampler, monkeypatch, caplog):
    call, said = {"tune": 300, "sampler": sampler, "random_seed": 1, "progressbar": False}, []

    def found(*args):
        said.append(args)
        return ["the chains have missed it"]

    with pm.Model():
        mu = pm.Normal("mu")
        pm.Normal("y", mu, 1.0, observed=[0.3, 0.1])
        right = psf.sample(1000, **call)
        monkeypatch.setattr(end_of_run, "unvisited", found)
        with caplog.at_level(logging.DEBUG, logger="pymc.stats.convergence"):
            missed = psf.sample(1000, **call)
            few = psf.sample(400, **call)
    assert stored(right) == []
    assert stored(missed) == ["the chains have missed it"]
    assert "The chains have missed it." in caplog.text
    assert caplog.text.count("No problems found.") == 1  # of the short run
    assert stored(few) is None
    assert len(said) == 1
    np.testing.assert_array_equal(right["posterior"]["mu"], missed["posterior"]["mu"])


def test_a_pause_while_the_time_is_measured_does_not_end_the_check(monkeypatch):
    """As a collection of garbage is one: the processor is busy, and the evaluations wait."""
    clock, calls = iter(np.cumsum([0, 9.0, 0, 1e-5, 0, 1e-5])), []
    monkeypatch.setattr(sentences.time, "process_time", lambda: next(clock))
    draws, log_density = cut_normals()

    def evaluate(x, rng):
        calls.append(len(x))
        return -0.5 * x[:, 0] ** 2

    assert unvisited(
        model_of(lambda: pm.Normal("a")),
        draws,
        log_density,
        evaluate,
        1.0,
        np.random.default_rng(1),
    )
    assert sum(calls) > 100


def test_points_far_from_the_draws_may_take_longer(monkeypatch):
    """As by a grid; the lines on which copies are looked for are as wide as the prior."""
    clock = [0.0]
    monkeypatch.setattr(sentences.time, "process_time", lambda: clock[0])

    def evaluate(x, rng):
        clock[0] += np.where(np.abs(x[:, 0]) < 20.0, 1e-4, 0.1).sum()
        return -0.5 * x[:, 0] ** 2

    rng = np.random.default_rng(1)
    draws = rng.standard_normal((4, N, 1))
    prior = 100.0 * rng.standard_normal((2000, 1))
    unvisited(
        model_of(lambda: pm.Normal("a")),
        draws,
        -0.5 * draws[..., 0] ** 2,
        evaluate,
        2.0,
        rng,
        prior,
    )
    assert 0.0 < clock[0] < 6.0
