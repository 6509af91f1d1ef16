"""Draws for a given seed are those of earlier versions, for one model per kind of filter.

Starts are those of the version that brought the search for starts, draws those of the version with
small walks among the others. On one machine they are equal to the bit; the tolerance is for
processors whose vector code rounds differently.
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


def last_draws(filter, tune):
    """The last draw of each of two chains of 60 draws, and its log-density."""
    with model_of(filter):
        idata = psf.sample_dram(
            60, tune=tune, chains=2, random_seed=5, progressbar=False,
            compute_convergence_checks=False,
        )  # fmt: skip
    at = [idata.posterior[name].values[:, -1] for name in ("a", "b")]
    return np.array([*at, idata.sample_stats["lp"].values[:, -1]])


FILTERS = {
    "EKF": psf.EKF(),
    "BootstrapPF": psf.BootstrapPF(128),
    "GridFilter": psf.GridFilter(),
}

EXPECTED = {
    "EKF": [
        [2.0910725050339507, 2.6140136779799907],
        [-1.426797580876781, -3.633860205868861],
        [-4.869441195571075, -2.7752250843933854],
    ],
    "BootstrapPF": [
        [3.9435324085667567, 3.1024910089425135],
        [-3.876781728542361, -3.298860854811431],
        [-2.6324627177585858, -2.1777461466685732],
    ],
    "GridFilter": [
        [3.1054578524172407, 3.196498490260989],
        [-3.9288406295636933, -3.8964380421505416],
        [-2.8694043149636617, -2.746944643007516],
    ],
}

STARTS = {
    "EKF": [
        [1.4870799471365252, 3.5050433692958336],
        [-2.9477131952516267, -3.9590899374638964],
    ],
    "BootstrapPF": [
        [3.8135524729673778, 2.5092750052007675],
        [-4.224619386169344, -4.09797575236978],
    ],
}


@pytest.mark.parametrize("filter", FILTERS)
def test_draws_of_a_seed_do_not_change(filter):
    tune = 40 if filter == "EKF" else 400  # with a short search, if there is one
    np.testing.assert_allclose(last_draws(FILTERS[filter], tune), EXPECTED[filter], rtol=1e-8)


def test_starts_of_a_seed_do_not_change():
    """The complete search, which long warm-ups have, from the prior and led by an EKF."""
    for filter, expected in STARTS.items():
        found = psf.find_starts(
            model_of(FILTERS[filter]), chains=2, random_seed=5, progressbar=False
        )
        at = [[start[name] for start in found] for name in ("a", "b")]
        np.testing.assert_allclose(at, expected, rtol=1e-8)
