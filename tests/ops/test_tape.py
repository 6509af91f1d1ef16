"""Value and gradient in one graph: one pass forwards, one back, and the same numbers as apart."""

import pickle

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.compile.mode import Mode
from pytensor.graph.basic import Apply

import pymc_statespace_filters as psf
from pymc_statespace_filters.ops.base import FilterOp, evaluator
from pymc_statespace_filters.ops.likelihood import (
    LogLikelihood,
    LogLikelihoodGradient,
    TapedLogLikelihood,
    TapePullback,
)
from tests.systems import PAIR, PAIR_DATA, STEPS

THETA = np.array([0.6, 0.2])
RECORD = (STEPS, PAIR_DATA, np.zeros((0, 0)), np.array(0.0), np.array(7))
# The rewrites of numba's mode, and no compilation of the graph, which one test has for all.
REWRITTEN = Mode(linker="py")
BARS = np.array([1.0, -2.0, 0.5, 3.0])  # tells apart which term a cotangent meets


def operations(function) -> list[type]:
    """The kinds of operations on a record in a compiled function, sorted by name."""
    nodes: list[Apply] = function.maker.fgraph.apply_nodes
    kinds = (type(node.op) for node in nodes if isinstance(node.op, FilterOp))
    return sorted(kinds, key=lambda kind: kind.__name__)


def value_and_gradient(theta, system=PAIR, record=RECORD):
    terms, health = LogLikelihood(system, psf.EKF())(theta, *record)
    return terms, health, pt.grad((terms * BARS[: len(record[0])]).sum(), theta)


@pytest.fixture(scope="module")
def together():
    theta = pt.dvector("theta")
    return pytensor.function([theta], value_and_gradient(theta))


def test_value_and_gradient_run_the_filter_forwards_once(together):
    assert operations(together) == [TapePullback, TapedLogLikelihood]


def test_value_and_gradient_are_those_of_the_operations_alone(together):
    terms, health, gradient = together(THETA)
    value_alone = evaluator(LogLikelihood(PAIR, psf.EKF()))(THETA, *RECORD)
    (gradient_alone,) = evaluator(LogLikelihoodGradient(PAIR, psf.EKF()))(THETA, *RECORD, BARS)
    np.testing.assert_allclose(terms, value_alone[0], rtol=1e-13)
    np.testing.assert_array_equal(health, value_alone[1])
    np.testing.assert_allclose(gradient, gradient_alone, rtol=1e-13)


def test_a_value_alone_has_no_tape_and_a_gradient_alone_no_value():
    theta = pt.dvector("theta")
    terms, health, gradient = value_and_gradient(theta)
    value_alone = pytensor.function([theta], [terms, health], mode=REWRITTEN)
    assert operations(value_alone) == [LogLikelihood]
    gradient_alone = pytensor.function([theta], gradient, mode=REWRITTEN)
    assert operations(gradient_alone) == [LogLikelihoodGradient]


def test_several_gradients_read_one_tape():
    theta = pt.dvector("theta")
    terms, _ = LogLikelihood(PAIR, psf.EKF())(theta, *RECORD)
    gradients = [pt.grad(terms[j], theta) for j in (0, 3)]
    function = pytensor.function([theta], [terms, *gradients], mode=REWRITTEN)
    assert operations(function) == [TapePullback, TapePullback, TapedLogLikelihood]
    _, first, last = function(THETA)
    alone = evaluator(LogLikelihoodGradient(PAIR, psf.EKF()))
    np.testing.assert_allclose(first, alone(THETA, *RECORD, np.eye(4)[0])[0], rtol=1e-13)
    np.testing.assert_allclose(last, alone(THETA, *RECORD, np.eye(4)[3])[0], rtol=1e-13)


def test_a_cotangent_may_depend_on_the_value():
    """d exp(L) = exp(L) dL: the pass back waits for the value, and both come of one tape."""
    theta = pt.dvector("theta")
    likelihood = pt.exp(LogLikelihood(PAIR, psf.EKF())(theta, *RECORD)[0].sum())
    both = [likelihood, pt.grad(likelihood, theta)]
    function = pytensor.function([theta], both, mode=REWRITTEN)
    assert operations(function) == [TapePullback, TapedLogLikelihood]
    value, gradient = function(THETA)
    alone = evaluator(LogLikelihoodGradient(PAIR, psf.EKF()))(THETA, *RECORD, np.ones(4))[0]
    np.testing.assert_allclose(gradient, value * alone, rtol=1e-12)


def test_likelihoods_at_other_parameters_are_no_help():
    theta, other = pt.dvectors("theta", "other")
    _, _, gradient = value_and_gradient(theta)
    both = [value_and_gradient(other)[0], gradient]
    function = pytensor.function([theta, other], both, mode=REWRITTEN)
    assert operations(function) == [LogLikelihood, LogLikelihoodGradient]


def test_modes_without_rewrites_or_numba_agree(together):
    theta = pt.dvector("theta")
    for mode in ("FAST_COMPILE", REWRITTEN):
        plain = pytensor.function([theta], value_and_gradient(theta), mode=mode)
        for a, b in zip(plain(THETA), together(THETA), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-13)


def test_a_failing_filter_leaves_no_tape_and_a_gradient_of_zero(together):
    terms, health, gradient = together(np.array([1e300, 0.2]))
    assert terms[-1] == -np.inf
    assert health[1] != 0
    np.testing.assert_array_equal(gradient, [0.0, 0.0])
    tape = evaluator(TapedLogLikelihood(PAIR, psf.EKF()))(np.array([1e300, 0.2]), *RECORD)[2]
    assert tape.shape[0] == 0


def test_an_empty_record_and_a_record_of_nothing_seen():
    theta = pt.dvector("theta")
    empty = (np.array([], dtype="int64"), np.zeros((0, 2)), *RECORD[2:])
    unseen = (np.array([0, 3]), np.full((2, 2), np.nan), *RECORD[2:])
    for record in (empty, unseen):
        both = value_and_gradient(theta, record=record)
        function = pytensor.function([theta], both, mode=REWRITTEN)
        terms, _, gradient = function(THETA)
        np.testing.assert_array_equal(terms, np.zeros(len(record[0])))
        np.testing.assert_array_equal(gradient, [0.0, 0.0])


def test_the_compiled_pair_survives_copying_and_pickling(together):
    restored = pickle.loads(pickle.dumps(together))
    for function in (together.copy(), restored):
        for a, b in zip(function(THETA), together(THETA), strict=True):
            np.testing.assert_array_equal(a, b)
