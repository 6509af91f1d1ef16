"""Draws for a given seed are those of earlier versions, for one model per kind of filter.

The numbers are those of the version that brought starts in the posterior and independence
proposals. On one machine the draws are equal to the bit; the tolerance is for processors whose
vector code rounds differently.
"""

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf

STEPS = np.arange(0, 101, 10)
DATA = np.array([0.98, 1.13, 0.71, 1.2, 0.95, np.nan, 0.88, 1.02, 1.21, 0.84, 1.05])


def model_of(filter):
    system = psf.StateSpaceModel(
        transition=psf.EulerMaruyama(lambda x, a, b: [a * x[0] + b * x[0] ** 3], [[0.6]], dt=0.01),
        observation=lambda x: [x[0]],
        observation_noise=[[0.08]],
        initial_mean=[1.0],
        initial_cov=[[0.5]],
    )
    with pm.Model() as model:
        pm.Normal("a", 3.0, 1.0)
        pm.Normal("b", -3.0, 1.0)
        psf.StateSpace("d", system, filter, steps=STEPS, observed=DATA)
    return model


def last_draws(filter):
    """The last draw of each of two chains after 100 iterations, and its log-density."""
    with model_of(filter):
        idata = psf.sample_dram(
            60, tune=40, chains=2, random_seed=5, progressbar=False,
            compute_convergence_checks=False,
        )  # fmt: skip
    at = [idata.posterior[name].values[:, -1] for name in ("a", "b")]
    return np.array([*at, idata.sample_stats["lp"].values[:, -1]])


EXPECTED = {
    "EKF": [
        [2.2907168290880238, 2.881400340859647],
        [-1.6267171654159869, -3.6396738190078173],
        [-4.2622244094738, -2.4650308753554904],
    ],
    "BootstrapPF": [
        [2.3786711021757014, 2.9751487838691215],
        [-1.3887358554237117, -4.196107549249501],
        [-5.285234773690237, -3.6548903764705334],
    ],
    "GridFilter": [
        [2.3650977792008874, 2.9241387454768875],
        [-1.694909515938079, -3.307162190865475],
        [-4.019905279215797, -2.2878204585222424],
    ],
}


@pytest.mark.parametrize(
    "filter",
    [psf.EKF(), psf.BootstrapPF(128), psf.GridFilter()],
    ids=["EKF", "BootstrapPF", "Grid"],
)
def test_draws_of_a_seed_do_not_change(filter):
    np.testing.assert_allclose(last_draws(filter), EXPECTED[type(filter).__name__], rtol=1e-8)
