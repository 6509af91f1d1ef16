"""Steps too long for the equations are named at the end of a run, and others are not."""

import logging
import warnings

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice.step_check import step_problems
from pymc_statespace_filters.errors import EvidenceWarning
from pymc_statespace_filters.evidence.checks import check_steps
from pymc_statespace_filters.pymc_model.posterior_draws import unconstrained_draws


def decay(dt, integrator=psf.EulerMaruyama, **options):
    return psf.StateSpaceModel(
        integrator(lambda x, k: [-k * x[0]], lambda s: [[s]], dt=dt, **options),
        observation=lambda x: [x[0]],
        observation_noise=[[0.05**2]],
        initial_mean=[1.0],
        initial_cov=[[0.1]],
    )


@pytest.fixture(scope="module")
def record():
    """A rate of 3 seen twice in a unit of time."""
    steps = np.arange(1, 101) * 100
    return psf.simulate(decay(0.005), {"k": 3.0, "s": 1.0}, steps=steps, random_seed=1)


@pytest.mark.parametrize(
    ("system", "is_named"),
    [
        (decay(0.5), True),
        (decay(0.5, substeps=16), False),
        (decay(0.5, psf.LocalLinearization), False),
    ],
    ids=["long", "substeps", "exact"],
)
def test_steps_too_long_are_named(record, system, is_named, caplog):
    with pm.Model() as model, caplog.at_level(logging.WARNING, "pymc"):
        pm.HalfNormal("k", 4.0)
        pm.HalfNormal("s", 4.0)
        psf.StateSpace("d", system, psf.EKF(), steps=range(1, 101), observed=record["observations"])
        idata = psf.sample(500, sampler="dram", random_seed=1, progressbar=False)
    assert ("steps half as long the posterior would move" in caplog.text) == is_named
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", EvidenceWarning)
        found = psf.estimate_evidence(idata, model, random_seed=1, progressbar=False)
    doubt = "the integration steps of 0.5 are too long"
    assert (doubt in found["bridge"].doubts) == is_named
    assert any(doubt in str(one.message) for one in caught) == is_named
    assert psf.compare_evidence({"it": idata, "other": idata})["warning"].all() == is_named


def test_a_run_of_few_draws_is_not_looked_at(record):
    observed = record["observations"][:3]
    with pm.Model():
        pm.HalfNormal("k", 4.0)
        psf.StateSpace(
            "d", decay(0.5), psf.EKF(), params={"s": 1.0}, steps=[1, 2, 3], observed=observed
        )
        idata = psf.sample_dram(5, tune=5, chains=1, random_seed=1, progressbar=False)
    assert idata["posterior"].sizes["draw"] == 5


def test_draws_that_do_not_vary_tell_nothing(record):
    stuck = xr.Dataset({name: (("chain", "draw"), np.full((2, 100), 1.3)) for name in "ks"})
    with pm.Model() as model:
        pm.HalfNormal("k", 4.0)
        pm.HalfNormal("s", 4.0)
        observed = record["observations"]
        psf.StateSpace("d", decay(0.5), psf.EKF(), steps=range(1, 101), observed=observed)
    assert step_problems(xr.DataTree.from_dict({"posterior": stuck}), model) == []


@pytest.mark.parametrize(("substeps", "is_said"), [(2, True), (8, False)])
def test_steps_that_decide_a_comparison_are_a_doubt_of_the_evidence(record, substeps, is_said):
    """They move no parameter; the change is that of log-likelihoods with either step."""
    known, observed = {"k": 3.0, "s": 1.0}, record["observations"]
    with pm.Model() as model:
        noise = pm.HalfNormal("unrelated", 1.0)
        steps = decay(0.5, substeps=substeps)
        psf.StateSpace("d", steps, psf.EKF(), params=known, steps=range(1, 101), observed=observed)
        pm.Normal("y", 0.0, noise, observed=1.0)
    draws = xr.Dataset({"unrelated": (("chain", "draw"), np.linspace(0.9, 2, 200).reshape(2, 100))})
    tree = xr.DataTree.from_dict({"posterior": draws})
    assert step_problems(tree, model) == []
    doubts = check_steps(model, tree, unconstrained_draws(tree, model))
    assert bool(doubts) == is_said
    if is_said:
        given = {"steps": range(1, 101), "observed": observed}
        coarse, fine = (
            psf.log_likelihood(decay(0.5, substeps=n), psf.EKF(), known, **given).sum()
            for n in (substeps, 2 * substeps)
        )
        assert abs(fine - coarse) > 1.0
        assert f"the log-evidence changes by {fine - coarse:+.1f} nats" in doubts[0]


def stiff(integrator=psf.EulerMaruyama, **options):
    """A decay at forty times the rate of the steps, which longer ones of any order amplify."""
    return psf.StateSpaceModel(
        integrator(lambda x, level: [400 * (level - x[0])], [[0.5]], dt=0.1, **options),
        observation=lambda x: [x[0]],
        observation_noise=[[0.05**2]],
        initial_mean=[1.0],
        initial_cov=[[0.1]],
    )


@pytest.mark.parametrize("integrator", [psf.EulerMaruyama, psf.RungeKutta4])
def test_the_advice_for_unstable_steps_ends_the_warning(integrator):
    draws = xr.Dataset({"level": (("chain", "draw"), np.linspace(1.9, 2.1, 200).reshape(2, 100))})
    tree = xr.DataTree.from_dict({"posterior": draws})

    def problems(system):
        with pm.Model() as model:
            pm.Normal("level", 0, 5)
            psf.StateSpace("d", system, psf.EKF(), steps=[1, 2, 3], observed=[2.0, 2.1, 1.9])
        return step_problems(tree, model)

    (said,) = problems(stiff(integrator))
    assert "Take LocalLinearization" in said
    assert problems(stiff(psf.LocalLinearization)) == []
