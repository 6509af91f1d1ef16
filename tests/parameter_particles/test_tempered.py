"""Tempered runs of PyMC models against exact evidences and posteriors."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.special import softmax
from scipy.stats import multivariate_normal

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import EvidenceWarning, ModelError
from pymc_statespace_filters.parameter_particles import whole_data
from pymc_statespace_filters.parameter_particles.output import _doubts
from pymc_statespace_filters.parameter_particles.particle_request import Run, check_alive
from pymc_statespace_filters.pymc_model.density import ModelDensity
from pymc_statespace_filters.pymc_model.posterior_draws import unconstrained_draws
from pymc_statespace_filters.smc.bridge import Cloud
from pymc_statespace_filters.smc.particles import Particles, Populations
from tests.parameter_particles.autoregression import exact, model

Y = np.random.default_rng(1).normal(1.0, 1.0, 12)


def conjugate():
    with pm.Model() as built:
        mu = pm.Normal("mu", 0, 2, shape=2)
        pm.Deterministic("sum", mu.sum())
        pm.Normal("y", mu[0], 1, observed=Y)
        pm.Normal("z", mu[1], 2, observed=Y[:5])
    return built


@pytest.fixture(scope="module")
def conjugate_run():
    return psf.sample_smc(200, model=conjugate(), random_seed=4, progressbar=False)


def _log_evidence(y, sd):
    cov = sd**2 * np.eye(y.size) + 4.0
    return multivariate_normal(np.zeros(y.size), cov).logpdf(y)


def test_evidence_and_moments_of_a_conjugate_model(conjugate_run):
    attrs, posterior = conjugate_run.attrs, conjugate_run["posterior"]
    truth = _log_evidence(Y, 1.0) + _log_evidence(Y[:5], 2.0)
    assert abs(attrs["log_evidence"] - truth) < 4 * attrs["log_evidence_se"] < 0.5
    precisions = np.array([12 + 0.25, 5 / 4 + 0.25])
    means = np.array([Y.sum(), Y[:5].sum() / 4]) / precisions
    errors = conjugate_run["mcse"].to_dataset()
    assert (abs(posterior["mu"].mean(("chain", "draw")) - means) < 4 * errors["mu"]).all()
    assert abs(posterior["sum"].mean() - means.sum()) < 4 * errors["sum"] < 0.3
    np.testing.assert_allclose(posterior["mu"].var(("chain", "draw")) * precisions, 1.0, rtol=0.15)


def test_the_result_is_that_of_a_sampler(conjugate_run):
    assert dict(conjugate_run["posterior"].sizes)["draw"] == 200
    table = psf.compare_evidence({"one": conjugate_run, "two": conjugate_run})
    np.testing.assert_allclose(table["prob"], 0.5)
    assert table["n_observations"].tolist() == [17, 17]
    found = psf.estimate_evidence(conjugate_run, conjugate(), random_seed=1, progressbar=False)[
        "importance"
    ]
    error = np.hypot(found.se, conjugate_run.attrs["log_evidence_se"])
    assert abs(found.log_evidence - conjugate_run.attrs["log_evidence"]) < 4 * error
    assert list(conjugate_run["evidence"]["estimator"].values) == ["smc", "importance"]


def test_populations_have_draws_in_proportion_to_their_evidence(conjugate_run):
    """The number of copies of a particle differs from its expectation by less than one."""
    population = conjugate_run["sample_stats"]["population"].values.ravel()
    assert (np.diff(population) >= 0).all()
    shares = np.bincount(population, minlength=10) / population.size
    expected = softmax(conjugate_run["smc"]["log_evidence"].values)
    np.testing.assert_allclose(shares, expected, atol=1.01 / population.size)


def test_evaluations_are_counted(conjugate_run):
    """Eleven populations of 23 chains, each of which proposes eight steps."""
    course = conjugate_run["smc"].to_dataset()
    assert (course["n_steps"] == 8).all()
    assert (course["n_evaluated"] == 11 * 23 * 8).all()


def test_the_seed_determines_the_result(conjugate_run):
    again = psf.sample_smc(200, model=conjugate(), random_seed=4, progressbar=False)
    assert again["posterior"].to_dataset().equals(conjugate_run["posterior"].to_dataset())
    assert again.attrs == conjugate_run.attrs


@pytest.mark.parametrize("waste_free", [True, False])
def test_a_particle_filter_is_exact_with_few_particles(waste_free):
    """Against quadrature of Kalman's likelihood; 4 errors are exceeded once in 16 000 tests."""
    built = model(psf.BootstrapPF(20))
    found = psf.sample_smc(
        150, model=built, waste_free=waste_free, random_seed=5, progressbar=False
    )
    truth = exact()
    attrs = found.attrs
    assert abs(attrs["log_evidence"] - truth.path[-1]) < 4 * attrs["log_evidence_se"] < 1.0
    error = found["mcse"]["a"].item()
    assert abs(found["posterior"]["a"].mean().item() - truth.mean) < 4 * error
    # The stored estimates are those of the stored seeds.
    x = unconstrained_draws(found, built).reshape(-1, 1)
    stats = found["sample_stats"]
    recomputed = ModelDensity(built).evaluate(x, stats["d_seed"].values.reshape(-1, 1))
    np.testing.assert_allclose(stats["lp"].values.ravel(), recomputed, rtol=1e-9)


def test_bad_input():
    built = conjugate()
    with pytest.raises(ModelError, match=r"draws must be at least twice .*4, got 3"):
        psf.sample_smc(3, model=built)
    with pytest.raises(ModelError, match="populations must be an integer of at least 2, got 1"):
        psf.sample_smc(10, model=built, populations=1)
    with pytest.raises(ModelError, match="data must be 'tempered' or 'sequential', got 'rows'"):
        psf.sample_smc(10, model=built, data="rows")
    with pytest.raises(ModelError, match="waste_free must be True or False, got 1"):
        psf.sample_smc(10, model=built, waste_free=1)
    with pm.Model() as discrete:
        pm.Poisson("n", 3)
    with pytest.raises(ModelError, match=r"discrete \['n'\]"):
        psf.sample_smc(10, model=discrete)
    with pm.Model() as flat:
        pm.Flat("m")
    with pytest.raises(ModelError, match="prior of m is improper"):
        psf.sample_smc(10, model=flat)
    with pm.Model() as impossible:
        pm.Uniform("y", pm.Normal("m"), 100.0, observed=-100.0)
    with pytest.raises(ModelError, match="positive at 0 of 10 draws of the prior"):
        psf.sample_smc(10, model=impossible)


def test_a_pilot_needs_particles_that_can_be_moved():
    """Four of one parameter."""
    with pm.Model() as built:
        pm.Normal("y", pm.Normal("m"), 1.0, observed=0.0)

    def cloud(n_alive):
        zero, none = np.zeros(9), np.empty((9, 0))
        increment = np.where(np.arange(9) < n_alive, 0.0, -np.inf)
        particles = Particles(zero[:, None], zero, zero, increment, none.astype(int), none)
        return Cloud(Populations.of_equal_weights(particles, 1), None)

    check_alive(built, cloud(4))
    with pytest.raises(ModelError, match="positive at 3 of 9 draws of the prior, fewer than 4"):
        check_alive(built, cloud(3))


def test_populations_that_differ_and_moves_that_fail_are_doubts():
    course = xr.Dataset({"acceptance": ("stage", [0.3, 0.01])})
    doubts = "; ".join(_doubts(Run(None, np.array([0.0, -5.0, -9.0]), course)))
    assert "a few of them decide" in doubts
    assert "rarely accepted (1.0% at worst)" in doubts
    assert not list(_doubts(Run(None, np.array([0.0, -0.1, 0.2]), course[{"stage": [0]}])))


def needle():
    """A wide well and one of mass 0.3 that is a hundredth as wide as the prior."""
    with pm.Model() as built:
        x = pm.Normal("x", 0, 10, shape=2)

        def well(mass, mean, sd):
            return np.log(mass) + pm.logp(pm.Normal.dist(mean, sd), x).sum()

        parts = well(0.7, [-4.0, 0.0], 1.0), well(0.3, [4.0, 0.0], 0.08)
        pm.Potential("wells", pm.math.logaddexp(*parts) - well(1.0, 0.0, 10.0))
    return built


def test_a_mode_that_all_populations_have_lost_is_a_doubt():
    settings = {"model": needle(), "random_seed": 3, "progressbar": False}
    with pytest.warns(EvidenceWarning, match="missed a part of the posterior") as caught:
        idata = psf.sample_smc(200, **settings)
    assert [one.filename for one in caught] == [__file__]
    assert (idata["posterior"]["x"][..., 0] < 0).all()
    (said,) = json.loads(idata.attrs["unvisited"])
    assert re.search(r"around x\[0\] = (4|4\.0\d|3\.9\d), x\[1\] = .*0\.0% of them lie there", said)
    assert said in str(idata["evidence"]["doubts"].values)
    with pytest.warns(EvidenceWarning, match="missed a part of the posterior"):
        found = psf.estimate_evidence(
            idata, estimators="importance", **settings | {"random_seed": 1}
        )
    assert said in found["importance"].doubts
    unchecked = psf.sample_smc(200, compute_convergence_checks=False, **settings)
    assert "unvisited" not in unchecked.attrs
    assert unchecked["posterior"].to_dataset().equals(idata["posterior"].to_dataset())


def test_a_run_that_lacks_nothing_says_so(conjugate_run):
    assert json.loads(conjugate_run.attrs["unvisited"]) == []


def test_an_interrupt_of_the_look_keeps_the_run(conjugate_run, monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(whole_data, "missed_mode", interrupted)
    found = psf.sample_smc(200, model=conjugate(), random_seed=4, progressbar=False)
    assert "unvisited" not in found.attrs
    assert found["posterior"].to_dataset().equals(conjugate_run["posterior"].to_dataset())


def test_a_run_too_short_for_a_look_does_not_say_that_it_has_looked():
    few = psf.sample_smc(20, model=conjugate(), populations=2, random_seed=1, progressbar=False)
    assert "unvisited" not in few.attrs


def test_populations_with_hardly_a_particle_of_positive_likelihood_are_a_doubt():
    alive = xr.DataArray([[9, 9], [9, 1], [9, 0]], dims=("population", "row"))
    course = xr.Dataset({"acceptance": ("row", [0.3, 0.3]), "n_alive": alive})
    one = Populations(SimpleNamespace(x=np.zeros((9, 1))), None)
    (doubt,) = _doubts(Run(Cloud(one, one), np.zeros(3), course))
    assert "2 of 3 populations had fewer than 4 particles" in doubt
    assert "first at observation 2" in doubt
