"""Draws for a given seed are those of earlier versions, for one model per kind of filter.

The numbers are those of commit a1341ec; the particle filter's are of 20bf772, which brought other
normals. On one machine the draws are equal to the bit; the
tolerance is for processors whose vector code rounds differently.
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
        [3.368738122573254, 3.4731894017720033],
        [-3.0084350456751623, -3.6133039728770253],
        [-2.2024391596583377, -2.234238828123925],
    ],
    "BootstrapPF": [
        [4.189557585512364, 2.15549452882074],
        [-2.7941696136342906, -3.364896240197835],
        [-4.072004896413993, -3.7420289146720593],
    ],
    "GridFilter": [
        [3.6485475959763325, 3.3615534373312683],
        [-2.7275824524396524, -2.909150870909372],
        [-2.8318442272198743, -2.263182911284873],
    ],
}


@pytest.mark.parametrize(
    "filter",
    [psf.EKF(), psf.BootstrapPF(128), psf.GridFilter()],
    ids=["EKF", "BootstrapPF", "Grid"],
)
def test_draws_of_a_seed_do_not_change(filter):
    np.testing.assert_allclose(last_draws(filter), EXPECTED[type(filter).__name__], rtol=1e-8)
