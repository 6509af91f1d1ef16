"""A checkpoint of several processes: who may write, and what is left when their job has died."""

import os
import pickle
import platform
import re
import unicodedata
from contextlib import contextmanager

import numpy as np
import pytest

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.sampling.checkpoint import checkpoint
from pymc_statespace_filters.sampling.checkpoint import journal as chain_log
from pymc_statespace_filters.sampling.checkpoint.checkpoint import (
    join_checkpoint,
    open_checkpoint,
    subfolder,
)
from tests.sampling.lock_clock import lock_of_elsewhere

ASKED = {"draws": 1000, "chains": 2}


def append(log, *numbers):
    log.append({"x": np.array(numbers)}, {"last": np.array(numbers[-1])})


def numbers_in(log):
    stored = log.read()
    if stored is None:
        return []
    assert stored.state["last"] == stored.draws["x"][-1]
    return stored.draws["x"].tolist()


def joined(first):
    """As another process joins it."""
    return join_checkpoint(pickle.loads(pickle.dumps(first.ticket())))


@contextmanager
def job_of_elsewhere(monkeypatch, folder):
    """The two ranks of a job on another computer, of which nothing is heard any more."""
    with lock_of_elsewhere(monkeypatch, folder) as lock:
        with monkeypatch.context() as other:
            other.setattr(checkpoint, "FolderLock", lambda _: lock)
            first = open_checkpoint(folder, ASKED)
        with first, joined(first) as second:
            yield first, second


def test_each_rank_writes_the_logs_of_its_chains(tmp_path):
    with open_checkpoint(tmp_path, ASKED) as first:
        with joined(first) as second, joined(second) as third:
            append(first.log(0), 1, 2)
            append(second.log(1), 3)
            append(third.log(2), 4)
            second.beat()
        # They have ended, and taken nothing with them.
        first.beat()
        assert numbers_in(first.log(1)) == [3]
    with open_checkpoint(tmp_path, ASKED) as first:
        assert [numbers_in(first.log(chain)) for chain in range(4)] == [[1, 2], [3], [4], []]


def test_a_chain_goes_from_rank_to_rank(tmp_path):
    with open_checkpoint(tmp_path, ASKED) as first, joined(first) as second:
        for number, rank in enumerate([first, second, first, second, second]):
            assert numbers_in(rank.log(0)) == list(range(number))
            append(rank.log(0), number)
            rank.log(0).close()


def test_a_folder_that_only_one_rank_sees_is_refused(tmp_path, clock):
    """Two disks of one name; even what was asked for is the same."""
    open_checkpoint(tmp_path / "there", ASKED).close()
    with open_checkpoint(tmp_path / "here", ASKED) as first:
        ticket = first.ticket()._replace(folder=str(tmp_path / "there"))
        with pytest.raises(ModelError) as caught:
            join_checkpoint(ticket)
    assert str(caught.value) == (
        f"checkpoint={str(tmp_path / 'there')!r} is not on a file system that all ranks see: "
        f"{platform.node()} does not find {ticket.lock} in it, which the first rank has put there; "
        f"give a path on a shared file system"
    )
    assert clock.now >= 60


def test_a_folder_that_comes_in_sight_late_is_waited_for(tmp_path, clock):
    with open_checkpoint(tmp_path / "run", ASKED) as first:
        os.rename(tmp_path / "run", tmp_path / "hidden")
        clock.at_each_sleep.append(
            lambda: clock.now != 30 or os.rename(tmp_path / "hidden", tmp_path / "run")
        )
        joined(first).close()
    assert clock.now == 30


def test_a_rank_of_a_job_that_has_ended_writes_no_more(tmp_path):
    with open_checkpoint(tmp_path, ASKED) as first:
        second = joined(first)
        append(second.log(0), 1)
    for touch in (second.log(0).read, second.log(1).read, lambda: append(second.log(0), 2)):
        with pytest.raises(ModelError, match="has gone, nothing more is stored there"):
            touch()
    second.close()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["chain-0.log", "run.json"]
    with open_checkpoint(tmp_path, ASKED) as first:
        assert numbers_in(first.log(0)) == [1]


def test_a_job_that_is_taken_over_writes_no_more(tmp_path, clock, monkeypatch):
    """Neither its first rank, which was suspended, nor another that is still running."""
    with job_of_elsewhere(monkeypatch, tmp_path) as (first, second):
        append(first.log(0), 1)
        append(second.log(1), 2)
        with open_checkpoint(tmp_path, ASKED) as fresh:
            append(fresh.log(1), 3)
            whole = fresh.log(1).path.read_bytes()
            for log in (first.log(0), first.log(1), second.log(1), second.log(2)):
                with pytest.raises(ModelError, match="another job has taken the folder over"):
                    append(log, 4)
            assert fresh.log(1).path.read_bytes() == whole
            assert numbers_in(fresh.log(0)) == [1]
            assert numbers_in(fresh.log(1)) == [2, 3]
            assert numbers_in(fresh.log(2)) == []


@pytest.mark.skipif(os.name == "nt", reason="an open file is not replaced")
def test_a_write_that_is_on_its_way_goes_nowhere(tmp_path, clock, monkeypatch):
    with job_of_elsewhere(monkeypatch, tmp_path) as (_, second):
        append(second.log(0), 1)
        with open_checkpoint(tmp_path, ASKED) as fresh:
            monkeypatch.setattr(second.log(0), "_check", lambda: None)  # it has looked just before
            append(second.log(0), 2)
            assert numbers_in(fresh.log(0)) == [1]
            append(fresh.log(0), 5)
            append(second.log(0), 3)
    with open_checkpoint(tmp_path, ASKED) as fresh:
        assert numbers_in(fresh.log(0)) == [1, 5]


@pytest.mark.skipif(os.name == "nt", reason="an open file is not replaced")
def test_a_write_that_fails_when_taken_over_cuts_nothing_off(tmp_path, clock, monkeypatch):
    with job_of_elsewhere(monkeypatch, tmp_path) as (_, second):
        append(second.log(0), 1)
        opened = []

        def stale(_):
            disk.undo()
            opened.append(open_checkpoint(tmp_path, ASKED))
            append(opened[0].log(0), 5)
            raise OSError(116, "Stale file handle")

        with monkeypatch.context() as disk:
            disk.setattr(chain_log.os, "fsync", stale)
            with pytest.raises(ModelError, match="has gone"):
                append(second.log(0), 2)
        with opened[0] as fresh:
            assert numbers_in(fresh.log(0)) == [1, 2, 5]  # it had been written before it failed


@pytest.mark.skipif(os.name == "nt", reason="an open file is not replaced")
def test_who_is_refused_leaves_no_writer_behind(tmp_path, clock, monkeypatch):
    """He has removed the lock of the dead, so the next one knows nothing of them."""
    with job_of_elsewhere(monkeypatch, tmp_path) as (_, second):
        append(second.log(0), 1)
        with pytest.raises(DataMismatchError):
            open_checkpoint(tmp_path, {"draws": 5})
        monkeypatch.setattr(second.log(0), "_check", lambda: None)
        append(second.log(0), 2)
        with open_checkpoint(tmp_path, ASKED) as fresh:
            assert numbers_in(fresh.log(0)) == [1]


def test_logs_of_a_job_that_ended_well_are_not_copied(tmp_path):
    with open_checkpoint(tmp_path, ASKED) as first:
        append(first.log(0), 1)
        before = first.log(0).path.stat()
    with open_checkpoint(tmp_path, ASKED) as first:
        after = first.log(0).path.stat()
    assert (before.st_ino, before.st_mtime_ns) == (after.st_ino, after.st_mtime_ns)


NAMES = [
    *("M1", "m1", "M 1", "M_1", "M-1", "M/1", "M.1", "M1 ", " M1", "M1.", "M\t1", "M\\1", "M:1"),
    *("", ".", "..", "/", "-", "CON", "nul", "aux.txt", "lock.a@b.1.2", "run.json", "~", "*?"),
    *"\u00e9 e\u0301 e stra\u00dfe STRASSE \u00df \u1e9e \ufb01 fi \u0130 i \u0131".split(),
    *("\u03a9", "\u2126", "模型", "模" * 300, "🙂", "\ud800", "a\x00b", "x" * 1000, "x" * 1001),
    *(subfolder("M1"), "M1-" + subfolder("M1")),
]


def test_folders_of_all_names_are_different_on_any_disk(tmp_path):
    folders = [subfolder(name) for name in NAMES]
    assert len({unicodedata.normalize("NFKC", f).casefold() for f in folders}) == len(set(NAMES))
    for name, folder in zip(NAMES, folders, strict=True):
        assert re.fullmatch("([A-Za-z0-9]+-)*[0-9a-f]{10}", folder), name
        assert len(folder) <= 51
        (tmp_path / folder).mkdir()
    assert subfolder("Modèle à bruit (2)").startswith("Modele-a-bruit-2-")
