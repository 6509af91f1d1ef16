"""The live bar of whole chains: PyMC's, advanced by many iterations at once."""

import contextlib
import io
import sys

import pymc as pm
import pytest
from rich.console import Console

from pymc_statespace_filters.sampling.output.progress import watch

TUNE, DRAWS = 100, 900
STATS = {"accept_rate": 0.25, "stage": 2, "scaling": 0.5, "n_failed": 3}
FORMS = [True, "combined", "split", "combined+stats", "stats+combined", "split+stats"]


def tasks(bars):
    """What rich shows, one task a bar."""
    return bars._backend._progress.tasks


def quiet(bars):
    """Draw as in a terminal of 120 columns, but into a string."""
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=120)
    bars._backend._progress.live.console = console
    return screen


@pytest.mark.parametrize("progressbar", FORMS)
def test_final_counts_are_reached(progressbar):
    with watch(2, DRAWS, TUNE, progressbar) as bars:
        for done in (60, 130, 131, 1000):
            for chain in range(2):
                bars.update(chain, done, STATS)
        combined = "combined" in str(progressbar)
        n_bars, of_each = (1, 2) if combined else (2, 1)
        assert [task.completed for task in tasks(bars)] == [of_each * (TUNE + DRAWS)] * n_bars
        assert all(task.finished for task in tasks(bars))
        assert [task.fields["draw"] for task in tasks(bars)] == [of_each * DRAWS] * n_bars
        assert not any(task.fields["failing"] for task in tasks(bars))


def test_counts_on_the_way():
    """Each chain has its own; draws are counted anew after warm-up; time runs from the start."""
    with watch(3, DRAWS, TUNE, "split+stats") as bars:
        bars.begin(0)
        bars.begin(1)
        bars.update(0, 60, STATS)
        bars.update(1, 100, STATS | {"accept_rate": 0.001})
        bars.update(0, 250, STATS)
        bars.update(2, 0, STATS)
        first, second, third = tasks(bars)
        assert [task.completed for task in (first, second, third)] == [250, 100, 0]
        assert (first.fields["draw"], second.fields["draw"]) == (150, 100)
        assert (first.fields["failing"], second.fields["failing"]) == (False, True)
        shown = [first.fields[name] for name in ("accept_rate", "stage", "scaling", "failed")]
        assert shown == [0.25, 2, 0.5, 3]
        assert (first.started, second.started, third.started) == (True, True, False)
        assert not first.finished


def test_combined_counts_are_those_of_all_chains():
    with watch(2, DRAWS, TUNE, "combined") as bars:
        bars.update(0, 150, STATS)
        (task,) = tasks(bars)
        assert (task.completed, task.total, task.fields["draw"]) == (150, 2000, 150)
        bars.update(1, 100, STATS)
        assert (task.completed, task.fields["draw"]) == (250, 50)
        bars.update(0, 1000, STATS)
        assert not task.finished


def test_what_is_drawn(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "140")
    with watch(2, DRAWS, TUNE) as bars:
        for chain in range(2):
            bars.update(chain, 1000, STATS)
    drawn = capsys.readouterr().out
    for title in ("Draw", "Acceptance", "Stage", "Scale", "Failed", "Speed", "Elapsed"):
        assert title in drawn
    assert drawn.count("900") == 2


def test_the_speed_of_what_took_no_time():
    """PyMC's bar says 0 draws a second of a chain that ended within a quarter of a second."""
    with watch(2, DRAWS, TUNE, "split") as bars:
        bars.update(0, 1000, STATS, seconds=0.05)
        bars.update(1, 1000, STATS)
        assert [task.fields["sampling_speed"] for task in tasks(bars)] == [20_000, 0]


@pytest.mark.parametrize("progressbar", FORMS)
def test_an_interrupt_leaves_the_terminal_clean(progressbar):
    bars = watch(2, DRAWS, TUNE, progressbar)
    screen = quiet(bars)
    with contextlib.suppress(KeyboardInterrupt), bars:
        bars.update(0, 300, STATS)
        raise KeyboardInterrupt
    assert not bars._backend._progress.live.is_started
    hidden, shown = "\x1b[?25l", "\x1b[?25h"
    drawn = screen.getvalue()
    assert hidden in drawn
    assert drawn.rindex(shown) > drawn.rindex(hidden)  # the cursor


def test_nothing_is_drawn_or_imported_without_a_bar(capfd, monkeypatch):
    # What a bar in colours takes, and a look for notebooks.
    monkeypatch.setitem(sys.modules, "matplotlib.colors", None)
    monkeypatch.setitem(sys.modules, "marimo", None)
    with watch(1, DRAWS, TUNE, False) as bars:
        bars.begin(0)
        bars.update(0, 5, STATS)
        bars.update(0, 1000, STATS)
    assert capfd.readouterr() == ("", "")
    with pytest.raises(ImportError):
        watch(1, DRAWS, TUNE, True)


@pytest.mark.parametrize("progressbar", ["all", 1])
def test_anything_else_is_refused_as_by_pm_sample(progressbar):
    with pytest.raises(ValueError, match="Invalid value for `progressbar`") as ours:
        watch(1, DRAWS, TUNE, progressbar)
    with pm.Model():
        pm.Normal("x")
        with pytest.raises(ValueError, match="Invalid value for `progressbar`") as theirs:
            pm.sample(2, tune=2, chains=1, step=pm.Metropolis(), progressbar=progressbar)
    assert str(ours.value) == str(theirs.value)
