"""Likelihoods that a Python function evaluates for machine code."""

import numpy as np
import pytensor
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.distributed import CallbackLogLikelihood, PythonCallback
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.pymc_model.graph_rewrites import with_likelihood_callback
from pymc_statespace_filters.pymc_model.inspection import health_outputs
from tests.pymc_model.test_inspection import ENSEMBLE, FEW, filters_in, twins, two_systems
from tests.systems import FORCE, FORCED, FORCED_DATA, STEPS

OP = LogLikelihood(FORCED, ENSEMBLE)
RECORD = (STEPS, FORCED_DATA.reshape(-1, 1), FORCE.reshape(-1, 1), 0.5, 7)
THETA = np.array([0.6])


def evaluated_by(callback, theta=THETA, record=RECORD, number=3):
    return evaluator(CallbackLogLikelihood(FORCED, ENSEMBLE))(
        theta, *record, number, callback.address
    )


def test_the_callback_gets_the_arguments_of_the_filter():
    given = []

    def evaluate(*arguments):
        given.append(arguments)
        return np.array([1.0, -2.0, np.nan, -np.inf]), np.array([5.0, 1.0, 3.0])

    terms, health = evaluated_by(PythonCallback(evaluate))
    np.testing.assert_array_equal(terms, [1.0, -2.0, np.nan, -np.inf])
    np.testing.assert_array_equal(health, [5.0, 1.0, 3.0])
    (arguments,) = given
    for mine, theirs in zip(arguments, (3, THETA, *RECORD), strict=True):
        np.testing.assert_array_equal(mine, theirs)
        assert np.asarray(mine).dtype == np.asarray(theirs).dtype


def by_the_filter(number, *record):
    return evaluator(OP)(*record)


@pytest.mark.parametrize("mode", ["NUMBA", "FAST_COMPILE"])
def test_the_graph_gives_the_numbers_of_the_filter(mode):
    model = two_systems(FEW, ENSEMBLE)
    kinds = []

    def evaluate(number, *record):
        return evaluator(LogLikelihood(*kinds[number]))(*record)

    density = model.logp()
    graphs = [density, *health_outputs([density])]
    replaced, likelihoods = with_likelihood_callback(graphs, {})
    kinds += likelihoods.kinds
    a = model.value_vars[0]
    plain = pytensor.function([a], graphs, mode=mode)
    shared = pytensor.function([a, likelihoods.address], replaced, mode=mode)
    callback = PythonCallback(evaluate)
    for value in (0.7, -0.4, 2.0):
        for mine, theirs in zip(shared(value, callback.address), plain(value), strict=True):
            np.testing.assert_array_equal(mine, theirs)


def test_likelihoods_without_noise_stay():
    model = two_systems(psf.EKF(), FEW)
    replaced, likelihoods = with_likelihood_callback([model.logp()], {})
    assert likelihoods.kinds == ((FORCED, FEW),)
    assert filters_in(replaced) == sorted(map(repr, (psf.EKF(), FEW)))


def test_equal_systems_are_evaluated_each_with_its_seed():
    """Two variables of one system differ in the number given to the callback."""
    model = twins(FEW, FEW)
    seen = {}

    def evaluate(number, *record):
        seen[number] = record[-1]
        return np.zeros(STEPS.size), np.array([9.0, 0.0, -1.0])

    replaced, likelihoods = with_likelihood_callback([model.logp()], {})
    function = pytensor.function([model.value_vars[0], likelihoods.address], replaced)
    callback = PythonCallback(evaluate)
    function(0.3, callback.address)
    assert len(likelihoods.kinds) == 2
    assert sorted(seen) == [0, 1]
    assert set(seen.values()) == {1, 2}


def test_an_error_is_kept_and_the_callback_is_not_called_again():
    calls = []

    def evaluate(*arguments):
        calls.append(arguments)
        raise ValueError("no luck")

    callback = PythonCallback(evaluate)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="callback of a likelihood"):
            evaluated_by(callback)
    assert len(calls) == 1
    assert str(callback.error) == "no luck"


def test_a_wrong_record_never_reaches_the_callback():
    callback = PythonCallback(by_the_filter)
    steps, *rest = RECORD
    with pytest.raises(ModelError, match="increase strictly"):
        evaluated_by(callback, record=(steps[::-1], *rest))
    assert callback.error is None
    terms, health = evaluated_by(callback)
    expected = evaluator(OP)(THETA, *RECORD)
    np.testing.assert_array_equal(terms, expected[0])
    np.testing.assert_array_equal(health, expected[1])
