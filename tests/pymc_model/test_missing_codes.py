"""Numbers that stand for a missing value are named, and large but honest ones are not."""

import re

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelWarning
from tests.systems import PAIR

pytestmark = pytest.mark.usefixtures("interpreted")

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
