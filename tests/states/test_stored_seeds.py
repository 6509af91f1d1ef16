"""Noise seeds in ``sample_stats`` that cannot be those of the draws."""

import json

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import pymc_statespace_filters as psf

pytestmark = [
    pytest.mark.usefixtures("interpreted"),
    pytest.mark.filterwarnings("ignore::pymc_statespace_filters.errors.FilterWarning"),
]

SYSTEM = psf.StateSpaceModel(
    transition=lambda x, q, a: [a * x[0] + q[0]],
    process_noise=[[1.0]],
    observation_dist=lambda x: pm.Uniform.dist(x[0] - 1.0, x[0] + 1.0),
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)
FILTER = psf.BootstrapPF(10)
DATA, STEPS = [0.9, -0.4, 1.1], [1, 2, 3]


@pytest.fixture(scope="module")
def model():
    with pm.Model() as model:
        a = pm.Uniform("a")
        psf.StateSpace("d", SYSTEM, FILTER, params={"a": a}, steps=STEPS, observed=DATA)
    return model


@pytest.fixture(scope="module")
def seeds():
    """Seeds with which the filter works at a = 0.5, and others."""
    tried = np.arange(300)
    terms = psf.log_likelihood(SYSTEM, FILTER, {"a": 0.5}, DATA, steps=STEPS, seed=tried)
    works = np.isfinite(terms.sum(axis=1))
    return tried[works][:6].reshape(2, 3), tried[~works][:6].reshape(2, 3)


def idata_of(seeds, **attrs):
    dims = ("chain", "draw")
    labels = {"chain": [0, 1], "draw": [0, 1, 2]}
    stats = {"d_seed": (dims, seeds), "lp": (dims, np.zeros((2, 3)))}
    tree = {
        "posterior": xr.Dataset({"a": (dims, np.full((2, 3), 0.5))}, labels),
        "sample_stats": xr.Dataset(stats, labels),
        "observed_data": xr.Dataset({"d": (("d_obs", "d_dim"), np.transpose([DATA]))}),
    }
    tree = xr.DataTree.from_dict(tree)
    tree.attrs.update(attrs)
    return tree


FUNCTIONS = [
    psf.filtered_states,
    psf.smoothed_states,
    lambda idata, model: psf.forecast(idata, model, n_steps=2),
    psf.filter_diagnostics,
]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_seeds_of_another_run_are_refused(model, seeds, function):
    good, bad = seeds
    function(idata_of(good), model)
    mixed = good.copy()
    mixed[1] = bad[1]
    message = (
        r"d_seed in sample_stats of idata is of another run or another model: with it "
        r"BootstrapPF\(.*\) fails at 3 of 6 draws, at which their chain had a finite likelihood"
    )
    with pytest.raises(psf.errors.ModelError, match=message):
        function(idata_of(mixed, filter=json.dumps({"d": repr(FILTER)})), model)


def test_another_filter_or_other_data_may_fail(model, seeds):
    _, bad = seeds
    psf.filtered_states(idata_of(bad, filter='{"d": "BootstrapPF(1000)"}'), model)
    other = idata_of(bad)
    other["observed_data"]["d"] = other["observed_data"]["d"] + 1.0
    psf.filtered_states(other, model, new_data=True)


@pytest.mark.parametrize("value", [np.nan, 0.5, -1.0])
def test_numbers_that_are_no_seeds_are_refused(model, seeds, value):
    numbers = seeds[0].astype(float)
    numbers[0, 1] = value
    with pytest.raises(
        psf.errors.ModelError, match=r"^d_seed .* must be noise seeds, .* in 1 of 6 places"
    ):
        psf.filtered_states(idata_of(numbers), model)


def test_seeds_without_draws_are_refused(model, seeds):
    idata = idata_of(seeds[0])
    idata["sample_stats"]["d_seed"] = idata["sample_stats"]["d_seed"].isel(draw=0, drop=True)
    with pytest.raises(
        psf.errors.ModelError, match=r"^d_seed .* must have the dimensions chain and draw"
    ):
        psf.filtered_states(idata, model)
