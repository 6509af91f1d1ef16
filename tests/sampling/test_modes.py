"""Separate modes of a posterior are reported, curved and skewed ones are not taken for several."""

import logging

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.sampling.starts import population


def reported(caplog):
    return [r.message for r in caplog.records if "separate modes" in r.message]


def mixture(*modes, sd=0.05):
    """Of (weight, place of the scale) in logarithms, and of a flat direction."""
    with pm.Model() as model:
        scale, flat = pm.LogNormal("scale", 0.0, 3.0), pm.Normal("flat", 0.0, 1.0)
        terms = [
            pt.log(w) + pm.logp(pm.Normal.dist(np.log(at), sd), pt.log(scale)) for w, at in modes
        ]
        pm.Potential("likelihood", pt.logsumexp(pt.stack(terms)) + 0.0 * flat)
    return model


def test_two_modes_are_reported_in_the_models_units(caplog):
    """Shares are within 0.15 of 0.7 and 0.3: seven standard deviations of those over seeds."""
    model = mixture((0.7, 0.05), (0.3, 20.0))
    psf.find_starts(model, random_seed=1, progressbar=False)
    (message,) = reported(caplog)
    assert caplog.records[0].name == "pymc.stats.convergence"
    assert caplog.records[0].levelno == logging.WARNING
    assert message.startswith("The posterior has 2 separate modes: at scale=")
    places = [float(part.split(" ")[0]) for part in message.split("scale=")[1:]]
    shares = [float(part.split(",")[0]) for part in message.split("share ")[1:]]
    heights = [float(part.split(")")[0]) for part in message.split("log-density ")[1:]]
    np.testing.assert_allclose(sorted(places), [0.05, 20.0], rtol=0.1)
    assert shares[places.index(min(places))] == pytest.approx(0.7, abs=0.15)
    assert sum(shares) == pytest.approx(1.0, abs=0.011)
    # the peak of each: the likelihood's, the priors' of log(scale) and of flat
    log_normal = -0.5 * np.log(2 * np.pi)
    for place, height in zip(places, heights, strict=True):
        weight = 0.7 if place < 1 else 0.3
        peak = np.log(weight / 0.05) + log_normal - 0.5 * (np.log(20) / 3) ** 2 - np.log(3)
        assert height == pytest.approx(peak + 2 * log_normal, abs=0.2)
    assert "flat" not in message
    assert "another order" not in message
    assert message.endswith("by psf.sample_smc(10_000, model=model).")


def test_modes_are_reported_by_sample_dram_with_the_name_of_the_model(caplog):
    models = {"one": mixture((1.0, 2.0)), "two": mixture((0.5, 0.05), (0.5, 20.0))}
    psf.run_models(models, sampler="dram", draws=20, tune=20, random_seed=1, progressbar=False)
    (message,) = reported(caplog)
    assert message.startswith("Model 'two': The posterior has 2 separate modes")


def test_modes_that_exchange_labels_are_called_so(caplog):
    with pm.Model() as model:
        means = pm.Normal("means", 0, 3, shape=2)
        sds = pm.HalfNormal("sds", 1, shape=2)
        halves = [pm.Normal.dist(means[i], sds[i]) for i in range(2)]
        data = np.concatenate([-2 + 0.2 * np.arange(-3, 4), 2 + 0.4 * np.arange(-3, 4)])
        pm.Mixture("d", [0.5, 0.5], halves, observed=data)
    psf.find_starts(model, random_seed=1, progressbar=False)
    (message,) = reported(caplog)
    assert "same values in another order" in message


def without_sign():
    """An autoregression seen through its square: its mean has two signs."""
    system = psf.StateSpaceModel(
        transition=lambda x, q, a, mean: [mean + a * (x[0] - mean) + q[0]],
        process_noise=lambda sigma: [[sigma**2]],
        observation=lambda x: [x[0] ** 2],
        observation_noise=[[0.05]],
        initial_mean=lambda mean: [mean],
        initial_cov=[[0.1]],
    )
    truth, steps = {"a": 0.9, "mean": 1.5, "sigma": 0.1}, np.arange(200)
    made = psf.simulate(system, truth, steps=steps, random_seed=4)
    with pm.Model() as model:
        pm.Uniform("a", 0, 1)
        pm.Normal("mean", 0, 3)
        pm.HalfNormal("sigma", 1)
        psf.StateSpace("d", system, psf.EKF(), steps=steps, observed=made["observations"].values)
    return model


def test_the_lost_sign_of_a_state_is_reported(caplog):
    psf.find_starts(without_sign(), random_seed=1, progressbar=False)
    (message,) = reported(caplog)
    places = sorted(float(part.split(" ")[0]) for part in message.split("mean=")[1:])
    np.testing.assert_allclose(places, [-1.5, 1.5], atol=0.2)
    assert "another order" not in message


def banana():
    with pm.Model() as model:
        x = pm.Normal("x", 0.0, [1.0, 3.0, 3.0, 3.0], shape=4)
        mean = pt.set_subtensor(x[1], x[1] + x[0] ** 2)[1:]
        pm.Normal("y", mean, 0.4, observed=[0.5, -2.0, 2.0])
    return model


def curved():
    with pm.Model() as model:
        x = pm.Normal("x", 0.0, 3.0, shape=3)
        pm.Potential("ridge", -0.5 * pt.sum(((x[1:] - 3.0 * x[0] ** 2) / 0.3) ** 2))
    return model


def skewed():
    with pm.Model() as model:
        pm.Gamma("x", 0.5, 1.0, shape=3)
        pm.StudentT("heavy", nu=2, mu=0, sigma=1)
        pm.Uniform("edge", 0.0, 1.0)
    return model


def funnel():
    with pm.Model() as model:
        v = pm.Normal("v", 0.0, 3.0)
        pm.Normal("x", 0.0, pt.exp(v / 2), shape=4)
    return model


@pytest.mark.parametrize("make", [banana, curved, skewed, funnel])
def test_one_mode_is_not_taken_for_several(make, caplog, monkeypatch):
    """Over three seeds, and at a cost of less than a twentieth of the search."""
    costs, densities, find = [], population._densities, population.find_modes

    def watched(*of):
        evaluate = densities(*of)
        return lambda x: (costs.append(len(x)), evaluate(x))[1]

    def looked_for(*of):
        before = sum(costs)
        found = find(*of)
        assert sum(costs) - before < 0.05 * before
        return found

    monkeypatch.setattr(population, "_densities", watched)
    monkeypatch.setattr(population, "find_modes", looked_for)
    model = make()
    for seed in range(3):
        psf.find_starts(model, random_seed=seed, progressbar=False)
    assert costs
    assert not reported(caplog)
