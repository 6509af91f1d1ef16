"""What chains that mix slowly are told to do."""

from types import SimpleNamespace

import arviz as az
import numpy as np
import pymc as pm

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice.ended_nuts import where_diverging
from pymc_statespace_filters.advice.mixing import mixing_problem, until_ess_problem
from pymc_statespace_filters.advice.remedies import (
    alternatives,
    reaches_zero,
    ways_to_mix,
)
from pymc_statespace_filters.checks.coverage import ALL_MODES
from pymc_statespace_filters.sampling.output.convergence import Convergence
from pymc_statespace_filters.sampling.output.facts import EndedDram, EndedNuts

RNG = np.random.default_rng(0)
NORMAL = RNG.normal(size=4000)


def drawn(stiffness, names=("stiffness", "other"), part=1.0):
    """Unconstrained draws of a positive variable, and of another one that makes up for a part."""
    with pm.Model() as model:
        pm.HalfNormal("stiffness", 1)
        pm.Normal("other", 0, 1)
        pm.Normal("y", model["stiffness"] + model["other"], 1, observed=0.3)
    other = RNG.normal(size=4000) - part * stiffness / stiffness.std()
    return model, names, np.column_stack([np.log(stiffness), other])


def test_a_posterior_that_reaches_zero():
    for half_width in (0.01, 1.0, 100.0):
        assert reaches_zero(*drawn(half_width * abs(NORMAL))) == "stiffness"
    assert reaches_zero(*drawn(RNG.exponential(size=4000))) == "stiffness"


def test_one_that_does_not():
    assert reaches_zero(*drawn(5 + NORMAL)) is None  # none of 4000 below zero
    assert reaches_zero(*drawn(np.exp(1.5 * NORMAL))) is None  # wide, and without density at zero
    assert reaches_zero(*drawn(RNG.gamma(3, size=4000))) is None


def test_one_for_which_no_other_makes_up():
    """As the common scale of a horseshoe, which no other transform would help."""
    assert reaches_zero(*drawn(abs(NORMAL), part=0.0)) is None


def test_the_scale_of_others_is_left_out():
    with pm.Model() as model:
        tau = pm.HalfNormal("tau", 1)
        pm.Normal("theta", 0, tau)
    positions = np.column_stack([np.log(abs(NORMAL)), NORMAL])
    assert reaches_zero(model, ["tau", "theta"], positions) is None


def test_the_advice():
    model, names, positions = drawn(abs(NORMAL))
    (way,) = ways_to_mix(model, names, positions, "other")
    assert way.startswith("sample stiffness as it is, whose logarithm")
    found = Convergence(np.array([900.0]), np.array([900.0]), np.array([1.02]))
    request = SimpleNamespace(chains=4, draws=1000, doubles_thin=False)
    names, model = ["stiffness"], pm.Model()
    ended = SimpleNamespace(request=request, convergence=found, names=names, model=model)
    assert mixing_problem(ended, lambda name: [way]).endswith(
        f"(stiffness). If R-hat stays above 1.01, {way}."
    )
    model, names, positions = drawn(5 + NORMAL)
    assert alternatives(ways_to_mix(model, names, positions, "other")) == (
        "tune longer, or reparametrise other"
    )


def test_chains_that_cannot_go_on_are_not_told_to():
    """`continue_from` refuses draws of NUTS, whose chains had reached the limit of time."""
    found = Convergence(np.array([900.0]), np.array([900.0]), np.array([1.02]))
    request = SimpleNamespace(
        until_ess=4000.0, chains=4, draws=2000, doubles_thin=True, max_draws=10**6, seconds=300.0
    )
    length = SimpleNamespace(n_iterations=2000)
    ended = {"request": request, "length": length, "convergence": found, "names": ["a"]}
    ended |= {"model": pm.Model()}
    for goes_on, way in ((True, "continue_from=idata"), (False, "until_ess=None), which has no")):
        fact = SimpleNamespace(**ended, seconds=200.0, goes_on=goes_on)
        text = until_ess_problem(fact, lambda name: [])
        assert way in text
        assert ("continue_from" in text) is goes_on
    assert EndedDram.goes_on
    assert not EndedNuts.goes_on


def test_draws_of_separate_modes_are_to_be_drawn_from_the_prior():
    """A heavy tail is no mode."""
    model, names, positions = drawn(5 + NORMAL)
    positions[:400, 1] = 20 + NORMAL[:400]
    assert ways_to_mix(model, names, positions, "other") == [ALL_MODES]
    positions[:, 1] = RNG.standard_t(2, size=4000)
    assert ways_to_mix(model, names, positions, "other") != [ALL_MODES]


def test_the_advice_works():
    """A sum is known, its parts are not, and one of them is positive."""
    least = []
    for transform in ({}, {"default_transform": None}):
        with pm.Model() as model:
            a, b = pm.HalfNormal("a", 1, **transform), pm.Normal("b", 0, 1)
            pm.Normal("y", a + b, 0.001, observed=0.3)
        idata = psf.sample_dram(
            4000, tune=1000, model=model, random_seed=1, progressbar=False,
            compute_convergence_checks=False,
        )  # fmt: skip
        least.append(az.summary(idata)["ess_tail"].min())
    assert least[1] > 5 * least[0]


def test_where_draws_diverge_is_said_of_no_variable_by_chance():
    """In a hundred sets of draws of 200 variables, 72 of which diverge anywhere, about five."""
    rng, names = np.random.default_rng(3), [f"x[{i}]" for i in range(200)]
    diverging = np.arange(1000) % 14 == 0
    named = [where_diverging(names, rng.normal(size=(1000, 200)), diverging) for _ in range(100)]
    assert sum(map(bool, named)) <= 10
    x = rng.normal(size=(1000, 200))
    assert where_diverging(names, x, x[:, 7] < -1.5) == "x[7] is small"
    assert where_diverging(names, x, x[:, 8] > 2.0) == "x[8] is large"
