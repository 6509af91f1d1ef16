"""Mirror images of a posterior are named with a cure that works; other posteriors have none."""

import logging
from dataclasses import dataclass

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice.mirrors import in_one_image, mirror_sentence, mirrors_within
from pymc_statespace_filters.checks.coverage.mirrors import Mirror
from pymc_statespace_filters.checks.coverage.sentences import stored
from pymc_statespace_filters.pymc_model.density import ModelDensity
from pymc_statespace_filters.sampling.output.convergence import Convergence, convergence

STEPS = np.arange(100)
TRUTH = {"k": 0.3, "c": 1.0, "a": 0.3, "h0": 1.0}
IMAGES = "two mirror images of the posterior: its density is the same with the signs of"


def system(square=0.0):
    """A state that is not measured moves one that is: all is odd in it, but for the square."""
    return psf.StateSpaceModel(
        transition=psf.EulerMaruyama(
            lambda x, k, c, a: [c * x[1] - k * x[0], -a * x[1] + square * x[1] ** 2],
            np.diag([0.001, 0.5]),
            dt=0.1,
        ),
        observation=lambda x: [x[0]],
        observation_noise=[[0.03**2]],
        initial_mean=lambda h0: [0.0, h0],
        initial_cov=[[0.01, 0.0], [0.0, 0.01]],
    )


def model_of(square=0.0, prior=pm.Normal):
    simulated = psf.simulate(system(square), TRUTH, steps=STEPS, random_seed=1)
    with pm.Model() as model:
        pm.HalfNormal("k", 0.5)
        pm.HalfNormal("a", 0.5)
        prior("c", sigma=1.0)
        pm.Normal("h0", 0.0, 1.0)
        observed = simulated["observations"].values
        psf.StateSpace("y", system(square), psf.EKF(), steps=STEPS, observed=observed)
    return model


def near(truth, model, width=0.05):
    """Draws (4, 200, 4) around a point, the unconstrained ones."""
    start = model.initial_point()
    values = {"k": np.log(truth["k"]), "a": np.log(truth["a"]), "c": truth["c"], "h0": truth["h0"]}
    centre = [values[name.removesuffix("_log__")] for name in start]
    return centre + width * np.random.default_rng(1).normal(size=(4, 200, 4))


def found_of(model):
    return mirrors_within(np.inf, model, near(TRUTH, model), ModelDensity(model).evaluate)


def test_the_signs_of_a_hidden_state_are_named():
    model = model_of()
    (found,) = found_of(model)
    text = mirror_sentence(model, found)
    assert text.startswith(f"all chains are in one of {IMAGES} c and h0 turned together")
    assert "give c, which is clear of zero, a prior of one sign (pm.HalfNormal)" in text


@pytest.mark.parametrize("changed", [{"square": 1e-6}, {"prior": pm.HalfNormal}])
def test_there_is_none_with_a_square_or_a_positive_prior(changed):
    assert found_of(model_of(**changed)) == []


def test_a_sign_is_one_of_the_parameter():
    """As of a uniform prior that is symmetric, and not of a logarithm or a simplex."""
    with pm.Model() as model:
        pm.HalfNormal("a")
        pm.Normal("b")
        pm.Uniform("c", -1, 1)
        pm.Uniform("d", 0, 1)
        pm.Dirichlet("e", np.ones(3))
    draws = 2 + 0.1 * np.random.default_rng(1).normal(size=(4, 200, 6))

    def evaluate(x):
        """Each pair of the first four may turn by itself, and the last two."""
        pairs = x[:, 0] * x[:, 1], x[:, 2] * x[:, 3], x[:, 1] * x[:, 2], x[:, 4] * x[:, 5]
        return -50 * sum((pair - 4) ** 2 for pair in pairs)

    assert mirrors_within(np.inf, model, draws, evaluate) == []
    with pm.Model() as other:
        pm.Uniform("c", -1, 1, shape=4)
        pm.Normal("b", shape=2)
    one, two = mirrors_within(np.inf, other, draws, evaluate)
    assert sorted(sorted(mirror.turned) for mirror in (one, two)) == [[0, 1, 2, 3], [4, 5]]


def test_a_search_ends_with_its_time():
    model = model_of()
    assert mirrors_within(-1.0, model, near(TRUTH, model), ModelDensity(model).evaluate) == []


def test_the_time_of_a_search_is_looked_at_between_few_points():
    sizes, model = [], model_of()

    def evaluate(x):
        sizes.append(len(x))
        return ModelDensity(model).evaluate(x)

    assert mirrors_within(np.inf, model, near(TRUTH, model), evaluate)
    assert max(sizes) == 64


@pytest.mark.parametrize(
    ("share", "begin"),
    [
        ([0, 1, 0, 0], "chains 0, 2 and 3 are in one and 1 in the other of "),
        ([0.5, 0.4, 0.6, 1], "the chains pass between "),
        ([0.03, 0.03, 0.03, 0.03], "the chains pass between "),
        ([1, 1, 1, 1], "all chains are in one of "),
    ],
)
def test_where_the_chains_are(share, begin):
    with pm.Model() as model:
        pm.Normal("f", shape=20)
    mirror = Mirror(np.arange(19)[::-1], True, np.array(share, dtype=float), np.zeros((4, 2, 20)))
    text = mirror_sentence(model, mirror)
    assert text.startswith(
        f"{begin}{IMAGES} f[18], f[17], f[16], f[15], f[14], f[13] and 13 others"
    )
    assert "give f[18], which is clear of zero, a prior of one sign (in a vector" in text


def test_a_field_without_a_clear_coefficient_has_another_cure():
    with pm.Model() as model:
        pm.Normal("f", shape=20)
    mirror = Mirror(np.arange(19), False, np.zeros(4), np.zeros((4, 2, 20)))
    text = mirror_sentence(model, mirror)
    assert "none of them is clear of zero" in text
    assert "slope > 0" in text


def test_a_single_sign_of_both_kinds_has_the_words_of_scales():
    with pm.Model() as model:
        pm.Normal("s")
    mirror = Mirror(np.array([0]), True, np.array([0.0, 0.5]), np.zeros((2, 2, 1)))
    assert mirror_sentence(model, mirror).startswith("the density is the same at s and -s, and 25%")


@dataclass
class Run:
    """What is replaced in that of a sampler."""

    convergence: Convergence | None
    positions: np.ndarray


def test_chains_are_compared_in_one_image():
    """In which they agree; if all are in one, nothing is turned."""
    folded = np.random.default_rng(1).normal(3, 1, size=(4, 500, 1))
    draws = folded * np.array([1, -1, 1, 1])[:, np.newaxis, np.newaxis]
    fact = Run(convergence(list(draws)), draws.reshape(-1, 1))
    assert fact.convergence.rhat[0] > 1.5
    split = in_one_image(
        fact, [Mirror(np.array([0]), True, np.array([0.0, 1.0, 0.0, 0.0]), folded)]
    )
    assert split.convergence.rhat[0] < 1.01
    np.testing.assert_array_equal(split.positions, folded.reshape(-1, 1))
    assert in_one_image(fact, [Mirror(np.array([0]), True, np.ones(4), folded)]) is fact


@pytest.mark.parametrize("prior", [pm.Normal, pm.HalfNormal])
def test_a_run_names_the_images_and_not_chains_that_are_too_short(prior, caplog):
    """No more is said of modes before the run, and nothing with the prior that is advised."""
    with caplog.at_level(logging.DEBUG, logger="pymc"):
        idata = psf.sample(
            500, model=model_of(prior=prior), sampler="nuts", random_seed=1, progressbar=False,
            max_draws=2000,
        )  # fmt: skip
    is_mirrored = prior is pm.Normal
    assert caplog.text.count(f"{IMAGES} c and h0 turned together") == is_mirrored
    assert caplog.text.count("mirror images") == is_mirrored
    assert [IMAGES in text for text in stored(idata) or []] == [True] * is_mirrored
    assert "separate modes" not in caplog.text
    assert "until_ess=400 was not reached" not in caplog.text
