"""What is said of code that is being compiled."""

from io import StringIO
from time import sleep

import pytest
from rich.console import Console

from pymc_statespace_filters import progress


@pytest.fixture
def terminal(monkeypatch):
    written = StringIO()
    monkeypatch.setattr(
        progress, "Console", lambda stderr: Console(file=written, force_terminal=True, width=80)
    )
    monkeypatch.setattr(progress, "PATIENCE", 0.05)
    return written


def test_a_slow_compilation_is_announced_while_it_lasts(terminal):
    with progress.slow_compilation("pf_enkf"):
        sleep(0.5)
        assert "Compiling pf_enkf, once per installation" in terminal.getvalue()
    ended = terminal.getvalue()
    sleep(0.2)
    assert terminal.getvalue() == ended


def test_a_fast_or_failed_one_leaves_nothing_running(terminal):
    with progress.slow_compilation("pf_enkf"):
        pass
    with pytest.raises(ZeroDivisionError), progress.slow_compilation("pf_enkf"):
        _ = 1 / 0
    sleep(0.2)
    assert terminal.getvalue() == ""


def test_without_a_terminal_the_log_says_once_what_is_compiled(capsys, caplog, monkeypatch):
    caplog.set_level("INFO", "pymc")
    monkeypatch.setattr(progress, "_logged", [])
    with progress.slow_compilation("pf_enkf"):
        pass
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    for name in ("the model", "pf_enkf"):
        with progress.slow_compilation(name), progress.slow_compilation("a part"):
            sleep(0.2)
    assert caplog.messages == ["Compiling the model, once per installation ..."]
    assert capsys.readouterr().out == ""


def test_parts_of_a_compilation_and_what_a_bar_shows_have_no_line_of_their_own(terminal):
    with progress.slow_compilation("the model"), progress.slow_compilation("a part"):
        sleep(0.3)
    assert "Compiling the model" in terminal.getvalue()
    assert "a part" not in terminal.getvalue()
    terminal.truncate(0)

    class Work:
        on_progress = None

    work = Work()
    with progress.row_progress(work, enabled=True) as begin:
        begin("Pilot", 10)
        sleep(0.2)
        work.on_progress(1)
        with progress.slow_compilation("a filter"):
            sleep(0.3)
        begin("", 0)
    assert "a filter" not in terminal.getvalue()
    with progress.slow_compilation("the model"):
        sleep(0.3)
    assert "Compiling the model" in terminal.getvalue()
