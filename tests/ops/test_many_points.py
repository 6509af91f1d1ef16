"""Values and gradients at arrays of points: the numbers of each point alone."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.ops import many_points, signatures
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.ops.many_points import gradients, values
from tests.systems import FORCE, FORCED, FORCED_DATA, PAIR, PAIR_DATA, STEPS, pair_terms

RECORD = (STEPS, PAIR_DATA, np.zeros((0, 0)), np.array(0.0), np.array(7))
rng = np.random.default_rng(1)
POINTS = np.column_stack([rng.uniform(-0.9, 0.9, 12), rng.normal(size=12)])
BARS = rng.normal(size=(12, 4))
FAILS = np.array([1e300, 0.2])

# Two records of four and two rows with codes of their own, each with its stretch of the inputs.
ROWS = np.array([[9, 0, 0], [9, 2, 0], [9, 3, 0], [9, 6, 0], [-4, 1, 2], [-4, 3, 2]])
PANEL = (ROWS, np.append(FORCED_DATA, [0.3, 1.1])[:, None], FORCE[:, None], *RECORD[3:])
PANELS = rng.uniform(-0.9, 0.9, (6, 2, 1))


def lead(record, n=1):
    """A record of all points, as JAX brings it: with leading dimensions of length one."""
    return [np.reshape(value, (1,) * n + np.shape(value)) for value in record]


def alone(op, points, record, *bars):
    """The results at each point, stacked."""
    evaluate = evaluator(op)
    each = zip(points, *bars, strict=True)
    results = [evaluate(point, *record, *bar) for point, *bar in each]
    return [np.stack(of_all) for of_all in zip(*results, strict=True)]


def assert_same(found, wanted):
    for a, b in zip(found, wanted, strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


@pytest.fixture
def evaluations(monkeypatch):
    """The kinds of operations that are called, one entry for each call."""
    calls = []

    def counted(op):
        evaluate = evaluator(op)
        return lambda *args: calls.append(f"{type(op).__name__}, {op.form.name}") or evaluate(*args)

    monkeypatch.setattr(many_points, "evaluator", counted)
    return calls


def test_the_values_are_those_of_kalman():
    terms, _ = values(LogLikelihood(PAIR, psf.EKF()), POINTS, *lead(RECORD))
    np.testing.assert_allclose(terms, [pair_terms(a, b) for a, b in POINTS], rtol=1e-10)


def test_points_of_one_record_are_evaluated_side_by_side(evaluations):
    op = LogLikelihood(PAIR, psf.EKF())
    assert_same(values(op, POINTS, *lead(RECORD)), alone(op, POINTS, RECORD))
    found = gradients(op.gradient(), POINTS, *lead(RECORD), BARS)
    assert_same(found, alone(op.gradient(), POINTS, RECORD, BARS))
    assert evaluations == [
        "LogLikelihood, points", "TapedLogLikelihood, panel", "TapePullback, panel"
    ]  # fmt: skip


def test_panels_of_many_points_are_one_panel(evaluations):
    op = LogLikelihood(FORCED, psf.EKF(), signatures.PANEL)
    bars = rng.normal(size=(6, 6))
    assert_same(values(op, PANELS, *lead(PANEL)), alone(op, PANELS, PANEL))
    found = gradients(op.gradient(), PANELS, *lead(PANEL), bars)
    assert_same(found, alone(op.gradient(), PANELS, PANEL, bars))
    assert evaluations == [
        "LogLikelihood, panel", "TapedLogLikelihood, panel", "TapePullback, panel"
    ]  # fmt: skip


def test_a_point_that_fails_touches_no_other():
    points = POINTS.copy()
    points[[1, 5]] = FAILS
    op = LogLikelihood(PAIR, psf.EKF())
    found = values(op, points, *lead(RECORD))
    assert found[0][1, -1] == -np.inf
    assert_same(found, alone(op, points, RECORD))
    (theta_bar,) = gradients(op.gradient(), points, *lead(RECORD), BARS)
    np.testing.assert_array_equal(theta_bar[[1, 5]], 0.0)
    assert np.all(theta_bar[[0, 2]] != 0.0)
    assert_same([theta_bar], alone(op.gradient(), points, RECORD, BARS))


def test_a_panel_with_a_record_that_fails_touches_no_other():
    points = PANELS.copy()
    points[2, 1] = 1e300
    op = LogLikelihood(FORCED, psf.EKF(), signatures.PANEL)
    found = values(op, points, *lead(PANEL))
    assert found[1][2, 1] != 0
    assert_same(found, alone(op, points, PANEL))
    bars = rng.normal(size=(6, 6))
    found = gradients(op.gradient(), points, *lead(PANEL), bars)
    np.testing.assert_array_equal(found[0][2], 0.0)
    assert_same(found, alone(op.gradient(), points, PANEL, bars))


def test_several_leading_dimensions_and_a_cotangent_for_each_term():
    op = LogLikelihood(PAIR, psf.EKF())
    wanted = alone(op, POINTS, RECORD)
    found = values(op, POINTS.reshape(3, 4, 2), *lead(RECORD, 2))
    assert_same(found, [w.reshape(3, 4, -1) for w in wanted])
    (jacobian,) = gradients(op.gradient(), POINTS[:1], *lead(RECORD), np.eye(4))
    assert_same([jacobian], alone(op.gradient(), np.tile(POINTS[0], (4, 1)), RECORD, np.eye(4)))


def test_one_point_with_and_without_a_leading_dimension():
    op = LogLikelihood(PAIR, psf.EKF())
    wanted = alone(op, POINTS[:1], RECORD)
    assert_same(values(op, POINTS[0], *RECORD), [w[0] for w in wanted])
    assert_same(values(op, POINTS[:1], *lead(RECORD)), wanted)
    assert_same(values(op, POINTS[:1], *lead(RECORD))[:1], wanted[:1])


def test_records_that_differ_are_evaluated_in_turn(evaluations):
    op = LogLikelihood(PAIR, psf.EKF())
    data = PAIR_DATA + np.arange(3)[:, None, None]
    record = lead(RECORD)
    record[1] = data
    terms, _ = values(op, POINTS[:3], *record)
    wanted = [pair_terms(a, b, observed=d) for (a, b), d in zip(POINTS[:3], data, strict=True)]
    np.testing.assert_allclose(terms, wanted, rtol=1e-10)
    gradients(op.gradient(), POINTS[:3], *record, BARS[:3])
    of_one = ["LogLikelihood, one record"] * 3 + ["LogLikelihoodGradient, one record"] * 3
    assert evaluations == of_one


def test_filters_of_single_points_are_evaluated_in_turn(evaluations):
    op = LogLikelihood(PAIR, psf.BootstrapPF(20))
    assert_same(values(op, POINTS[:3], *lead(RECORD)), alone(op, POINTS[:3], RECORD))
    assert evaluations == ["LogLikelihood, one record"] * 3


def test_a_record_without_rows():
    op = LogLikelihood(PAIR, psf.EKF())
    empty = (STEPS[:0], PAIR_DATA[:0], *RECORD[2:])
    terms, _ = values(op, POINTS[:3], *lead(empty))
    assert terms.shape == (3, 0)
    (theta_bar,) = gradients(op.gradient(), POINTS[:3], *lead(empty), BARS[:3, :0])
    np.testing.assert_array_equal(theta_bar, np.zeros((3, 2)))
