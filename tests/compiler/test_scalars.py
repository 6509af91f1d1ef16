"""Expressions are simplified as they are built, without changing what they mean."""

import math

import pytensor.scalar as ps
import pytest

from pymc_statespace_filters.compiler.codegen.expressions import (
    BOOLEAN,
    FLOAT,
    INTEGER,
    Arena,
    Expression,
    kind_of,
)


@pytest.fixture
def arena():
    return Arena()


@pytest.fixture
def x(arena):
    return arena.input("x.0")


def test_equal_expressions_are_one_object(arena, x):
    assert arena.apply(ps.sin, x) is arena.apply(ps.sin, x)
    assert arena.apply(ps.sin, x) is not arena.apply(ps.cos, x)


def test_constants_of_different_kinds_are_different(arena, x):
    assert arena.apply(ps.pow, 2, x) is not arena.apply(ps.pow, 2.0, x)


def test_neutral_and_absorbing_constants_vanish(arena, x):
    assert arena.apply(ps.add, x, 0.0) is x
    assert arena.apply(ps.mul, x, 1.0) is x
    assert arena.apply(ps.mul, x, 0.0) == 0.0
    assert arena.apply(ps.sub, x, x) == 0.0
    assert arena.apply(ps.true_div, x, 1.0) is x
    assert arena.apply(ps.neg, arena.apply(ps.neg, x)) is x
    assert len(arena) == 2  # x and -x


def test_constants_are_folded(arena):
    assert arena.apply(ps.true_div, 3, 2) == 1.5
    assert arena.apply(ps.int_div, 7, 2) == 3
    assert math.isnan(arena.apply(ps.log, -1.0))
    assert arena.apply(ps.true_div, 1.0, 0.0) == math.inf


def test_small_powers_are_products(arena, x):
    for exponent in (2, 3, 7, 16):
        power = arena.apply(ps.pow, x, exponent)
        assert isinstance(power.op, ps.Mul)
    assert isinstance(arena.apply(ps.pow, x, 2.5).op, ps.Pow)
    assert isinstance(arena.apply(ps.pow, x, 17).op, ps.Pow)


def test_a_truth_value_among_numbers_is_a_number(arena, x):
    truth = arena.apply(ps.gt, x, 0.0)
    other = arena.apply(ps.lt, x, 1.0)
    assert kind_of(truth) == BOOLEAN
    assert kind_of(arena.apply(ps.mul, truth, 1.0)) == FLOAT
    assert kind_of(arena.apply(ps.mul, truth, 1)) == INTEGER
    assert kind_of(arena.apply(ps.add, truth, 0)) == INTEGER
    # PyTensor, like numpy, adds and multiplies truth values to truth values.
    assert isinstance(arena.apply(ps.add, truth, other).op, ps.OR)
    assert isinstance(arena.apply(ps.mul, truth, other).op, ps.AND)


def test_a_switch_with_a_known_condition_is_its_branch(arena, x):
    y = arena.input("x.1")
    assert arena.apply(ps.switch, True, x, y) is x
    assert arena.apply(ps.switch, False, x, y) is y
    assert arena.apply(ps.switch, arena.apply(ps.gt, x, 0.0), y, y) is y


def test_numbers_tell_the_order_of_making(arena, x):
    y = arena.apply(ps.exp, x)
    assert isinstance(x, Expression)
    assert x.number < y.number
