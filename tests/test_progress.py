"""The line that says what is being compiled."""

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


def test_without_a_terminal_nothing_is_written(capsys, monkeypatch):
    monkeypatch.setattr(progress, "Timer", None)  # nor is anything started
    with progress.slow_compilation("pf_enkf"):
        pass
    assert capsys.readouterr() == ("", "")
