"""Rival models, their draws and their average, for all plots."""

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr

from pymc_statespace_filters import Evidence, average_models, compare_evidence

X = xr.DataArray(np.linspace(-2, 2, 9), coords=[("displacement", np.linspace(-2, 2, 9))])


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


def an_evidence(log_evidence, se, k=2, estimator="bridge"):
    return Evidence(log_evidence, se, estimator, k, 100, -5.0, "same")


@pytest.fixture(scope="session")
def rivals():
    return {
        "linear": an_evidence(-9.0, 0.2),
        "cubic": an_evidence(-5.0, 0.3, k=3),
        "quintic": an_evidence(-5.2, 0.4, k=4),
    }


@pytest.fixture(scope="session")
def table(rivals):
    return compare_evidence(rivals)


@pytest.fixture(scope="session")
def estimates():
    return {
        "bridge": an_evidence(-5.0, 0.02),
        "laplace": an_evidence(-5.3, np.nan, estimator="laplace"),
    }


@pytest.fixture(scope="session")
def draws():
    normals = np.random.default_rng(1).normal(size=(2, 4, 250))
    return {
        "linear": az.from_dict({"posterior": {"k": 2 + 0.1 * normals[0]}}),
        "cubic": az.from_dict({"posterior": {"k": 3 + 0.3 * normals[1]}}),
    }


def averaged(draws, function):
    return average_models(draws, {"linear": 1, "cubic": 3}, function, n_draws=4000, random_seed=1)


@pytest.fixture(scope="session")
def curve_average(draws):
    return averaged(draws, lambda posterior: (posterior["k"] * X).rename("force"))


@pytest.fixture(scope="session")
def scalar_average(draws):
    return averaged(draws, lambda posterior: posterior["k"])


@pytest.fixture(scope="session")
def average_in_panels(draws):
    sides = xr.DataArray([1.0, -1.0], coords=[("side", ["left", "right"])])
    return averaged(draws, lambda posterior: (posterior["k"] * X * sides).rename("force"))
