"""Exchanging the filters of a model's log-density."""

import numpy as np
import pymc as pm
import pytensor
import pytest
import xarray as xr
from pytensor.graph.traversal import ancestors

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.pymc_model.graph_rewrites import with_filter
from pymc_statespace_filters.pymc_model.inspection import (
    health_outputs,
    log_density_graph,
    log_density_terms,
    noise_seeds,
    noisy_filters,
    resized,
)
from tests.systems import FORCE, FORCED, FORCED_DATA, PAIR, PAIR_DATA, STEPS

pytestmark = pytest.mark.usefixtures("interpreted")

EKF, FEW, ENSEMBLE = psf.EKF(), psf.BootstrapPF(30, resample_below=0.7), psf.EnKF(20)


def two_systems(pair, forced):
    with pm.Model() as model:
        pm.Normal("a")
        psf.StateSpace("pair", PAIR, pair, steps=STEPS, observed=PAIR_DATA, seed=5)
        psf.StateSpace(
            "forced",
            FORCED,
            forced,
            steps=STEPS,
            observed=FORCED_DATA,
            inputs=FORCE,
            seed=6,
            dims=("forced_time", "forced_place"),
        )
    return model


def twins(first, second, seeds=(1, 2)):
    """Two variables that differ in their seeds, or in nothing."""
    with pm.Model() as model:
        pm.Normal("a")
        record = {"steps": STEPS, "observed": PAIR_DATA}
        psf.StateSpace("one", PAIR, first, **record, seed=seeds[0])
        psf.StateSpace("two", PAIR, second, **record, seed=seeds[1])
    return model


def compiled(graphs, model):
    """The graphs as a function of no argument, at a = 0.7."""
    at = {model.rvs_to_values[model["a"]]: np.array(0.7)}
    return pytensor.function([], graphs, givens=at)


def filters_in(graphs):
    nodes = {v.owner for v in ancestors(graphs) if v.owner is not None}
    return sorted(repr(n.op.filter) for n in nodes if isinstance(n.op, LogLikelihood))


def test_the_log_density_is_that_of_a_model_with_that_filter():
    model, other = two_systems(FEW, EKF), two_systems(EKF, EKF)
    graphs = with_filter([model.logp()], model, {"pair": EKF})
    assert compiled(graphs, model)() == compiled([other.logp()], other)()


@pytest.mark.parametrize(
    ("model_filters", "exchanged"),
    [
        ((FEW, ENSEMBLE), {}),
        ((FEW, ENSEMBLE), {"forced": psf.EnKF(33)}),
        ((FEW, ENSEMBLE), {"pair": EKF, "forced": psf.GridFilter()}),
        ((EKF, EKF), {"forced": FEW}),
    ],
)
def test_only_the_named_variables_change(model_filters, exchanged):
    model = two_systems(*model_filters)
    filters = dict(zip(("pair", "forced"), model_filters, strict=True)) | exchanged
    assert filters_in(with_filter([model.logp()], model, exchanged)) == sorted(
        map(repr, filters.values())
    )
    assert filters_in([model.logp()]) == sorted(map(repr, model_filters))


def test_one_of_two_alike_but_for_the_seed():
    """PyMC merges their equal data, so that only the seeds tell them apart."""
    model = twins(FEW, FEW)
    graphs = with_filter([model.logp()], model, {"two": EKF})
    assert filters_in(graphs) == sorted([repr(EKF), repr(FEW)])
    seeds = noise_seeds(model)
    value = compiled(graphs, model)
    before = value()
    seeds["two"].set_value(np.array(99))
    assert value() == before
    seeds["one"].set_value(np.array(99))
    assert value() != before


def test_variables_alike_in_all_are_exchanged_together_or_not_at_all():
    model = twins(EKF, EKF, seeds=(0, 0))
    with pytest.raises(ModelError, match="must be the same for one, two"):
        with_filter([model.logp()], model, {"two": FEW})
    graphs = with_filter([model.logp()], model, {"one": FEW, "two": FEW})
    assert set(filters_in(graphs)) == {repr(FEW)}


def test_health_is_that_of_the_filter_in_place():
    model = two_systems(FEW, EKF)
    (logp,) = with_filter([model.logp()], model, {"pair": psf.BootstrapPF(500)})
    n_effective = [health[0] for health in compiled(health_outputs([logp]), model)()]
    assert sorted(n_effective)[0] > 30.0
    assert np.isinf(max(n_effective))


def test_what_cannot_be_exchanged_is_named():
    model = two_systems(FEW, ENSEMBLE)
    with pytest.raises(ModelError, match=r"StateSpace variables, \['pair'"):
        with_filter([model.logp()], model, {"a": EKF})
    with pytest.raises(ModelError, match="contain the likelihood of pair"):
        with_filter([model.logp(vars=[model["forced"]])], model, {"pair": EKF})
    with pytest.raises(ModelError, match="filter must be a filter"):
        with_filter([model.logp()], model, {"pair": "EKF"})
    with pytest.raises(ModelError, match="GridFilter"):
        with_filter([model.logp()], model, {"pair": psf.GridFilter()})


def test_noisy_filters_and_their_sizes():
    assert noisy_filters(two_systems(FEW, EKF)) == {"pair": FEW}
    assert resized(FEW, 99) == psf.BootstrapPF(99, resample_below=0.7)
    assert resized(psf.EnKF(5, likelihood="gaussian"), 99) == psf.EnKF(99, likelihood="gaussian")
    assert resized(psf.PFEnKF(5), 99) == psf.PFEnKF(99)


@pytest.mark.parametrize(
    ("function", "settings"),
    [
        (psf.check_filter, {}),
        (psf.compute_log_likelihood, {}),
        (psf.estimate_evidence, {}),
        (psf.filter_diagnostics, {}),
        (psf.filtered_states, {}),
        (psf.forecast, {"steps": [9]}),
        (psf.free_run, {}),
        (psf.leave_future_out, {"min_observations": 2}),
        (psf.reweight, {"filter": FEW}),
        (psf.smoothed_states, {}),
        (psf.step_error, {}),
    ],
    ids=lambda one: getattr(one, "__name__", None),
)
def test_draws_and_model_in_the_wrong_order(function, settings):
    with pytest.raises(ModelError, match=r"model must be a pymc.Model, got DataTree"):
        function(pm.Model(), xr.DataTree(), **settings)


def test_a_number_in_place_of_the_model_is_told_how_to_be_given():
    with pytest.raises(ModelError, match=r"got int 10: give a number by name, such as n_steps=10"):
        psf.forecast(xr.DataTree(), 10)


def test_a_model_that_has_changed_has_other_terms():
    """They are derived once, until a variable is added or a transform exchanged."""
    with pm.Model() as model:
        a, b = pm.HalfNormal("a"), pm.Normal("b")
    first, again = (dict(log_density_terms(model)) for _ in range(2))
    assert first == again
    model.rvs_to_transforms[a] = None
    with model:
        c = pm.Potential("c", -(b**2))
    for variables in (None, [c, a]):
        mine, own = log_density_graph(model, variables), model.logp(variables)
        at = {model.rvs_to_values[a]: 2.0, model.rvs_to_values[b]: 3.0}
        found, expected = (graph.eval(at, on_unused_input="ignore") for graph in (mine, own))
        assert found == expected
