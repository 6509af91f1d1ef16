"""The live bar of whole chains: PyMC's, advanced by many iterations at once."""

import contextlib
import io
import sys
from threading import current_thread, main_thread
from types import SimpleNamespace

import pymc as pm
import pytest
from pymc.progress_bar import MCMCProgressBarManager
from rich.console import Console
from rich.progress import Progress

import pymc_statespace_filters as psf
from pymc_statespace_filters import progress
from pymc_statespace_filters.sampling.nuts import chains
from pymc_statespace_filters.sampling.output.chain_bars import ChainProgress
from pymc_statespace_filters.sampling.run.chain import Chain
from pymc_statespace_filters.sampling.step import DRAM

TUNE, DRAWS = 100, 900
STATS = {"accept_rate": 0.25, "n_failed": 3}
FORMS = [True, "combined", "split", "combined+stats", "stats+combined", "split+stats"]


def tasks(bars):
    """What rich shows, one task a bar."""
    return bars._backend._progress.tasks


def quiet(bars, **terminal):
    """Draw into a string."""
    screen = io.StringIO()
    console = Console(file=screen, **terminal)
    bars._backend._progress.live.console = console
    return screen


@pytest.mark.parametrize("progressbar", FORMS)
def test_final_counts_are_reached(progressbar):
    with ChainProgress(2, DRAWS, TUNE, progressbar) as bars:
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
    with ChainProgress(3, DRAWS, TUNE, "split+stats") as bars:
        bars.update(0, 60, STATS)
        bars.update(1, 100, STATS | {"accept_rate": 0.001})
        bars.update(0, 250, STATS)
        bars.update(2, 0, STATS)
        first, second, third = tasks(bars)
        assert [task.completed for task in (first, second, third)] == [250, 100, 0]
        assert (first.fields["draw"], second.fields["draw"]) == (150, 100)
        assert (first.fields["failing"], second.fields["failing"]) == (False, True)
        assert (first.fields["accept_rate"], first.fields["failed"]) == (0.25, 3)
        assert (first.started, second.started, third.started) == (True, True, False)
        assert not first.finished


def test_combined_counts_are_those_of_all_chains():
    with ChainProgress(2, DRAWS, TUNE, "combined") as bars:
        bars.update(0, 150, STATS)
        (task,) = tasks(bars)
        assert (task.completed, task.total, task.fields["draw"]) == (150, 2000, 150)
        bars.update(1, 100, STATS)
        assert (task.completed, task.fields["draw"]) == (250, 50)
        bars.update(0, 1000, STATS)
        assert not task.finished


@pytest.mark.parametrize("progressbar", FORMS)
def test_all_is_legible_in_80_columns(progressbar, monkeypatch):
    bars = ChainProgress(2, 90_000, 10_000, progressbar)
    screen = quiet(bars, width=80)
    with bars:
        for chain in range(2):
            bars.update(chain, 1, STATS)
        for task in tasks(bars):  # for more than an hour
            task.start_time -= 5000.0
        bars.update(0, 100_000, STATS, seconds=5000.0)
        bars.update(1, 99_999, STATS | {"n_failed": 12_345})
    drawn = screen.getvalue()
    titles = ["Progress", "Draw", "Speed", "Elapsed", "Remaining"]
    if progressbar in (True, "combined+stats", "stats+combined", "split+stats"):
        titles[2:2] = ["Accept", "Fails"]
        assert "12345" in drawn
        assert "0.25" in drawn
    assert drawn.split()[: len(titles)] == titles
    assert "\u2026" not in drawn
    assert all(len(line) <= 80 for line in drawn.splitlines())
    assert drawn.count("1:23:20") == len(tasks(bars))
    assert "draws/s" in drawn


def test_a_sampler_without_a_rate_shows_none():
    """As NUTS, which says how many draws have diverged."""
    bars = ChainProgress(2, DRAWS, TUNE, has_rate=False)
    screen = quiet(bars, width=80)
    with bars:
        bars.update(0, TUNE + DRAWS, {"n_failed": 17})
    drawn = screen.getvalue()
    assert drawn.split()[:3] == ["Progress", "Draw", "Fails"]
    assert "17" in drawn


def test_values_are_legible_in_80_columns_in_the_bar_of_pm_sample():
    with pm.Model():
        pm.Normal("x")
        step = DRAM()
    bars = MCMCProgressBarManager(step, 1, DRAWS, TUNE)
    screen = quiet(bars, width=80)
    with bars:
        for draw in range(TUNE + DRAWS):
            bars.update(0, False, draw, draw < TUNE, [STATS])
    drawn = screen.getvalue()
    assert "Accept" in drawn
    assert "0.25" in drawn
    assert drawn.count("0:00:0") == 2
    assert drawn.splitlines()[-2].count("\u2026") == 0


@pytest.fixture
def updates(monkeypatch):
    """What chains are shown to have made, in order."""
    update, found = ChainProgress.update, []

    def noted(bars, chain, done, *others):
        found.append((chain, done, bars._totals[chain]))
        update(bars, chain, done, *others)

    monkeypatch.setattr(ChainProgress, "update", noted)
    return found


def model():
    with pm.Model() as model:
        pm.Normal("mu")
    return model


@pytest.mark.usefixtures("interpreted")
def test_bars_of_chains_begin_with_the_first_iteration_and_end_with_the_last(updates, capfd):
    """Not while machine code is compiled; of a draw in four iterations, at the last one."""
    psf.sample_dram(10, tune=8, thin=4, chains=2, cores=1, model=model(), initvals={})
    assert min(done for _, done, _ in updates) > 0
    assert {total for *_, total in updates} == {48}
    assert {chain: done for chain, done, _ in updates} == {0: 48, 1: 48}


@pytest.mark.usefixtures("interpreted")
def test_bars_of_nuts_end_with_the_last_iteration(updates, monkeypatch, capfd):
    """nutpie may have said for the last time that 94 % are done."""
    late = [SimpleNamespace(finished_draws=17, divergences=0, total_num_steps=9)] * 2
    monkeypatch.setattr(chains._Watch, "__call__", lambda watch, _: setattr(watch, "chains", late))
    settings = {"sampler": "nuts", "until_ess": None, "initvals": {"mu": 0.5}}
    psf.sample(10, tune=8, chains=2, model=model(), **settings)
    assert {chain: done for chain, done, _ in updates} == {0: 18, 1: 18}


def test_a_chain_finds_its_iterations_compiled(monkeypatch):
    """Its clock and its bar count no compilation."""
    iterate, made = Chain._iterate, []

    def noted(chain, *arguments):
        made.append((current_thread() is main_thread(), arguments[-1]))
        return iterate(chain, *arguments)

    monkeypatch.setattr(Chain, "_iterate", noted)
    psf.sample_dram(10, tune=8, chains=2, until_ess=None, model=model(), random_seed=1)
    assert made[0] == (True, 0)
    assert {in_main for in_main, _ in made[1:]} == {False}


def test_a_row_that_was_an_estimate_is_whole_at_the_end(monkeypatch):
    work, shown = SimpleNamespace(on_progress=None), []
    monkeypatch.setattr(
        "pymc.progress_bar.create_simple_progress", lambda: shown.append(screen()) or shown[-1]
    )
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    with progress.row_progress(work, enabled=True) as begin:
        begin("a part", 100)
        work.on_progress(94)
    assert [bar.tasks[0].percentage for bar in shown] == [100.0]


def test_work_after_the_last_task_has_no_bar(monkeypatch):
    counts = []
    work = SimpleNamespace(on_progress=counts.append)
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    monkeypatch.setattr(progress._RowProgress, "_show", lambda bar: pytest.fail(bar._task))
    with progress.row_progress(work, enabled=True):
        pass
    work.on_progress(5)
    assert counts == [5]


def screen():
    return Progress(console=Console(file=io.StringIO()))


@pytest.mark.parametrize("progressbar", FORMS)
def test_the_worst_of_all_models_is_in_the_last_line(progressbar):
    bars = ChainProgress(4, DRAWS, TUNE, progressbar)
    screen = quiet(bars, width=80)
    with bars:
        bars.update(0, 500, STATS)
        bars.show_convergence(0, 1.5, 90.0)
        bars.show_convergence(1, 1.234, 56.7)
        bars.show_convergence(0, 1.01, 100.0)
    line = "  largest R-hat 1.23, smallest effective sample size 57"
    assert (screen.getvalue().splitlines()[-1] == line) == bars.shows_convergence
    assert bars.shows_convergence == (progressbar not in ("combined", "split"))


@pytest.mark.parametrize("progressbar", FORMS)
def test_chains_that_go_on(progressbar):
    with ChainProgress(2, DRAWS, TUNE, progressbar) as bars:
        for total in (1000, 1450):
            for chain in range(2):
                bars.extend(chain, total)
                bars.update(chain, 3000, STATS)  # a checkpoint may have more
        assert all(task.finished for task in tasks(bars))
        of_each = 2 if "combined" in str(progressbar) else 1
        assert {(task.completed, task.total) for task in tasks(bars)} == {
            (of_each * 1450, of_each * 1450)
        }
        bars.extend(0, 2000)
        assert not tasks(bars)[0].finished


def test_the_speed_of_what_took_no_time():
    """PyMC's bar says 0 draws a second of a chain that ended within a quarter of a second."""
    with ChainProgress(2, DRAWS, TUNE, "split") as bars:
        bars.update(0, 1000, STATS, seconds=0.05)
        bars.update(1, 1000, STATS)
        assert [task.fields["sampling_speed"] for task in tasks(bars)] == [20_000, 0]


@pytest.mark.parametrize("progressbar", FORMS)
def test_an_interrupt_leaves_the_terminal_clean(progressbar):
    bars = ChainProgress(2, DRAWS, TUNE, progressbar)
    screen = quiet(bars, force_terminal=True, width=120)
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
    with ChainProgress(1, DRAWS, TUNE, False) as bars:
        bars.update(0, 5, STATS)
        bars.update(0, 1000, STATS)
    assert capfd.readouterr() == ("", "")
    with pytest.raises(ImportError):
        ChainProgress(1, DRAWS, TUNE, True)


@pytest.mark.parametrize("progressbar", ["all", 1])
def test_anything_else_is_refused_as_by_pm_sample(progressbar):
    with pytest.raises(ValueError, match="Invalid value for `progressbar`") as ours:
        ChainProgress(1, DRAWS, TUNE, progressbar)
    with pm.Model():
        pm.Normal("x")
        with pytest.raises(ValueError, match="Invalid value for `progressbar`") as theirs:
            pm.sample(2, tune=2, chains=1, step=pm.Metropolis(), progressbar=progressbar)
    assert str(ours.value) == str(theirs.value)
