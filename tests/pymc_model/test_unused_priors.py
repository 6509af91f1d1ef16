"""Priors that reach no likelihood are named, and those that are meant so are not."""

import re

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError, ModelWarning
from pymc_statespace_filters.pymc_model.inspection import check_observed
from pymc_statespace_filters.pymc_model.unused_priors import warn_of_unused_priors
from pymc_statespace_filters.sampling.target.sampled_model import SampledModel
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from tests.systems import PAIR, PAIR_DATA, STEPS, pair_terms

pytestmark = pytest.mark.usefixtures("interpreted")


def model_with(add):
    """PAIR, whose parameter b has a default, with a prior of a and what ``add`` adds."""
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.2)
        add()
        psf.StateSpace("d", PAIR, psf.EKF(), steps=STEPS, observed=PAIR_DATA)
    return model


def test_a_misspelt_prior_is_named_with_the_default_that_is_used_instead():
    model = model_with(lambda: pm.Normal("beta"))
    said = r"prior of 'beta' reaches no likelihood.*parameter 'b' of 'd' is fixed.*'b': beta"
    with pytest.warns(ModelWarning, match=said):
        SampledModel(model, None, RandomWalkSettings())
    SampledModel(model, None, RandomWalkSettings())  # a model is told once
    model = model_with(lambda: pm.Normal("beta"))
    with model, pytest.warns(ModelWarning, match=said):  # as a sampler of PyMC asks
        found = model.logp(vars=[model["d"]])
    at = {model.rvs_to_values[model["a"]]: 0.5}
    np.testing.assert_allclose(found.eval(at), pair_terms(0.5).sum(), rtol=1e-12)


def test_data_without_a_number_are_named():
    with pm.Model():
        pm.Normal("a", 0.5, 0.2)
        with pytest.warns(ModelWarning, match="observed of 'd' has no number, all of its"):
            psf.StateSpace("d", PAIR, psf.EKF(), steps=STEPS, observed=np.nan * PAIR_DATA)


@pytest.mark.parametrize(
    "add", [lambda: pm.HalfNormal("t"), lambda: pm.Deterministic("rate", 1 / pm.HalfNormal("t"))]
)
def test_a_prior_with_a_reserved_name_is_named(add):
    with pytest.warns(ModelWarning, match=r"prior of 't' .*: 't' is the time .* never a parameter"):
        warn_of_unused_priors(model_with(add))


def test_a_value_for_a_reserved_name_is_named():
    with pytest.raises(ModelError, match=r"\['a', 'b'\], got \['t'\]; 't' is the time"):
        psf.log_likelihood(PAIR, psf.EKF(), {"t": 1.0}, PAIR_DATA, steps=STEPS)


def test_a_variable_without_data_is_not_sampled():
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.2)
        psf.StateSpace("d", PAIR, psf.EKF(), steps=STEPS)
    with pytest.raises(ModelError, match="'d' has no data, so that its values would be sampled"):
        psf.sample(model=model)
    with pytest.raises(ModelError, match="'d' has no data"):
        pm.sample(step=psf.DRAM(model=model), model=model)
    with model:  # seen through another variable
        pm.Poisson("counts", pt.exp(model["d"][:, 0]), observed=np.ones(len(STEPS), dtype=int))
    check_observed(model)


def test_a_group_of_priors_that_reaches_nothing_is_named():
    def chain():
        pm.Normal("level", pm.Normal("mean"))

    with pytest.warns(ModelWarning) as caught:
        warn_of_unused_priors(model_with(chain))
    assert [str(w.message).split("'")[1] for w in caught] == ["mean", "level"]


@pytest.mark.parametrize(
    "add",
    [
        lambda: pm.Normal("b"),
        lambda: pm.Deterministic("y", 2.0 * pm.Normal("b0")),
        lambda: pm.Potential("p", -(pm.Normal("c") ** 2)),
        lambda: pm.Normal("other", pm.Normal("c"), observed=[1.0]),
        lambda: pm.Normal("new group", pm.Normal("b")),
        lambda: psf.StateSpace("e", PAIR, psf.EKF(), steps=STEPS, params={"a": pm.Normal("c")}),
    ],
    ids=["reached", "Deterministic", "Potential", "other data", "predicted", "simulated"],
)
def test_what_is_meant_is_not_named(add, recwarn):
    warn_of_unused_priors(model_with(add))
    assert not recwarn


def test_a_model_without_data_has_no_unused_prior(recwarn):
    with pm.Model() as model:
        pm.Normal("a")
        pm.Normal("beta")
        psf.StateSpace("d", PAIR, psf.EKF(), steps=STEPS)
    warn_of_unused_priors(model)
    assert not recwarn


SETTINGS = dict(initial_mean=[0.0], initial_cov=[[1.0]], observation_noise=[[1.0]])


def test_a_state_by_another_name_is_refused_with_the_names_that_are_reserved():
    with pytest.raises(ModelError, match=r"transition .*IndexError.* no argument x, the state"):
        psf.StateSpaceModel(lambda state, a: [a * state[0]], lambda x: [x[0]], **SETTINGS)
    with pytest.raises(ModelError, match=r"observation must have the argument x, .*'state'"):
        psf.StateSpaceModel(lambda x, a: [a * x[0]], lambda state: [state], **SETTINGS)


# Numbers that stand for a missing value are named, and large but honest ones are not.


RNG = np.random.default_rng(1)
TEMPERATURES, COUNTS = 15.0 + 8.0 * RNG.standard_normal(40), RNG.poisson(0.4, 400).astype(float)


def observe(column, as_data=lambda data: data):
    observed = np.column_stack([RNG.standard_normal(len(column)), column])
    with pm.Model():
        psf.StateSpace(
            "d", PAIR, psf.EKF(), params={"a": 0.5}, steps=range(1, len(column) + 1),
            observed=as_data(observed),
        )  # fmt: skip


def with_codes(column, rows, code):
    return np.where(np.isin(np.arange(len(column)), rows), code, column)


@pytest.mark.parametrize("code", [-999.0, -9999.0, 9999.0, 1e20])
@pytest.mark.parametrize("rows", [[3], [3, 17, 18]])
def test_a_code_of_missing_values_is_named(code, rows):
    with pytest.warns(
        ModelWarning, match=rf"speed = {re.escape(f'{code:g}')} in .*row 3, .* put NaN there"
    ):
        observe(with_codes(TEMPERATURES, rows, code))


@pytest.mark.parametrize("code", [-99.0, -999.0, 999.0])
def test_a_usual_code_among_digits_is_named(code):
    """-99 among 0 to 9 is eleven times their range away, and no outlier."""
    digits = with_codes(RNG.integers(0, 10, 60).astype(float), [7], code)
    with pytest.warns(ModelWarning, match=rf"speed = {code:g} in row 7, more than 1\.5 times"):
        observe(digits)
    for honest in (-98.0, 90.0):
        observe(with_codes(digits, [7], honest))


def test_a_code_in_data_that_can_be_set_is_named():
    with pytest.warns(ModelWarning, match="speed = -999 in row 0"):
        observe(with_codes(TEMPERATURES, [0], -999.0), lambda data: pm.Data("seen", data))


def test_a_code_is_named_without_a_model():
    observed = np.column_stack([TEMPERATURES, with_codes(TEMPERATURES, [3], -999.0)])
    steps = range(1, len(observed) + 1)
    with pytest.warns(ModelWarning, match="speed = -999 in row 3"):
        psf.log_likelihood(PAIR, psf.EKF(), {"a": 0.5}, observed, steps=steps)


@pytest.mark.parametrize(
    "column",
    [
        TEMPERATURES,
        with_codes(TEMPERATURES, [3], np.nan),
        with_codes(TEMPERATURES, [3], 90.0),  # an outlier
        COUNTS,
        np.exp(np.linspace(0.0, 12.0, 40)),  # growth
        np.exp(-np.array([0.0, 4.0, 4.1, 4.5, 5.0, 6.0, 7.5, 9.0])),  # decay, seen late
        np.append(np.zeros(30), 1e6),  # a step
        RNG.standard_t(3, 400),
        np.full(20, -999.0),
    ],
    ids=[
        "plain",
        "missing",
        "outlier",
        "counts",
        "growth",
        "decay",
        "step",
        "heavy tails",
        "constant",
    ],
)
def test_honest_numbers_are_not_named(column, recwarn):
    observe(column)
    assert not recwarn
