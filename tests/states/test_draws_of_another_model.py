"""Draws of another model are refused by all that is computed at draws, and those of it never."""

from functools import partial

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import DataMismatchError
from pymc_statespace_filters.pymc_model.checked_model import checked_model
from pymc_statespace_filters.pymc_model.fingerprint import model_data_fingerprint, model_fingerprint
from tests.systems import counts

pytestmark = pytest.mark.usefixtures("interpreted")

STEPS = np.arange(1, 13)
DATA = np.array([1.0, 0, 0, 2, 0, 2, 1, 0, 3, 0, 0, 1])[:, None]
IPLF = psf.IPLF()


def model_of(filter=IPLF, data=DATA, steps=STEPS, mean=0.5, **settings):
    system = counts(**({"noise_var": 0.5, "level": 0.3} | settings))
    with pm.Model() as model:
        a = pm.Normal("a", mean, 0.3)
        pm.Deterministic("twice", 2 * a)
        psf.StateSpace("d", system, filter, steps=steps, observed=data)
    return model


def draws_of(filter=IPLF, n_draws=6, *, observed=True, density="lp", sign=1.0):
    """Draws as a run with this filter stores them, each with its seed."""
    dims = ("chain", "draw")
    a = np.random.default_rng(1).normal(0.5, 0.2, (2, n_draws))
    seeds = np.arange(a.size).reshape(a.shape)
    terms = psf.log_likelihood(
        counts(noise_var=0.5, level=0.3), filter, {"a": a}, DATA, steps=STEPS, seed=seeds
    )
    prior = -0.5 * ((a - 0.5) / 0.3) ** 2 - np.log(0.3 * np.sqrt(2 * np.pi))
    labels = {dim: np.arange(length) for dim, length in zip(dims, a.shape, strict=True)}
    stats = {"d_seed": (dims, seeds)}
    if density:
        stats[density] = (dims, sign * (prior + terms.sum(axis=-1)))
    groups = {
        "posterior": xr.Dataset({"a": (dims, a)}, labels),
        "sample_stats": xr.Dataset(stats, labels),
    }
    if observed:
        groups["observed_data"] = xr.Dataset({"d": (("d_time", "observable"), DATA)})
    tree = xr.DataTree.from_dict(groups)
    tree.attrs = {} if density == "logp" else {"filter": f'{{"d": "{short(filter)}"}}'}
    return tree


def short(filter):
    return f"{type(filter).__name__}({getattr(filter, 'n_particles', '')})"


QUIET = {"progressbar": False}
AWAY = QUIET | {"extend_inferencedata": False}
FUNCTIONS = [
    partial(psf.filtered_states, **AWAY),
    partial(psf.smoothed_states, **AWAY),
    partial(psf.forecast, n_steps=1, **AWAY),
    partial(psf.free_run, **AWAY),
    partial(psf.filter_diagnostics, **AWAY),
    partial(psf.compute_log_likelihood, **AWAY),
    partial(psf.leave_future_out, min_observations=10, **QUIET),
    partial(psf.check_filter, **QUIET),
    partial(psf.step_error, **QUIET),
]
WITH_NEW_DATA = FUNCTIONS[:6]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_another_system_and_other_data_are_refused(function):
    with pytest.raises(DataMismatchError, match=r"another model, other data .*: pass the model"):
        function(draws_of(), model_of(noise_var=0.6))
    switch = function in WITH_NEW_DATA
    message = "sampled, or new_data=True if other data are meant$" if switch else "sampled$"
    with pytest.raises(DataMismatchError, match=rf"observations of 'd'.*others: .*{message}"):
        function(draws_of(), model_of(data=3 * DATA))


# Each difference with the runs whose draws show it.
@pytest.mark.parametrize(
    ("draws", "model"),
    [
        ({}, {"level": 0.4}),
        ({}, {"mean": 0.4}),
        ({}, {"steps": STEPS + 1}),
        ({"density": "logp"}, {"noise_var": 0.6}),
        ({"density": "lp", "sign": -1.0}, {"noise_var": 0.6}),
        ({"density": ""}, {"data": DATA + np.eye(12)[:, :1]}),
        ({"observed": False}, {"data": 3 * DATA}),
        ({}, {"data": DATA[:8], "steps": STEPS[:8]}),
        ({"filter": psf.BootstrapPF(200)}, {"filter": psf.BootstrapPF(300), "level": 0.4}),
        ({"filter": psf.BootstrapPF(200)}, {"filter": IPLF}),
        ({"filter": IPLF}, {"filter": psf.BootstrapPF(200)}),
        ({"filter": psf.PFEnKF(100)}, {"filter": psf.PFEnKF(200)}),
        ({"n_draws": 1}, {"level": 0.4}),
    ],
)  # fmt: skip
def test_what_changes_the_posterior_is_seen(draws, model):
    with pytest.raises(DataMismatchError):
        checked_model(model_of(**model), draws_of(**draws))


def test_what_does_not_is_taken():
    longer = {"data": np.append(DATA, [[np.nan]], axis=0), "steps": np.append(STEPS, 20)}
    plain, more = psf.BootstrapPF(200), psf.BootstrapPF(300)
    for draws, model in (
        (draws_of(), {}),
        (draws_of(density="logp"), {}),
        (draws_of(sign=-1.0), {}),
        (draws_of(density="", observed=False), {"level": 0.4}),  # nothing to compare
        (draws_of(), longer),
        (draws_of(plain), {"filter": more}),
        (draws_of(plain), {"filter": psf.GuidedPF(10)}),
        (draws_of(), {"data": DATA.astype(np.float32).astype(float)}),
    ):
        built = model_of(**model)
        assert checked_model(built, draws) is built
    thinned, whole = draws_of(), draws_of()
    thinned["posterior"] = whole["posterior"].to_dataset().isel(draw=[1, 4])
    checked_model(model_of(), thinned)
    two_steps = draws_of()  # as of NUTS, after which Metropolis moved another variable
    stats = two_steps["sample_stats"].to_dataset()
    two_steps["sample_stats"] = stats.assign(
        lp=stats["lp"] + 1.0, tree_depth=stats["lp"], accepted=stats["lp"]
    )
    checked_model(model_of(), two_steps)


def test_another_filter_on_purpose():
    guided = psf.GuidedPF(10)
    for function in (FUNCTIONS[0], FUNCTIONS[2]):
        function(draws_of(), model_of(guided), filter=guided, random_seed=1)
    FUNCTIONS[3](draws_of(), model_of(guided), random_seed=1)
    with pytest.raises(DataMismatchError, match=r"by IPLF\(\) of 'd', and the model has GuidedPF"):
        FUNCTIONS[0](draws_of(), model_of(guided))


def test_other_data_on_purpose():
    model = model_of(data=3 * DATA)
    for function in WITH_NEW_DATA[:2]:
        found = function(draws_of(), model, new_data=True)
        (group,) = (g for g in found.children if g.endswith("states"))
        own = function(draws_of(), model_of(), new_data=False)
        assert (found[group]["d_mean"].values > own[group]["d_mean"].values).mean() > 0.6


def test_a_run_that_stores_what_it_was_is_not_recomputed(monkeypatch):
    model, idata = model_of(), draws_of()
    stored = {"model": model_fingerprint(model), "data": model_data_fingerprint(model)}
    idata["sampler_state"] = xr.DataTree(xr.Dataset(attrs=stored))
    monkeypatch.setattr("pymc_statespace_filters.pymc_model.checked_model.ModelDensity", None)
    checked_model(model, idata)
    with pytest.raises(TypeError):
        checked_model(model_of(level=0.4), idata)
