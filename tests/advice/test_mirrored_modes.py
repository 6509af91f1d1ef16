"""Modes at both signs of a scale are one cause, which is named once."""

import logging

import numpy as np
import pymc as pm

import pymc_statespace_filters as psf

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
