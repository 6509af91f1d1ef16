"""Posterior mass at the stability limit of the integrator is said, and nothing else is."""

import pickle
import re

import arviz as az
import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import EvidenceWarning
from pymc_statespace_filters.evidence import checks
from pymc_statespace_filters.evidence.checks import check_discretisation
from pymc_statespace_filters.pymc_model.density import RowFunction
from pymc_statespace_filters.pymc_model.posterior_draws import unconstrained_draws
from pymc_statespace_filters.pymc_model.step_refinement import densities_by_halvings

POSITION = {"observation": lambda x: [x[0]]}


def linear(substeps=1):
    return psf.StateSpaceModel(
        transition=psf.EulerMaruyama(lambda x, a: [a * x[0]], [[1.0]], dt=0.1, substeps=substeps),
        observation_noise=[[0.05]],
        initial_mean=[0.0],
        initial_cov=[[0.5]],
        **POSITION,
    )


def linear_model(system, n=10, size=100, a=-1.0, filter=None, **params):
    """A record by steps of 0.1, seen every n of them."""
    steps = n * np.arange(size)
    record = psf.simulate(linear(), {"a": a}, steps=steps, random_seed=1)["observations"]
    with pm.Model() as model:
        pm.Uniform("a", -60, 0)
        psf.StateSpace("d", system, filter or psf.EKF(), steps=steps, observed=record.values)
    return model


def near(*modes, sd=0.1):
    """Draws about some values, equally often, in two chains that see all of them in any order."""
    rng = np.random.default_rng(2)
    values = rng.choice(modes, size=(2, 200)) + sd * rng.standard_normal((2, 200))
    return az.from_dict({"posterior": {"a": values}})


def doubts(model, idata):
    return list(check_discretisation(model, idata, unconstrained_draws(idata, model)))


@pytest.mark.parametrize(("substeps", "mirror"), [(1, -19.0), (2, -39.0)])
def test_the_mirror_mode_of_a_linear_state(substeps, mirror):
    """Seen every ten steps, a and -2 / h - a are one to the likelihood."""
    model = linear_model(linear(substeps))
    (doubt,) = doubts(model, near(-1.0, mirror))
    share, range_ = re.match(r"(\d+)% of the draws \(a in (\S+ to \S+), ", doubt).groups()
    assert 35 < int(share) < 65
    assert all(abs(float(end) - mirror) < 0.5 for end in range_.split(" to "))
    assert "the others in -1." in doubt
    assert "raise substeps, or give a prior that excludes them" in doubt


def test_estimates_of_particles_show_it_too():
    model = linear_model(linear(), filter=psf.BootstrapPF(20))
    (doubt,) = doubts(model, near(-1.0, -19.0, -19.0, -19.0))
    assert re.match(r"[678]\d% of the draws \(a in -19", doubt)


def test_all_draws_may_lie_there():
    (doubt,) = doubts(linear_model(linear()), near(-19.0))
    assert doubt.startswith("100% of the draws have a likelihood due")


@pytest.mark.parametrize(("a", "n", "size"), [(-1.0, 10, 100), (-6.0, 1, 100), (-9.0, 1, 2000)])
def test_coarse_but_stable_steps_are_no_doubt(a, n, size):
    assert doubts(linear_model(linear(), n, size, a), near(a)) == []


def test_a_likelihood_that_depends_on_the_step_without_overshooting_is_no_doubt():
    """An oscillator seen almost without noise: halving the steps costs every draw many nats."""

    def drift(x, t, c):
        return [x[1], -c * x[1] - x[0] - x[0] ** 3 + 3 * pt.cos(1.5 * t)]

    system = psf.StateSpaceModel(
        transition=psf.EulerMaruyama(drift, [[0.0], [0.01]], dt=0.01),
        observation_noise=[[1e-4]],
        initial_mean=[1.0, 0.0],
        initial_cov=1e-4 * np.eye(2),
        **POSITION,
    )
    steps = np.arange(0, 1001, 20)
    record = psf.simulate(system, {"c": 0.3}, steps=steps, random_seed=1)["observations"]
    with pm.Model() as model:
        pm.HalfNormal("c", 1)
        psf.StateSpace("d", system, psf.EKF(), steps=steps, observed=record.values)
    idata = az.from_dict({"posterior": {"c": 0.3 + 1e-4 * near(0.0)["posterior"]["a"].values}})
    x = unconstrained_draws(idata, model).reshape(-1, 1)[:5]
    coarse, fine = (RowFunction(model, g).evaluate(x) for g in densities_by_halvings(model, 1))
    assert (coarse - fine > 20).all()
    assert doubts(model, idata) == []


def double_well(alpha, beta, seed):
    """The rivals' cubic model, 20 seconds seen every 0.2 seconds, sampled with the EKF."""
    system = psf.StateSpaceModel(
        transition=psf.EulerMaruyama(
            lambda x, alpha, beta: [alpha * x[0] + beta * x[0] ** 3],
            lambda sigma_m: [[0.6, sigma_m]],
            dt=0.01,
        ),
        observation_noise=[[0.08]],
        initial_mean=[1.0],
        initial_cov=[[0.5]],
        **POSITION,
    )
    steps = np.arange(0, 2001, 20)
    truth = {"alpha": 4.0, "beta": -4.0, "sigma_m": 0.0}
    record = psf.simulate(system, truth, steps=steps, random_seed=seed)["observations"].values
    with pm.Model() as model:
        alpha("alpha"), beta("beta")
        pm.HalfNormal("sigma_m", 1)
        psf.StateSpace("d", system, psf.EKF(), steps=steps, observed=record)
        idata = psf.sample_dram(
            1000, tune=1000, chains=4, cores=2, random_seed=1, progressbar=False,
            compute_convergence_checks=False,
        )  # fmt: skip
    return model, idata, record


def test_a_proper_prior_keeps_the_double_well_away_from_the_limit():
    model, idata, _ = double_well(
        lambda name: pm.Normal(name, 0, 10), lambda name: pm.Normal(name, 0, 10), seed=20
    )
    assert doubts(model, idata) == []


def test_one_well_under_a_wide_prior_reaches_the_limit():
    """Thesis, Case 2: nothing but the Euler limit 2 alpha dt = 2 ends the posterior of alpha."""
    model, idata, record = double_well(
        lambda name: pm.Uniform(name, 0, 200), lambda name: pm.Uniform(name, -200, 200), 0
    )
    assert (record > 0.2).all()
    message = "the posterior ends where the integration steps become unstable"
    with pytest.warns(EvidenceWarning, match=message):
        psf.chib_jeliazkov(idata, model, n_proposals=500, random_seed=1)


def test_models_without_an_integrator_are_left_alone():
    system = psf.StateSpaceModel(
        transition=lambda x, q, a: [(1 + 0.1 * a) * x[0] + q[0]],
        process_noise=[[0.1]],
        observation_noise=[[0.05]],
        initial_mean=[0.0],
        initial_cov=[[0.5]],
        **POSITION,
    )
    assert doubts(linear_model(system), near(-19.0)) == []
    with pm.Model() as model:
        a = pm.Normal("a")
        pm.Normal("y", a, 1, observed=0.3)
    assert doubts(model, near(0.0)) == []


def test_a_pickled_system_has_forgotten_its_integrator():
    again = pickle.loads(pickle.dumps(linear()))
    assert again == linear()
    assert again.integrator is None
    assert doubts(linear_model(again), near(-19.0)) == []


class TestRules:
    """Which draws are guilty, with losses and stability that are given instead of computed."""

    def doubts(self, monkeypatch, *, lost, overshoots, size=1):
        with pm.Model() as model:
            a = pm.Normal("a", 0, 10)
            pm.Normal("y", 0 * a, 1, observed=np.zeros(size))
        value = model.rvs_to_values[a]
        densities = model.logp(), model.logp() - lost(value)
        monkeypatch.setattr(checks, "densities_by_halvings", lambda model, halvings: densities)
        monkeypatch.setattr(
            checks,
            "step_stability",
            lambda model: lambda x: ~overshoots(x[:, 0]),
        )
        return doubts(model, near(-1.0, 1.0))

    def test_draws_that_do_not_overshoot_may_lose(self, monkeypatch):
        def lost(a):
            return pt.switch(a > 0, 20.0, 0.0)

        assert self.doubts(monkeypatch, lost=lost, overshoots=lambda a: a < 0) == []
        assert len(self.doubts(monkeypatch, lost=lost, overshoots=lambda a: a > 0)) == 1

    def test_only_overshooting_can_end_a_posterior(self, monkeypatch):
        """With finer steps the likelihood would go on rising where no draw is."""

        def lost(a):
            return pt.switch(abs(a) > 1.35, -20.0, 0.0)

        assert self.doubts(monkeypatch, lost=lost, overshoots=lambda a: abs(a) < 1) == []
        (doubt,) = self.doubts(monkeypatch, lost=lost, overshoots=lambda a: abs(a) > 1.35)
        assert doubt.startswith("the posterior ends where")

    @pytest.mark.parametrize(("loss", "is_doubt"), [(14.0, False), (16.0, True)])
    def test_a_long_record_may_lose_more(self, monkeypatch, loss, is_doubt):
        found = self.doubts(
            monkeypatch, lost=lambda a: loss + 0 * a, overshoots=lambda a: a < 0, size=100
        )
        assert bool(found) == is_doubt
