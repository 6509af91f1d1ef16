"""A parameter whose sign has no meaning is named, and other symmetric ones are not."""

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
