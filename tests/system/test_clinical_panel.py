"""Tables of pharmacometrics: what each row becomes, and which rows are refused."""

import numpy as np
import pandas as pd
import pytest

from pymc_statespace_filters.errors import ModelError, ModelWarning
from pymc_statespace_filters.pharmacometrics import read_events

NAN = np.nan


def table(*rows, columns="TIME AMT DV", **constant):
    """A table of one person, or with a column ID of several."""
    names = columns.split()
    frame = pd.DataFrame(rows, columns=names).assign(**constant)
    return frame if "ID" in columns.upper().split() else frame.assign(ID=1)


def read(*rows, columns="TIME AMT DV", observables=("conc",), **settings):
    return read_events(table(*rows, columns=columns), observables=list(observables), **settings)


def events(*rows, columns="TIME AMT DV", **settings):
    """The events of one person as tuples (time, before, amounts)."""
    found = read(*rows, columns=columns, **settings)["events"][1]
    return [tuple(row) for row in found.to_numpy().tolist()]


def inputs(*rows, columns, **settings):
    found = read(*rows, columns=columns, **settings)
    return found["input_times"][1].tolist(), found["inputs"][1]


def test_rows_of_several_persons_are_a_panel():
    rows = [("A", 0, 100, NAN), ("A", 1, 0, 5.0), ("A", 2, 0, 4.0), ("B", 0, 50, 0), ("B", 3, 0, 2)]
    found = read_events(table(*rows, columns="id time Amt dv"), observables=["conc"])
    assert found["panel"].tolist() == ["A", "A", "B"]
    assert found["times"].tolist() == [1, 2, 3]
    assert found["observed"].tolist() == [[5.0], [4.0], [2.0]]
    assert found["t0"] == 0.0
    assert found["events"]["B"]["dose"].tolist() == [50]
    assert sorted(found) == ["events", "observed", "panel", "t0", "times"]
    assert found.covariates.index.tolist() == ["A", "B"]


def test_labels_are_integers_as_a_panel_has_them():
    found = read_events(
        table((3.0, 0, 1, NAN), (3.0, 1, 0, 1), columns="ID TIME AMT DV"), observables=["c"]
    )
    assert list(found["events"]) == [3]
    assert found["panel"].tolist() == [3]


def test_the_order_of_rows_counts_at_one_time():
    first = events((0, 0, 1), (5, 9, NAN), (5, 0, 2))
    last = events((0, 0, 1), (5, 0, 2), (5, 9, NAN))
    both = events((0, 4, NAN), (0, 0, 1), (0, 6, NAN))
    assert first == [(5, 1, 9)]
    assert last == [(5, 0, 9)]
    assert both == [(0, 1, 4), (0, 0, 6)]


def test_doses_at_one_time_add_up_by_compartment():
    rows = [(0, 5, 1, NAN), (0, 7, 2, NAN), (0, 2, 1, NAN), (0, 0, 2, 1.0), (4, 1, 2, NAN)]
    found = read(*rows, columns="TIME AMT CMT DV", compartments=["gut", "central"])["events"][1]
    assert found.to_dict("list") == {
        "time": [0, 4],
        "before": [1, 0],
        "dose_central": [7, 1],
        "dose_gut": [7, 0],
    }


@pytest.mark.parametrize(
    ("cmt", "compartments", "name"),
    [
        (2, ["gut", "central"], "dose_central"),
        (2.0, {"central": 2}, "dose_central"),
        ("central", ["gut", "central"], "dose_central"),
        ("A1", {"gut": "A1"}, "dose_gut"),
        (2, None, "dose_2"),
        ("depot", None, "dose_depot"),
    ],
)
def test_a_compartment_has_a_number_or_a_name(cmt, compartments, name):
    rows = [(0, 5, cmt, NAN), (1, 0, cmt, 1.0)]
    found = read(*rows, columns="TIME AMT CMT DV", compartments=compartments)["events"][1]
    assert list(found) == ["time", "before", name]
    alone = read((0, 5, NAN), (1, 0, 1.0), compartments=["central"])["events"][1]
    assert list(alone) == ["time", "before", "dose_central"]


def test_additional_doses_follow_and_act_after_an_observation():
    found = events((0, 5, 2, 0.1, NAN), (0.2, 0, 0, 0, 1.0), columns="TIME AMT ADDL II DV")
    assert found == [(0, 0, 5), (0.1, 0, 5), (0.2, 0, 5)]
    # The time of the row, of which 3 * 0.1 is off by rounding.
    found = events((0, 5, 3, 0.1, NAN), (0.3, 0, 0, 0, 1.0), columns="TIME AMT ADDL II DV")
    assert found[-1] == (0.3, 0, 5)


def test_a_row_and_an_additional_dose_at_one_time_are_both_given():
    rows = [(0, 5, 1, 8, NAN), (8, 3, 0, 0, NAN), (8, 0, 0, 0, 1.0)]
    found = events(*rows, columns="TIME AMT ADDL II DV")
    assert found == [(0, 0, 5), (8, 1, 3), (8, 0, 5)]


def test_additional_doses_that_meet_but_for_rounding_are_one_event():
    rows = [(0, 10, 8, 0.1, NAN), (0.1, 100, 7, 0.1, NAN), (0.95, 0, 0, 0, 1.0)]
    found = events(*rows, columns="TIME AMT ADDL II DV")
    assert 0.1 + 5 * 0.1 != 6 * 0.1
    assert [amount for _, _, amount in found] == [10] + [110] * 8


def test_a_steady_state_is_some_earlier_doses():
    rows = [(0, 5, 1, 8, 2, NAN), (0, 0, 0, 0, 0, 1.0)]
    columns = "TIME AMT SS II ADDL DV"
    found = read(*rows, columns=columns, ss_doses=2)
    assert found["t0"] == -16
    at = found["events"][1]
    assert at["time"].tolist() == [-16, -8, 0, 8, 16]
    assert at["before"].tolist() == [0, 0, 1, 0, 0]
    assert events(*rows, columns=columns, ss_doses=1)[0] == (-8, 0, 5)


def test_infusions_are_inputs_that_add_up():
    rows = [(0, 10, 5, NAN), (1, 6, 2, NAN), (1, 0, 0, 1.0), (9, 0, 0, 1.0)]
    times, found = inputs(*rows, columns="TIME AMT RATE DV", compartments=["central"])
    assert times == [0, 1, 2, 4]
    assert found.to_dict("list") == {"infusion_central": [5, 7, 2, 0]}
    assert "events" not in read(*rows, columns="TIME AMT RATE DV")


def test_infusions_repeat_and_stand_beside_boluses():
    rows = [(0, 10, 5, 1, 2, 1, NAN), (0, 3, 0, 0, 0, 2, NAN), (5, 0, 0, 0, 0, 1, 1.0)]
    columns = "TIME AMT RATE ADDL II CMT DV"
    times, found = inputs(*rows, columns=columns)
    assert times == [0, 2, 4]
    assert found.to_dict("list") == {"infusion_1": [5, 5, 0]}
    assert events(*rows, columns=columns) == [(0, 0, 3)]


def test_a_person_without_an_infusion_has_the_same_inputs():
    rows = [(1, 0, 10, 5, NAN), (1, 9, 0, 0, 1.0), (2, 0, 7, 0, NAN), (2, 9, 0, 0, 1.0)]
    found = read(*rows, columns="ID TIME AMT RATE DV")
    assert found["inputs"][2]["infusion"].tolist() == [0]
    assert found["input_times"][2].tolist() == [0]
    assert len(found["events"][1]) == 0
    assert list(found["events"][1]) == ["time", "before", "dose"]


def test_covariates_that_change_hold_from_their_row_on():
    rows = [(1, 5, 0, 60), (2, 0, 3, 61), (4, 0, 2, 62)]
    times, found = inputs(*rows, columns="TIME AMT DV WT", changing=["WT"], t0=0)
    assert times == [0, 1, 2, 4]
    assert found.to_dict("list") == {"WT": [60, 60, 61, 62]}


def test_constant_covariates_are_beside_the_arguments():
    rows = [(1, 0, 1, 60, 0), (2, 0, 3, 81, 1), (2, 4, 2, 81, 1)]
    frame = table(*rows, columns="ID TIME DV WT SEX")
    found = read_events(frame, observables=["c"], covariates=["SEX", "WT"])
    assert found.covariates.to_dict("list") == {"SEX": [0, 1], "WT": [60, 81]}
    assert found.covariates.index.tolist() == [1, 2]
    assert "inputs" not in found


def test_censored_values_have_the_other_sign_here():
    rows = [(0, 1.0, 0), (1, 0.5, 1), (2, 9.0, -1), (3, 2.0, NAN)]
    found = read(*rows, columns="TIME DV CENS")
    assert found["censored"].ravel().tolist() == [0, -1, 1, 0]
    assert found["observed"].ravel().tolist() == [1.0, 0.5, 9.0, 2.0]
    assert "censored" not in read((0, 1.0, 0), columns="TIME DV CENS")


def test_rows_without_a_value_are_missing_data():
    rows = [(0, 0, 7.0, 0), (1, 2, 7.0, 1), (2, 0, 7.0, 1), (3, 2, NAN, 1), (3, 0, 8.0, 0)]
    found = read(*rows, columns="TIME EVID DV MDV")
    assert found["times"].tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(found["observed"].ravel(), [7.0, NAN, NAN, 8.0])
    found = read((0, 1.0), (1, NAN), columns="TIME DV")
    np.testing.assert_array_equal(found["observed"].ravel(), [1.0, NAN])


@pytest.mark.parametrize(
    ("column", "values", "observables"),
    [
        ("DVID", (1, 2), {"conc": 1, "effect": 2}),
        ("CMT", (2.0, 3.0), {"conc": 2, "effect": 3}),
        ("DVID", ("cp", "pca"), {"conc": "cp", "effect": "pca"}),
        ("dvid", ("conc", "effect"), ["conc", "effect"]),
    ],
)
def test_several_observables_share_the_rows_of_a_time(column, values, observables):
    conc, effect = values
    rows = [(0, 5, NAN, effect), (0, 0, 1.0, conc), (0, 0, 9.0, effect), (2, 0, 8.0, effect)]
    frame = table(*rows, columns=f"TIME AMT DV {column}").assign(CENS=[0, 0, 1, 0])
    found = read_events(frame, observables=observables)
    assert found["times"].tolist() == [0, 2]
    assert list(found["observed"]) == ["conc", "effect"]
    np.testing.assert_array_equal(found["observed"], [[1.0, 9.0], [NAN, 8.0]])
    np.testing.assert_array_equal(found["censored"], [[0, -1], [0, 0]])


def test_one_observable_may_be_named_by_its_number():
    found = read((0, 2, 1.0), (1, 2, 2.0), columns="TIME DVID DV")
    assert found["observed"].ravel().tolist() == [1.0, 2.0]


def test_t0_is_where_all_begin_or_given():
    rows = [(1, 10, 1.0), (2, 12, 1.0)]
    assert read(rows[0], columns="ID TIME DV")["t0"] == 10
    assert read(*rows, columns="ID TIME DV", t0=5)["t0"] == 5


def test_columns_that_nothing_reads_are_named():
    frame = table((0, 1.0), columns="TIME DV").assign(WT=70, AGE=30, SEX=1)
    with pytest.warns(ModelWarning, match=r"not used: \['AGE', 'SEX'\]; list them in covariates="):
        read_events(frame, observables=["c"], covariates=["WT"])


REFUSED = {
    "EVID 3": ("TIME EVID DV", (5, 3, NAN), r"EVID 3 sets the state back.*an ID of its own"),
    "EVID 4": ("TIME EVID AMT DV", (5, 4, 9, NAN), "EVID 4 sets the state back"),
    "EVID 101": ("TIME EVID DV", (5, 101, 1), r"EVID must be 0 \(observation\).*got 101"),
    "no EVID": ("TIME EVID DV", (5, NAN, 1), "EVID must be 0 .*got nan"),
    "modelled rate": ("TIME AMT RATE DV", (5, 9, -1, NAN), "RATE -1 is a rate or a duration"),
    "modelled duration": ("TIME AMT RATE DV", (5, 9, -2, NAN), "RATE -2 is a rate or a duration"),
    "negative rate": ("TIME AMT RATE DV", (5, 9, -3, NAN), "RATE must be amount per time.*got -3"),
    "SS 2": ("TIME AMT SS II DV", (5, 9, 2, 8, NAN), "SS 2, on top of the present state"),
    "SS 3": ("TIME AMT SS II DV", (5, 9, 3, 8, NAN), "SS must be 0 or 1, got 3"),
    "SS of an infusion": (
        "TIME AMT SS II RATE DV", (5, 9, 1, 8, 2, NAN), "SS 1 of an infusion, RATE 2, is",
    ),
    "SS behind rows": ("TIME AMT SS II DV", (5, 9, 1, 8, NAN), "SS 1 must be in the first row"),
    "SS without II": ("TIME AMT SS DV", (5, 9, 1, NAN), "SS 1 needs II.*got 0"),
    "ADDL without II": ("TIME AMT ADDL DV", (5, 9, 2, NAN), "ADDL 2 .*needs II.*got 0"),
    "negative II": ("TIME AMT ADDL II DV", (5, 9, 2, -8, NAN), "II must be the time.*got -8"),
    "negative ADDL": ("TIME AMT ADDL II DV", (5, 9, -2, 8, NAN), "ADDL must be a number.*got -2"),
    "half a dose": ("TIME AMT ADDL II DV", (5, 9, 1.5, 8, NAN), "ADDL must be.*got 1.5"),
    "no amount": ("TIME EVID DV", (5, 1, NAN), "AMT must be positive where EVID is 1, got 0"),
    "negative amount": ("TIME AMT DV", (5, -9, NAN), "AMT must not be negative, got -9"),
    "amount of an observation": (
        "TIME EVID AMT DV", (5, 0, 9, 1), "AMT 9 belongs to a dose, and EVID is 0",
    ),
    "rate of an observation": (
        "TIME EVID RATE DV", (5, 0, 9, 1), "RATE 9 belongs to a dose, and EVID is 0",
    ),
    "compartment off": ("TIME EVID CMT DV", (5, 2, -1, NAN), "CMT -1 switches a compartment off"),
    "no compartment": ("TIME AMT CMT DV", (5, 9, NAN, NAN), "CMT None is not among"),
    "no DV": ("TIME MDV DV", (5, 0, NAN), "MDV 0 says that DV is an observation, got nan"),
    "MDV of a dose": ("TIME AMT MDV DV", (5, 9, 0, NAN), "MDV 0 says.*with EVID 1"),
    "MDV 2": ("TIME MDV DV", (5, 2, 1), "MDV must be 0 or 1, got 2"),
    "CENS without DV": ("TIME CENS DV", (5, 1, NAN), "CENS 1 needs a limit in DV, got nan"),
    "CENS of a dose": ("TIME AMT CENS DV", (5, 9, 1, 3), "CENS 1 needs .* EVID 1"),
    "CENS 2": ("TIME CENS DV", (5, 2, 1), "CENS must be 0, 1 .*got 2"),
    "LIMIT": ("TIME CENS LIMIT DV", (5, 1, 0, 1), "LIMIT 0, the other end of an interval"),
    "time of the past": ("TIME DV", (-1, 1), "TIME -1 is before that of the row above: sort"),
    "no time": ("TIME DV", (NAN, 1), "TIME must be a number, got nan"),
    "text": ("TIME DV", ("08:30", 1), "'TIME' must hold numbers, got the text '08:30'"),
    "a dot": ("TIME DV", (5, "."), r"'DV' must hold numbers, got the text '.'.*na_values='.'"),
    "infinity": ("TIME DV", (5, np.inf), "'DV' must hold finite numbers, got inf"),
    "no person": ("ID TIME DV", (None, 5, 1), "ID must be a label, got None"),
    "replicate": ("TIME DV", (0, 2), "already a value of this observable at TIME 0: give replic"),
    "covariate": ("TIME WT DV", (5, NAN, 1), "the covariate WT must have a value in every row"),
    "covariate at one time": ("TIME WT DV", (0, 2, NAN), "WT differs from that of the row above"),
    "covariate that changes": ("TIME WT DV", (5, 2, 1), "WT differs from that .* changing="),
    "another observable": ("TIME DVID DV", (5, 2, 1), r"DVID is 2 here and another.*\{'conc': 2"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_a_row_that_makes_no_sense_is_refused_by_its_label(case):
    columns, row, message = REFUSED[case]
    good = dict.fromkeys(columns.split(), 0) | {"WT": 1, "DVID": 1, "ID": 1, "CMT": 1, "DV": 1.0}
    names = columns.split()
    rows = [[{"LIMIT": NAN}.get(name, good[name]) for name in names], list(row)]
    frame = table(*rows, columns=columns)
    frame.index = ["first", "second"]
    with pytest.raises(ModelError, match=rf"^row 'second' of frame: .*{message}"):
        read_events(frame, observables=["conc"], covariates=[n for n in names if n == "WT"])


@pytest.mark.parametrize(
    ("rows", "settings", "message"),
    [
        ([(0, 1, NAN), (0, 0, 2)], {"t0": 1}, "t0 must not be .*got 1, and ID 1 begins at 0"),
        ([(0, 1, NAN)], {}, "ID 1 of frame has doses and no observation"),
        ([(0, 0, 1)], {"observables": {}}, "observables must be a list of names or a mapping"),
        ([(0, 0, 1)], {"observables": ["a", "b"]}, "must have the column CMT, to tell .*'a', 'b'"),
        ([(0, 0, 1)], {"compartments": ["a", "b"]}, "must have the column CMT"),
        ([(0, 0, 1)], {"compartments": ["a", "a"]}, r"compartments .*different, got \['a', 'a'"),
        ([(0, 0, 1)], {"covariates": "WT"}, r"covariates must list columns .*got 'WT'"),
        ([(0, 0, 1)], {"changing": ["WT"]}, r"changing must list columns .*got \['WT'\]"),
        ([(0, 0, 1), (0, 5, NAN), (0, 0, NAN)], {}, "dose stands between two observations"),
    ],
)  # fmt: skip
def test_a_wrong_argument_is_refused(rows, settings, message):
    observables = settings.pop("observables", ["c"])
    with pytest.raises(ModelError, match=message):
        read_events(table(*rows), observables=observables, **settings)


@pytest.mark.parametrize(
    ("columns", "rows", "settings", "message"),
    [
        ("TIME AMT CMT DV", [(0, 5, 3, NAN), (1, 0, 1, 1)], {"compartments": ["gut"]},
         r"row 0 of frame: CMT 3 is not among the names and values \{'gut': 1\}"),
        ("TIME DVID DV", [(0, 1, 5), (1, 3, 1)], {"observables": {"a": 1, "b": 2}},
         "row 1 of frame: DVID 3 is not among"),
        ("TIME AMT SS II DV", [(0, 5, 1, 8, NAN), (1, 0, 0, 0, 1)], {},
         r"row 0 of frame: SS 1 needs ss_doses=n.*exp\(-k n II\).*II = 8"),
        ("TIME AMT SS II DV", [(0, 5, 1, 8, NAN), (1, 0, 0, 0, 1)], {"ss_doses": 0},
         "ss_doses must be an integer of at least 1"),
        ("ID TIME DV", [(1, 0, 1), (2, 0, 1), (1, 5, 1)], {}, "row 2 of frame: ID 1 comes again"),
        ("ID TIME DV", [(1, 0, 1), (2, 3, 1)], {}, "ID 1 at 0, ID 2 at 3: give t0=0"),
        ("ID TIME DV", [], {}, "DataFrame with rows"),
        ("ID TIME", [(1, 0)], {}, "columns ID, TIME and DV, got none named DV"),
        ("ID TIME time DV", [(1, 0, 0, 1)], {}, "one column TIME, got 'time' too"),
    ],
)  # fmt: skip
def test_a_wrong_table_is_refused(columns, rows, settings, message):
    with pytest.raises(ModelError, match=message):
        read_events(table(*rows, columns=columns), **{"observables": ["c"]} | settings)


def test_dates_are_to_be_counted():
    frame = table((pd.Timestamp("2020-01-01"), 1.0), columns="TIME DV")
    with pytest.raises(ModelError, match=r"'TIME' of frame must hold numbers.*Timedelta\('1h'\)"):
        read_events(frame, observables=["c"])
    hours = (frame["TIME"] - frame["TIME"][0]) / pd.Timedelta("1h")
    assert read_events(frame.assign(TIME=hours), observables=["c"])["times"].tolist() == [0]
