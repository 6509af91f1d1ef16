"""DRAM on real StateSpace variables: a particle filter's noise, seeds and failures."""

import os

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.outcomes import Failure
from pymc_statespace_filters.ops.distributed import (
    CallbackLogLikelihood,
    CallbackLogLikelihoodOfNoise,
)
from pymc_statespace_filters.ops.likelihood import LogLikelihood, StoredNoise
from pymc_statespace_filters.pymc_model.inspection import noise_seeds
from pymc_statespace_filters.sampling import DRAM
from pymc_statespace_filters.sampling.target.log_density import LogDensity
from tests.sampling.test_dram import sample
from tests.systems import autoregression, simulated

STEPS = np.arange(1, 21)


LINEAR = autoregression()
TRUTH = {"phi": 0.7, "spread": 0.7}
DATA = simulated(STEPS, 3, **TRUTH)


def linear_model(filter):
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 0.5)
        pm.HalfNormal("spread", 1.0)
        psf.StateSpace("d", LINEAR, filter, steps=STEPS, observed=DATA)
    return model


FEW = psf.BootstrapPF(20)


def test_the_filter_runs_once_in_an_evaluation():
    with linear_model(FEW):
        step = DRAM()
    nodes = step._target.density._function.maker.fgraph.apply_nodes
    assert sum(isinstance(node.op, LogLikelihood) for node in nodes) == 1


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_in_processes():
    """By fork; `tests/test_processes.py` has the others."""
    with linear_model(FEW):
        step = DRAM()
        one = sample(step, draws=50, tune=100)
        two = sample(step, draws=50, tune=100, cores=2, mp_ctx="fork")
    for group, name in (("posterior", "phi"), ("sample_stats", "d_seed")):
        np.testing.assert_array_equal(one[group][name], two[group][name])


def cubed(x, q, phi):
    return [phi * x[0] + x[0] ** 3 + q[0]]


@pytest.mark.parametrize("filter", [FEW, psf.EKF()], ids=["particles", "EKF"])
def test_failures_come_with_the_filters_reason(filter):
    explosive = autoregression(transition=cubed, spread=1e-2, initial_mean=0.05, initial_var=1e-4)
    with pm.Model():
        pm.Normal("phi", 0.0, 3.0)
        psf.StateSpace("d", explosive, filter, steps=[20], observed=[0.0])
        idata = sample(DRAM(), draws=500, tune=500, discard_tuned_samples=False)
    stats = idata["warmup_sample_stats"]
    codes = set(np.unique(stats["failure"]))
    assert stats["n_failed"].sum() > 0
    assert codes - {0} <= set(Failure) - {0}
    assert np.isfinite(stats["lp"]).all()


def test_a_filter_needs_all_its_parameters_held():
    with (
        linear_model(FEW) as model,
        pytest.raises(
            ModelError, match=r"vars must include spread: the noisy likelihood of d depends"
        ),
    ):
        DRAM([model["phi"]])
    with linear_model(psf.EKF()) as model:
        DRAM([model["phi"]])


@pytest.mark.parametrize("filter", [psf.EnKF(30), psf.BootstrapPF(30)], ids=["EnKF", "BootstrapPF"])
def test_held_noise_is_made_once_and_gives_what_its_seed_gives(filter):
    model = linear_model(filter)
    seeds, start = noise_seeds(model), model.initial_point(random_seed=0)
    by_seed, by_normals = (
        LogDensity(model, model.value_vars, start, seeds, fixed_noise=holds)
        for holds in (False, True)
    )
    made_inside = {type(n.op) for n in by_normals._function.maker.fgraph.apply_nodes}
    assert CallbackLogLikelihoodOfNoise in made_inside
    assert not made_inside & {LogLikelihood, CallbackLogLikelihood, StoredNoise}
    values = []
    for seed in (3, 4):
        seeds["d"].set_value(np.array(seed))
        by_normals.prepare()
        for position in (np.array([0.4, -0.3]), np.array([0.1, 0.2])):
            values.append(by_normals.bind()(position, (), [99]))
            assert values[-1] == by_seed.bind()(position, (), [seed])
    assert len(set(values)) == 4
