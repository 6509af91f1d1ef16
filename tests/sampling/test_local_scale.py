"""Chains that start where the user says have proposals of the scale of the density there."""

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.sampling.starts.local_scale import local_cov
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from pymc_statespace_filters.sampling.target.target import Target

SD = np.array([1e-8, 1e-3, 1e9])


def narrow():
    """Three normal variables: two are seen precisely, of the third nothing is."""
    with pm.Model() as model:
        x = pm.Normal("x", 0.0, 1.0, shape=3)
        pm.Normal("y", x, SD, observed=[0.5, -0.3, 0.0])
    return model


def test_lengths_are_within_a_step_of_the_grid_and_at_most_the_priors():
    """Two nats are two standard deviations from the maximum; the grid has a factor of four."""
    target = Target(narrow(), None, RandomWalkSettings())
    cov = local_cov(target, np.array([0.5, -0.3, 0.0]))
    lengths = np.sqrt(np.diag(cov) * 3) / 2.38
    assert ((0.5 * SD < lengths) & (lengths <= 2.0 * SD))[:2].all()
    assert lengths[2] == pytest.approx(1.0, abs=0.2)
    far = np.sqrt(np.diag(local_cov(target, np.array([0.5, 0.7, 0.0]))) * 3) / 2.38
    assert far[1] < 1e-2 * SD[1]  # a slope of a million nats


def test_no_length_without_a_density():
    with pm.Model() as model:
        pm.Potential("above", pm.math.switch(pm.Normal("x") > 1.0, 0.0, -np.inf))
    assert local_cov(Target(model, None, RandomWalkSettings()), np.zeros(1)) is None


def test_a_chain_at_the_maximum_moves():
    """The posterior is 1e8 times narrower than the prior: with its scale nothing is accepted."""
    found = psf.sample_dram(
        1000, 300, model=narrow(), initvals={"x": [0.5, -0.3, 0.0]}, random_seed=1,
        progressbar=False, compute_convergence_checks=False,
    )  # fmt: skip
    sd = found["posterior"]["x"].std(("chain", "draw")).values
    np.testing.assert_allclose(sd, [1e-8, 1e-3, 1.0], rtol=0.3)
