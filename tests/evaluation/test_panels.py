"""Panels: every record is simulated and filtered as it is alone."""

import numpy as np
import pandas as pd
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.numerics.philox import seed_of_record
from pymc_statespace_filters.system.panel_records import records_of
from tests.systems import FORCED, PAIR

LABELS = ["B", "B", "B", "A", "C", "C"]
STEPS = np.array([0, 2, 5, 3, 1, 4])
DATA = np.array([[0.1, 0.2], [np.nan, 0.3], [0.4, -0.2], [1.0, 0.1], [np.nan, np.nan], [0.5, -0.1]])
POINT = {"a": [0.7, 0.2, 0.5], "b": 0.3}
ROWS = {"B": slice(0, 3), "A": slice(3, 4), "C": slice(4, 6)}
CODES = dict(zip("BAC", records_of(LABELS).codes, strict=True))


def alone(label):
    return {"a": POINT["a"]["BAC".index(label)], "b": POINT["b"]}


def of_record(dataset, label, prefix=""):
    """The rows of one record, without the coordinates of the panel."""
    rows = dataset[f"{prefix}record"]
    return dataset.isel({rows.dims[0]: np.flatnonzero(rows == label)})


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(60), psf.EnKF(60)], ids=repr)
@pytest.mark.parametrize("at", ["observations", "steps"])
def test_a_run_of_a_panel_is_the_run_of_each_record(filter, at):
    run = psf.run_filter(PAIR, filter, POINT, DATA, steps=STEPS, panel=LABELS, seed=5, at=at, t0=1)
    for label, rows in ROWS.items():
        seed = int(seed_of_record(5, CODES[label]))
        single = psf.run_filter(
            PAIR, filter, alone(label), DATA[rows], steps=STEPS[rows], seed=seed, at=at, t0=1
        )
        states, terms = of_record(run, label), of_record(run, label, "obs_")
        for name in set(single.data_vars) - {"log_likelihood", "filter_state"}:
            np.testing.assert_array_equal(states[name], single[name], name)
        if "filter_state" in single:
            state = run["filter_state"].sel(filter_state_record=label)
            np.testing.assert_array_equal(state, single["filter_state"])
        np.testing.assert_array_equal(states["time"], single["time"])
        np.testing.assert_array_equal(states["step"] + 1, single["time"])
        np.testing.assert_array_equal(terms["log_likelihood"], single["log_likelihood"])
        np.testing.assert_array_equal(terms["obs_time"], single["obs_time"])


@pytest.mark.parametrize("noise", [True, False])
def test_a_simulated_panel_is_that_of_each_record(noise):
    options = {"noise": noise, "t0": 2.0}
    panel = psf.simulate(PAIR, POINT, steps=STEPS, panel=LABELS, random_seed=8, **options)
    assert panel["observations"].shape == (6, 2)
    base = np.random.default_rng(8).integers(np.iinfo(np.int64).max)
    for label, rows in ROWS.items():
        rng = np.random.default_rng(seed_of_record(base, CODES[label]))
        single = psf.simulate(PAIR, alone(label), steps=STEPS[rows], random_seed=rng, **options)
        states, seen = of_record(panel, label), of_record(panel, label, "obs_")
        np.testing.assert_array_equal(states["states"], single["states"])
        np.testing.assert_array_equal(states["time"], single["time"])
        np.testing.assert_array_equal(seen["observations"], single["observations"])
        np.testing.assert_array_equal(seen["obs_time"], single["obs_time"])


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(32)])
def test_threads_divide_records_and_change_nothing(filter):
    given = {"steps": STEPS, "panel": LABELS, "seed": 3}
    one = psf.log_likelihood(PAIR, filter, POINT, DATA, **given)
    for cores in (2, 3, 8):
        np.testing.assert_array_equal(
            psf.log_likelihood(PAIR, filter, POINT, DATA, cores=cores, **given), one
        )
    with pytest.raises(
        psf.errors.ModelError, match="cores must be an integer of at least 1, got 0"
    ):
        psf.log_likelihood(PAIR, filter, POINT, DATA, cores=0, **given)
    with pytest.raises(psf.errors.ModelError, match="cores must be 1 without a panel"):
        psf.log_likelihood(PAIR, filter, {"a": 0.5, "b": 0.3}, DATA[:1], steps=[0], cores=2)


def test_records_in_another_order_have_the_same_paths_and_runs():
    order = [3, 4, 5, 0, 1, 2]  # A, C, B
    permuted = {"a": [0.2, 0.5, 0.7], "b": 0.3}
    both = [
        psf.simulate(PAIR, params, steps=STEPS[rows], panel=np.array(LABELS)[rows], random_seed=1)
        for params, rows in ((POINT, range(6)), (permuted, order))
    ]
    for label in ROWS:
        first, second = (of_record(one, label)["states"] for one in both)
        np.testing.assert_array_equal(first, second)
    paths = [of_record(both[0], label)["states"].values[:2] for label in ROWS]
    assert len(np.unique(paths)) == 12  # no two records share their noise


def test_records_have_inputs_of_their_own():
    forces = {"x": np.array([0.5, -0.2, 1.0]), "y": np.array([2.0])}
    found = psf.simulate(
        FORCED, {"a": 0.5}, panel=["x", "x", "y"], steps=[0, 3, 1], inputs=forces, noise=False
    )
    path = [0.0, 0.5, 0.5 * 0.5 - 0.2, 0.5 * (0.5 * 0.5 - 0.2) + 1.0]
    np.testing.assert_allclose(found["states"].values.ravel(), [*path, 0.0, 2.0])


def test_wrong_numbers_of_records_are_named():
    with pytest.raises(psf.errors.ModelError, match=r"parameter 'a' .* for each of the 3 records"):
        psf.simulate(PAIR, {"a": [0.1, 0.2]}, panel=LABELS, steps=STEPS)
    with pytest.raises(psf.errors.ModelError, match="sort the rows by record"):
        psf.simulate(PAIR, {"a": 0.1}, panel=[1, 2, 1], steps=[0, 0, 1])


FRAME = pd.DataFrame(
    {
        "site": [7, 3, 7, 3, 7],
        "hours": [2.02, 1.0, 0.0, 2.0, 0.98],
        "u": [1.0, 2.0, 3.0, np.nan, 5.0],
        "v": [10, 20, 30, 40, 50],
    },
    index=list("pqrst"),
)
COLUMNS = {"record": "site", "time": "hours", "values": ["u", "v"], "dt": 0.5}


def test_a_table_is_sorted_by_record_and_time():
    found = psf.panel_from(FRAME, **COLUMNS)
    assert found.pop("t0") == 0.0
    expected = {
        "panel": [7, 7, 7, 3, 3],
        "steps": [0, 2, 4, 2, 4],
        "observed": [[3, 30], [5, 50], [1, 10], [2, 20], [np.nan, 40]],
    }
    assert list(found) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values)


def test_times_count_from_the_start():
    found = psf.panel_from(FRAME, **COLUMNS | {"t0": -1.0, "values": "v"})
    assert (found["steps"].tolist(), found["t0"]) == ([2, 4, 6, 4, 6], -1.0)
    assert found["observed"].shape == (5, 1)


def test_categories_texts_and_nullable_columns_are_labels_and_values():
    frame = FRAME.assign(
        site=pd.Categorical(list("baaab")), u=pd.array([1, None, 3, 4, 5], dtype="Int64")
    )
    found = psf.panel_from(frame, **COLUMNS | {"values": "u"})
    assert found["panel"].tolist() == list("bbaaa")
    np.testing.assert_array_equal(found["observed"].ravel(), [5, 1, 3, np.nan, 4])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"site": [7, 3, None, 3, 7]},
            "every row of frame must have a record, got none in row 'r'",
        ),
        (
            {"hours": [2.0, None, 0.0, 2.0, 1.0]},
            "record 3 of frame must have a time in every row, got none in row 'q'",
        ),
        (
            {"hours": [0.1, 1.0, 0.0, 2.0, 1.0]},
            r"record 7, rows \['r', 'p', 't'\] of frame: times must fall on different steps of "
            r"dt = 0.5, got 0 and 0.1",
        ),
        (
            {"hours": [2.0, -1.0, 0.0, 2.0, 1.0]},
            r"record 3, rows \['q', 's'\] of frame: steps must",
        ),
        ({"hours": list("abcde")}, "column 'hours' .* numbers or dates .*pd.to_datetime"),
        ({"u": list("abcde")}, "column 'u' of frame must hold numbers, got (str|object)"),
        ({"site": [0.5, 1.0, 0.5, 1.0, 1.0]}, "panel must hold integers or texts, got 0.5"),
    ],
)
def test_errors_of_a_table_name_record_and_row(change, message):
    with pytest.raises(psf.errors.ModelError, match=message):
        psf.panel_from(FRAME.assign(**change), **COLUMNS)


def test_unknown_columns_and_empty_tables_are_refused():
    with pytest.raises(
        psf.errors.ModelError, match=r"time must name columns of frame, .* \['hour'\]"
    ):
        psf.panel_from(FRAME, **COLUMNS | {"time": "hour"})
    with pytest.raises(psf.errors.ModelError, match="at least one row"):
        psf.panel_from(FRAME.iloc[:0], **COLUMNS)
    with pytest.raises(psf.errors.ModelError, match=r"pandas.DataFrame, got dict"):
        psf.panel_from({"site": [1]}, **COLUMNS)
