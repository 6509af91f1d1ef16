"""Evidence of PyMC models: conjugate, transformed, truncated; exact draws and sampled ones."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import arviz as az
import numpy as np
import pymc as pm
import pytest
from scipy.integrate import quad
from scipy.stats import multivariate_normal, norm

from pymc_statespace_filters import progress
from pymc_statespace_filters.errors import DataMismatchError, EvidenceWarning, ModelError
from pymc_statespace_filters.evidence import (
    Evidence,
    chib_jeliazkov,
    compare_evidence,
    estimate_evidence,
    runner,
)
from pymc_statespace_filters.parallel import threads
from tests.evidence.analytic import Regression, autoregressive

RNG = np.random.default_rng(20)
REGRESSION = Regression(4, 30, RNG)


@pytest.fixture(scope="module")
def regression_model():
    return REGRESSION.model()


def exact_draws(shape=(4, 5000), correlation=0.0, seed=21):
    rng = np.random.default_rng(seed)
    w = REGRESSION.posterior(shape, rng, correlation=correlation).draws
    return az.from_dict({"posterior": {"w": w}})


def test_conjugate_regression(regression_model):
    idata = exact_draws(correlation=0.8)
    evidence = chib_jeliazkov(idata, regression_model, random_seed=1)
    assert evidence.se < 0.05
    assert abs(evidence.log_evidence - REGRESSION.log_evidence) < 4 * evidence.se
    assert (evidence.n_parameters, evidence.n_observations) == (4, 30)
    assert evidence.estimator == "chib_jeliazkov"
    assert evidence.noise == "none"
    at_best = norm.logpdf(REGRESSION.y, REGRESSION.x @ REGRESSION.mean, REGRESSION.sd).sum()
    assert evidence.max_log_likelihood == pytest.approx(at_best, abs=0.3)


def test_the_result_is_also_a_group(regression_model):
    idata = exact_draws((2, 200))
    with regression_model:
        evidence = chib_jeliazkov(idata, random_seed=1, n_proposals=200)
        again = chib_jeliazkov(idata, random_seed=1, n_proposals=200)
        other = chib_jeliazkov(idata, random_seed=2, n_proposals=200, extend_inferencedata=False)
    assert evidence == again != other
    group = idata["evidence"]
    assert group.sizes == {"estimator": 1}
    assert group["log_evidence"].item() == evidence.log_evidence
    assert group["n_proposals"].item() == 200
    assert group["data_fingerprint"].item() == evidence.data_fingerprint


class TestStandardDeviation:
    """y ~ N(0, s), s unknown: one parameter under a transform, the truth by quadrature."""

    y = np.array([0.4, -1.1, 0.6, 1.9, -0.2])

    def exact(self, prior, upper):
        def joint(s):
            return np.exp(norm.logpdf(self.y, scale=s).sum() + prior(s))

        evidence = quad(joint, 0, upper, epsabs=0, epsrel=1e-12)[0]
        grid = np.linspace(0, upper, 200_001)[1:]
        density = norm.logpdf(self.y[:, None], scale=grid).sum(0) + prior(grid)
        weights = np.exp(density - density.max())
        uniform = np.random.default_rng(22).uniform(size=(4, 2500))
        s = np.interp(uniform, np.cumsum(weights) / weights.sum(), grid)
        return np.log(evidence), az.from_dict({"posterior": {"s": s}})

    def test_box_without_a_transform(self):
        truth, idata = self.exact(lambda s: np.log(1 / 0.9) + 0 * s, 0.9)
        with pm.Model():
            s = pm.Uniform("s", 0, 0.9, default_transform=None)
            pm.Normal("y", 0, s, observed=self.y)
            evidence = chib_jeliazkov(idata, random_seed=1)
        assert idata["evidence"]["zero_density"].item() > 0.02
        assert abs(evidence.log_evidence - truth) < 4 * evidence.se < 0.12


def test_potentials_and_several_observed_variables_count():
    a, b = np.array([0.3, -0.5]), np.array([1.0, 0.2, 0.4])
    covariance = np.eye(6) * np.array([1, 1, 1, 1, 1, 1]) + 1.0
    with pm.Model():
        mu = pm.Normal("mu", 0, 1)
        pm.Normal("a", mu, 1, observed=a)
        pm.Normal("b", mu, 1, observed=b)
        pm.Potential("c", pm.logp(pm.Normal.dist(mu, 1), 0.9))
        rng = np.random.default_rng(23)
        total = a.sum() + b.sum() + 0.9
        draws = total / 7 + autoregressive((4, 2000), 0.5, rng) / np.sqrt(7)
        evidence = chib_jeliazkov(az.from_dict({"posterior": {"mu": draws}}), random_seed=1)
    truth = multivariate_normal(np.zeros(6), covariance).logpdf([*a, *b, 0.9])
    assert abs(evidence.log_evidence - truth) < 4 * evidence.se < 0.1
    assert evidence.n_observations == 5


def test_too_few_near_the_centre_is_a_warning(regression_model):
    with (
        pytest.warns(EvidenceWarning, match="chains disagree"),
        pytest.warns(EvidenceWarning, match=r"only \d+ effective draws .* fewer than 100"),
    ):
        found = chib_jeliazkov(
            exact_draws((2, 100), 0.95), regression_model, random_seed=1, n_proposals=400
        )
    # The result carries both reasons: what is common to all estimators, and its own.
    assert "chains disagree" in found.doubts
    assert "effective draws" in found.doubts


@pytest.mark.parametrize("exact", [True, False])
def test_the_evidence_tells_whether_the_likelihood_is_exact(regression_model, monkeypatch, exact):
    """Which filters are exact for which systems is tested with the filters."""
    monkeypatch.setattr(runner, "exactness", lambda model: exact)
    idata = exact_draws((2, 200))
    found = chib_jeliazkov(idata, regression_model, random_seed=1, n_proposals=200)
    assert found.approximate is not exact
    assert compare_evidence({"a": idata}).loc["a", "approximate"] == (not exact)


def test_the_number_of_threads_changes_no_number(regression_model, monkeypatch):
    pools = []

    def pool(n_threads):
        pools.append(n_threads)
        return ThreadPoolExecutor(n_threads)

    monkeypatch.setattr(threads, "ThreadPoolExecutor", pool)
    idata = exact_draws((2, 500))
    for estimate, settings in (
        (chib_jeliazkov, {"n_proposals": 400, "random_seed": 1}),
        (estimate_evidence, {"estimators": "bridge", "random_seed": 1}),
    ):
        found = []
        for cores in (1, 3):
            pools.clear()
            found.append(estimate(idata, regression_model, cores=cores, **settings))
            assert set(pools) == {cores}
        assert found[0] == found[1]


def test_slow_evaluations_have_a_progress_bar(regression_model, monkeypatch):
    bars = []

    class Bar(nullcontext):
        def __enter__(self):
            return self

        def add_task(self, description, completed, total):
            self.task, self.done, self.total = description, completed, total
            bars.append(self)

        def advance(self, task, advance):
            self.done += advance

    monkeypatch.setattr("pymc.progress_bar.create_simple_progress", Bar)
    for patience, wanted in ((60.0, True), (0.0, False), (0.0, True)):
        monkeypatch.setattr(progress, "PATIENCE", patience)
        idata = exact_draws((2, 200))
        chib_jeliazkov(idata, regression_model, n_proposals=200, progressbar=wanted)
        assert bool(bars) == (wanted and patience == 0.0)
    (bar,) = [bar for bar in bars if bar.task == "chib_jeliazkov"]
    assert bar.total == 200 <= bar.done


def test_other_data_are_an_error(regression_model):
    with regression_model:
        idata = pm.sample(
            50, tune=50, chains=1, random_seed=1, progressbar=False, nuts_sampler="pymc"
        )
    rival = REGRESSION.model(shift=0.5)
    with pytest.raises(DataMismatchError, match="other data"):
        chib_jeliazkov(idata, rival)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"log_evidence": np.nan}, "log_evidence"),
        ({"se": -1.0}, "se"),
        ({"noise": "loud"}, "noise"),
    ],
)
def test_evidence_is_validated(change, message):
    fields = {"log_evidence": -1.0, "se": 0.1, "estimator": "x", "n_parameters": 1}
    fields |= {"n_observations": 1, "max_log_likelihood": 0.0, "data_fingerprint": "f"}
    with pytest.raises(ModelError, match=message):
        Evidence(**(fields | change))
