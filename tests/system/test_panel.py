"""The rows of a panel: its records, steps, inputs and parameters, and what is refused."""

import numpy as np
import pandas as pd
import pytest

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.panel_records import FIRST_INPUT, RECORD, STEP, records_of
from pymc_statespace_filters.system.parameters import panel_parameters
from pymc_statespace_filters.system.record import read_record
from tests.systems import FORCE, FORCED, PAIR, forced

LABELS = ["b", "b", "a", "c", "c"]
STEPS = np.array([0, 3, 1, 0, 2])
DATA = np.arange(5.0)


def panel_of(labels=LABELS, observed=DATA, steps=STEPS, inputs=FORCE, system=FORCED, **options):
    options = {"times": None, "t0": 0.0} | options
    return read_record(system, GivenRecord(observed, labels, steps, inputs=inputs, **options))


def test_records_are_in_the_order_of_their_rows():
    records = records_of(LABELS)
    assert records.labels == ["b", "a", "c"]
    assert records.starts.tolist() == [0, 2, 3, 5]
    assert records.of_rows().tolist() == [0, 0, 1, 2, 2]


@pytest.mark.parametrize(
    "labels",
    [np.array([7, 7, -3]), pd.Series([7, 7, -3], index=[4, 5, 9]), [7.0, 7.0, -3.0]],
)
def test_integer_labels_are_their_own_codes(labels):
    records = records_of(labels)
    assert records.labels == [7, -3]
    assert records.codes.tolist() == [7, -3]


def test_the_code_of_a_text_does_not_depend_on_other_labels():
    (alone,), codes = records_of(["a"]).codes, records_of(LABELS).codes
    assert codes[1] == alone
    assert len(set(codes.tolist())) == 3
    assert records_of(pd.Categorical(["a"])).codes[0] == alone


def test_rows_hold_code_step_and_first_row_of_inputs():
    table = panel_of(inputs={"a": FORCE[:1], "b": FORCE[:3], "c": FORCE[:5]})
    np.testing.assert_array_equal(table.steps[:, RECORD], table.records.codes[[0, 0, 1, 2, 2]])
    np.testing.assert_array_equal(table.steps[:, STEP], STEPS)
    np.testing.assert_array_equal(table.steps[:, FIRST_INPUT], [0, 0, 3, 4, 4])
    np.testing.assert_array_equal(table.inputs[:, 0], [*FORCE[:3], *FORCE[:1], *FORCE[:5]])


def test_shared_inputs_are_not_copied_to_every_record():
    table = panel_of()
    assert table.inputs.shape == (6, 1)
    assert (table.steps[:, FIRST_INPUT] == 0).all()


def test_times_are_those_of_each_record():
    table = panel_of(steps=None, times=STEPS + 2.0, t0=2.0)
    np.testing.assert_array_equal(table.steps[:, STEP], STEPS)


def test_accumulators_are_reset_at_the_observations_of_their_own_record():
    def step(x, q, u):
        return [x[0] + q[0], x[1] + x[0]]

    system = forced(
        transition=step,
        initial_mean=[0.0, 0.0],
        initial_cov=np.eye(2),
        accumulators=["total"],
        states=["level", "total"],
    )
    table = panel_of(system=system)
    resets = [table.inputs[first:, -1] for first in table.steps[[0, 2, 3], FIRST_INPUT]]
    for column, steps in zip(resets, ([0, 3], [1], [0, 2]), strict=True):
        assert np.flatnonzero(column[:6]).tolist() == steps


def test_parameters_are_shared_or_of_each_record():
    records = records_of(LABELS)
    theta = panel_parameters(PAIR, {"a": [1.0, 2.0, 3.0], "b": 0.5}, records)
    np.testing.assert_array_equal(theta, [[1.0, 0.5], [2.0, 0.5], [3.0, 0.5]])
    np.testing.assert_array_equal(panel_parameters(PAIR, {"a": 1.0}, records)[:, 1], 0.2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"labels": ["b", "b", "a", "b", "b"]}, r"together, got record 'b' in row 0 and.* row 3"),
        ({"labels": ["b", "b", None, "c", "c"]}, "got None in row 2"),
        ({"labels": [1.0, 1.0, np.nan, 2.0, 2.0]}, "got nan in row 2"),
        ({"labels": [1.5, 1.5, 2.0, 3.0, 3.0]}, "integers or texts, got 1.5 in row 0"),
        ({"labels": pd.Series([1, 1, None, 2, 2], dtype=object)}, "got None in row 2"),
        ({"labels": ["b", "b", "", "c", "c"]}, "got '' in row 2"),
        ({"labels": "bbacc"}, "panel must be a vector"),
        ({"labels": LABELS[:4]}, r"steps must have shape \(4,\)"),
        ({"steps": [0, 3, 1, 2, 2]}, r"record 'c', whose first row is 3: steps must increase"),
        ({"steps": [0, 3, -1, 0, 2]}, r"record 'a', whose first row is 2: steps must not be neg"),
        ({"steps": None}, "observed brings no dates: give steps or times"),
        ({"steps": None, "times": [0, 3, 1.5, 0, 2]}, r"record 'a', whose first row is 2: times"),
        ({"observed": DATA[:4]}, r"observed must have shape \(5, 1\)"),
        ({"inputs": FORCE[:2]}, "record 'b', whose first row is 0: inputs must have at least 3"),
        ({"inputs": None}, "inputs must have a row per step"),
        ({"inputs": {"a": FORCE, "b": FORCE}}, "an array for each record, got none for .*'c'"),
        ({"inputs": [FORCE, FORCE]}, "for each of the 3 records, or one for all, got 2"),
        ({"inputs": [FORCE, FORCE, FORCE[:1]]}, "record 'c', whose first row is 3: inputs must"),
        ({"t0": np.inf}, "t0"),
    ],
)
def test_a_wrong_panel_is_refused_by_record_and_row(changes, message):
    with pytest.raises(ModelError, match=message):
        panel_of(**changes)


@pytest.mark.parametrize("wrong", [[1.0, 2.0], np.ones((3, 1)), np.ones((3, 3))])
def test_a_parameter_of_another_number_of_records_is_refused(wrong):
    with pytest.raises(ModelError, match=r"'a' must have shape \(\).* or \(3,\)"):
        panel_parameters(PAIR, {"a": wrong}, records_of(LABELS))
