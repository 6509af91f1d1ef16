"""Noise under which chains would hardly move is named before they begin, with what does."""

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice import noise
from pymc_statespace_filters.facts import sentences
from pymc_statespace_filters.sampling.output.facts import NoisyStarts
from pymc_statespace_filters.sampling.output.likelihood_variance import spread_of
from pymc_statespace_filters.sampling.run import population_search
from pymc_statespace_filters.sampling.run.chain import Chain
from pymc_statespace_filters.sampling.starts.modes import Points
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from pymc_statespace_filters.sampling.target.target import Target
from tests.systems import autoregression, simulated

STEPS = range(1, 41)


def seen_precisely(filter):
    """A linear state, seen forty times."""
    with pm.Model() as model:
        params = {"phi": pm.Uniform("phi", 0.0, 1.0), "spread": 1.0}
        observed = simulated(STEPS, 1, 0.8, 1.0)
        psf.StateSpace("d", autoregression(), filter, steps=STEPS, observed=observed, params=params)
    return model


def said_of(filter):
    model = seen_precisely(filter)
    target = Target(model, None, RandomWalkSettings())
    target.prepare()
    found = Points(np.array([[0.9], [1.4], [1.9]]), np.array([-3.0, -1.0, -2.0]), np.zeros(3, int))
    said = sentences(NoisyStarts(model, target, found, np.random.default_rng(1)))
    return said[0] if said else None


def test_a_filter_that_was_seen_to_do_is_named():
    said = said_of(psf.BootstrapPF(4))
    assert said.startswith("At a typical one of the starts the estimated log-likelihood has a var")
    assert "With EKF() the variance is zero there, and an evaluation takes 0." in said
    assert said.endswith("times as long: give the model this filter.")


def test_a_filter_that_takes_a_hundred_times_as_long(monkeypatch):
    spreads = iter([(spread_of(np.linspace(-9.0, 9.0, 12)), 1.0), (spread_of(np.zeros(12)), 123.4)])
    monkeypatch.setattr(noise, "_measured", lambda *_: next(spreads))
    assert "an evaluation takes 120 times as long" in said_of(psf.BootstrapPF(4))


def test_a_filter_that_is_none_or_does_not_is_not_named(monkeypatch):
    for filters in (None, {"d": psf.BootstrapPF(3)}):
        monkeypatch.setattr(noise, "_quieter", lambda _, filters=filters: filters)
        said = said_of(psf.BootstrapPF(4))
        assert "times as many would bring it between 1 and 3.3" in said
        assert "With" not in said


def test_of_a_filter_with_a_bias_no_other_is_named():
    """Whose posterior would be another."""
    assert noise._quieter(seen_precisely(psf.EnKF(3))) is None
    assert noise._quieter(seen_precisely(psf.BootstrapPF(3))) == {"d": psf.EKF()}


def test_nothing_is_said_of_noise_that_lets_chains_move():
    assert said_of(psf.BootstrapPF(1000)) is None


def test_nothing_is_said_of_a_single_low_estimate(monkeypatch):
    low = spread_of(np.append(np.linspace(-1.0, 1.0, 11), -30.0))
    assert low.variance > 70.0
    monkeypatch.setattr(noise, "_measured", lambda *_: (low, 1.0))
    assert said_of(psf.BootstrapPF(1000)) is None


@pytest.mark.parametrize(("tune", "is_said"), [(800, True), (500, False)])
def test_it_is_said_before_the_chains_begin(tune, is_said, caplog, monkeypatch):
    """But not in runs of fewer than 600 iterations, which measure no noise."""
    said = []

    def start(chain, *arguments, _start=Chain.start):
        said.append("typical one of the starts" in caplog.text)
        return _start(chain, *arguments)

    monkeypatch.setattr(Chain, "start", start)
    psf.sample_dram(
        10, tune, chains=2, model=seen_precisely(psf.BootstrapPF(4)), random_seed=1,
        progressbar=False, compute_convergence_checks=False,
    )  # fmt: skip
    assert said == [is_said] * 2


@pytest.mark.parametrize("was_said", [True, False])
def test_noise_that_was_named_is_not_named_again_at_the_end(was_said, caplog, monkeypatch):
    if not was_said:
        monkeypatch.setattr(noise, "_measured", lambda *_: (spread_of(np.zeros(12)), 1.0))
    tree = psf.sample_dram(
        10, 800, chains=2, model=seen_precisely(psf.BootstrapPF(4)), random_seed=1,
        progressbar=False, compute_convergence_checks=False,
    )  # fmt: skip
    assert tree.attrs["log_likelihood_variance"] > 10.0
    assert ("typical one of the starts" in caplog.text) is was_said
    assert ("at its highest draw" in caplog.text) is not was_said


def test_an_interrupt_of_the_measurement_loses_no_starts(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    def run():
        return psf.sample_dram(
            10, 800, chains=1, model=seen_precisely(psf.BootstrapPF(4)), random_seed=1,
            progressbar=False, compute_convergence_checks=False, checkpoint=tmp_path / "run",
        )  # fmt: skip

    with monkeypatch.context() as patched:
        patched.setattr(noise, "_measured", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run()
    monkeypatch.setattr(population_search, "find_population", None)
    assert run()["posterior"].sizes["draw"] == 10
