"""Pilots of a smaller model: what they lack comes from the prior, and the posterior is exact."""

import arviz as az
import numpy as np
import pymc as pm
import pytest
from scipy.stats import kstest, norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.sampling.run import population_search
from pymc_statespace_filters.sampling.starts import population
from pymc_statespace_filters.sampling.starts.population import nested_reference

T = np.linspace(-1.0, 1.0, 40)
NOISE, PRIOR = 0.02, 5.0
SEEN = 1.3 + 0.7 * T - 0.4 * T**2 + NOISE * np.random.default_rng(5).normal(size=T.size)
QUIET = {"random_seed": 1, "progressbar": False, "compute_convergence_checks": False}


def line(quadratic):
    """A regression, whose terms a and b the quadratic one shares."""
    with pm.Model() as model:
        a = pm.Normal("a", 0, PRIOR)
        bend = pm.Normal("bend", 0, PRIOR) if quadratic else 0.0
        b = pm.Normal("b", 0, PRIOR)
        pm.Normal("y", a + b * T + bend * T**2, NOISE, observed=SEEN)
    return model


def posterior():
    """Mean and covariance of a, bend and b."""
    design = np.stack([np.ones_like(T), T**2, T], axis=1)
    cov = np.linalg.inv(design.T @ design / NOISE**2 + np.eye(3) / PRIOR**2)
    return cov @ design.T @ SEEN / NOISE**2, cov


@pytest.fixture(scope="module")
def smaller():
    return psf.sample_dram(1000, 500, model=line(False), **QUIET)


@pytest.fixture
def searches(monkeypatch):
    """Numbers of points at which densities are evaluated from now on."""
    found, densities = [], population._densities

    def watched(*of):
        evaluate = densities(*of)

        def counting(x):
            found.append(len(x))
            return evaluate(x)

        return counting

    monkeypatch.setattr(population, "_densities", watched)
    return found


@pytest.fixture
def populations(monkeypatch):
    """Populations found from now on."""
    found, find = [], population.find_population

    def watched(*of, **named):
        found.append(find(*of, **named))
        return found[-1]

    monkeypatch.setattr(population_search, "find_population", watched)
    return found


def test_the_population_is_that_of_the_larger_posterior(smaller, populations):
    """The smaller model is wrong: its a lies 20 standard deviations off. Kolmogorov-Smirnov, 0.1 %.

    The third of the population after the last moves is nearly independent.
    """
    mean, cov = posterior()
    sd = np.sqrt(cov.diagonal())
    shift = smaller["posterior"]["a"].mean().item() - mean[0]
    assert abs(shift) > 20 * sd[0]
    tree = psf.sample_dram(1000, 500, model=line(True), pilot=smaller, **QUIET)
    for i, name in enumerate(("a", "bend", "b")):
        points = np.unique(populations[0].x[-256:, i])
        assert kstest(points, norm(mean[i], sd[i]).cdf).pvalue > 0.001
        # 4 standard errors of 1000 effective draws: one false alarm in five thousand runs
        drawn = tree["posterior"][name]
        assert drawn.mean() == pytest.approx(mean[i], abs=4 * sd[i] / np.sqrt(1000))
        assert drawn.std() == pytest.approx(sd[i], rel=4 / np.sqrt(2000))


def test_a_close_pilot_saves_evaluations(searches, populations):
    """Of a wide prior, the draws of two of three variables leave one to be found.

    Were the pilot's density a factor of the posterior, two of the deviations were 0.7 times theirs:
    four standard errors of 200 independent points.
    """
    rng = np.random.default_rng(1)
    mean, cov = posterior()
    drawn = rng.multivariate_normal(mean, cov, size=(2, 200))
    close = az.from_dict({"posterior": {"a": drawn[..., 0], "b": drawn[..., 2]}})
    counts = []
    for pilot in (None, close):
        searches.clear()
        psf.sample_dram(10, 10, model=line(True), pilot=pilot, **QUIET)
        counts.append(sum(searches))
    assert counts[1] < 0.85 * counts[0]
    found = populations[1].x[-256:].std(axis=0)
    np.testing.assert_allclose(found, np.sqrt(cov.diagonal()), rtol=0.2)


def test_the_reference_is_the_pilot_times_the_prior():
    """Where the pilot has two modes, so has the reference; a fifth of it is the prior's.

    A tenth of that lies near either mode.
    """
    rng = np.random.default_rng(2)
    known = np.full((400, 2), np.nan)
    known[:, 0] = np.where(rng.random(400) < 0.7, 3.0, -3.0) + 0.3 * rng.normal(size=400)
    prior = rng.normal(size=(256, 2)) * [10.0, 2.0]
    x = nested_reference(known, prior, rng).sample(20_000, rng)
    assert np.mean(abs(x[:, 0] - 3.0) < 1.5) == pytest.approx(0.56 + 0.02, abs=0.04)
    assert np.mean(abs(x[:, 0] + 3.0) < 1.5) == pytest.approx(0.24 + 0.02, abs=0.04)
    assert np.mean(abs(x[:, 0]) > 10.0) == pytest.approx(0.2 * 2 * norm.sf(1.0), abs=0.02)
    near = abs(abs(x[:, 0]) - 3.0) < 1.5
    quartiles = np.quantile(x[near, 1], [0.25, 0.75])
    np.testing.assert_allclose(quartiles, 2.0 * norm.ppf([0.25, 0.75]), atol=0.4)


def test_transforms_may_depend_on_what_the_pilot_lacks():
    with pm.Model() as model:
        top = pm.HalfNormal("top", 1.0)
        pm.Uniform("below", 0.0, top)
    below = np.random.default_rng(3).uniform(0.1, 0.3, size=(2, 50))
    tree = psf.sample_dram(
        20, 20, model=model, pilot=az.from_dict({"posterior": {"below": below}}), **QUIET
    )
    assert (tree["posterior"]["below"] < tree["posterior"]["top"]).all()


def models():
    with pm.Model() as other:
        pm.Normal("z", 0, 1)
    return {"line": line(False), "parabola": line(True), "other": other}


def test_run_models_gives_a_pilot_to_the_models_that_share_variables(smaller):
    asked = {"draws": 30, "tune": 20} | QUIET
    together = psf.run_models(models(), sampler="dram", pilot=smaller, **asked)
    some = psf.run_models(models(), sampler="dram", pilot={"line": smaller}, **asked)
    for name, model in models().items():
        alone = psf.sample_dram(model=model, pilot=None if name == "other" else smaller, **asked)
        without = psf.sample_dram(model=model, **asked)
        for variable in alone["posterior"].data_vars:
            expected = alone["posterior"][variable]
            np.testing.assert_array_equal(together[name]["posterior"][variable], expected)
            if name == "line":
                np.testing.assert_array_equal(some[name]["posterior"][variable], expected)
                assert not np.array_equal(without["posterior"][variable], expected)
            else:
                np.testing.assert_array_equal(
                    some[name]["posterior"][variable], without["posterior"][variable]
                )


STRANGE = az.from_dict({"posterior": {"w": np.random.default_rng(4).normal(size=(2, 30))}})


@pytest.mark.parametrize(
    ("pilot", "error", "message"),
    [
        ({"lin": STRANGE}, ModelError, "names of models, line, parabola, other, got 'lin'"),
        ({"line": STRANGE}, DataMismatchError, r"models\['line'\]: pilot: idata must have draws"),
        ({"line": 3}, ModelError, r"models\['line'\]: pilot: idata must be a DataTree"),
        (STRANGE, DataMismatchError, "pilot must have draws of a free variable .*, a, b, bend, z"),
        (3, ModelError, "pilot must be a DataTree or a mapping .* got int"),
    ],
)
def test_pilots_of_run_models_are_checked(pilot, error, message):
    with pytest.raises(error, match=message):
        psf.run_models(models(), sampler="dram", pilot=pilot, **QUIET)
