"""A parameter whose sign has no meaning is named, and other symmetric ones are not."""

import logging

import numpy as np
import pymc as pm
import pytensor.tensor as pt

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice.signs import signs_message
from tests.modes import AS_IT_STANDS

DRAWS = np.random.default_rng(1).normal(size=(400, 3))


def message(scale):
    system = psf.StateSpaceModel(
        lambda x, q, s: [0.5 * x[0] + scale(s) * q[0]], process_noise=[[1.0]],
        observation=lambda x, k: [k * x[0]], observation_noise=[[0.1]],
        initial_mean=[1.0], initial_cov=[[0.0]],
    )  # fmt: skip
    with pm.Model() as model:
        for name in ("k", "other", "s"):
            pm.Normal(name)
        psf.StateSpace("d", system, psf.EKF(), steps=[1, 2], observed=[0.3, 0.2])
    density = model.compile_logp(mode=AS_IT_STANDS)

    def evaluate(x):
        return np.array([density(dict(zip(("k", "other", "s"), row, strict=True))) for row in x])

    return signs_message(model, DRAWS, evaluate)


def test_a_scale_with_a_normal_prior_is_named():
    """Neither a gain, whose sign the record tells, nor a variable that it does not depend on."""
    share = f"{(DRAWS[:, 2] < 0).mean():.0%}"
    assert f"is the same at s and -s, and {share} of the draws are negative" in message(lambda s: s)


def test_a_sign_that_matters_is_not_named():
    assert message(pt.exp) is None


# Modes at both signs of a scale are one cause, which is named once.


STEPS = np.arange(1, 61)
WALK = psf.StateSpaceModel(
    lambda x, q, s: [0.8 * x[0] + s * q[0]],
    process_noise=[[1.0]],
    observation=lambda x: [x[0]],
    observation_noise=[[0.05]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)


def test_a_scale_with_both_signs_has_one_message_and_no_modes(caplog):
    """Its density is symmetric, with two modes at ±0.5 that `find_modes` keeps apart."""
    simulated = psf.simulate(WALK, {"s": 0.5}, steps=STEPS, random_seed=0)
    with pm.Model() as model:
        pm.Normal("s", 0.0, 1.0)
        psf.StateSpace("d", WALK, psf.EKF(), steps=STEPS, observed=simulated["observations"].values)
    with caplog.at_level(logging.DEBUG, logger="pymc"):
        idata = psf.sample(300, model=model, sampler="dram", until_ess=None, random_seed=1,
                           progressbar=False)  # fmt: skip
    s = idata["posterior"]["s"].values
    assert (s < 0).any()
    assert (s > 0).any()
    assert "separate modes" not in caplog.text
    assert caplog.text.count("the density is the same at s and -s") == 0
    assert caplog.text.count("The density is the same at s and -s") == 1
    assert "No problems found" not in caplog.text
