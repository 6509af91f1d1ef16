"""A checkpoint of several processes: who may write, and what is left when their job has died."""

import os
import pickle
import platform
import re
import unicodedata
from contextlib import contextmanager

import numpy as np
import pytest

from pymc_statespace_filters.errors import CheckpointError, DataMismatchError, ModelError
from pymc_statespace_filters.sampling.checkpoint import checkpoint, journal
from pymc_statespace_filters.sampling.checkpoint.checkpoint import (
    folder_name,
    join_checkpoint,
    open_checkpoint,
)
from tests.sampling.lease_clock import lease_of_elsewhere

SETTINGS = {"draws": 1000, "chains": 2}


def append(log, *numbers):
    log.append({"x": np.array(numbers)}, {"last": np.array(numbers[-1])})


def numbers_in(log):
    stored = log.read()
    if stored is None:
        return []
    assert stored.state["last"] == stored.draws["x"][-1]
    return stored.draws["x"].tolist()


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def joined(first):
    """As another process joins it."""
    return join_checkpoint(pickle.loads(pickle.dumps(first.ticket)))


@contextmanager
def job_of_elsewhere(monkeypatch, folder):
    """The two ranks of a job on another computer, of which nothing is heard any more."""
    with lease_of_elsewhere(monkeypatch, folder) as held:
        with monkeypatch.context() as other:
            other.setattr(checkpoint, "FolderLease", lambda _: held)
            first = open_checkpoint(folder, SETTINGS)
        with first, joined(first) as second:
            yield first, second


def test_each_rank_writes_the_logs_of_its_chains(tmp_path):
    with open_checkpoint(tmp_path, SETTINGS) as first:
        with joined(first) as second, joined(second) as third:
            append(first.journal(0), 1, 2)
            append(second.journal(1), 3)
            append(third.journal(2), 4)
        # They have ended, and taken nothing with them.
        assert numbers_in(first.journal(1)) == [3]
    with open_checkpoint(tmp_path, SETTINGS) as first:
        assert [numbers_in(first.journal(chain)) for chain in range(4)] == [[1, 2], [3], [4], []]


def test_a_chain_goes_from_rank_to_rank(tmp_path):
    with open_checkpoint(tmp_path, SETTINGS) as first, joined(first) as second:
        for number, rank in enumerate([first, second, first, second, second]):
            assert numbers_in(rank.journal(0)) == list(range(number))
            append(rank.journal(0), number)


def test_a_folder_that_only_one_rank_sees_is_refused(tmp_path, clock):
    """Two disks of one name; even what was asked for is the same."""
    open_checkpoint(tmp_path / "there", SETTINGS).close()
    with open_checkpoint(tmp_path / "here", SETTINGS) as first:
        ticket = first.ticket._replace(folder=str(tmp_path / "there"))
        with pytest.raises(ModelError) as caught:
            join_checkpoint(ticket)
    assert str(caught.value) == (
        f"checkpoint={str(tmp_path / 'there')!r} is not on a file system that all ranks see: "
        f"{platform.node()} does not find {ticket.lease}, which the first rank has written there; "
        f"give a path on a shared file system"
    )
    assert clock.now >= 60


def test_a_folder_that_comes_in_sight_late_is_waited_for(tmp_path, clock):
    with open_checkpoint(tmp_path / "run", SETTINGS) as first:
        os.rename(tmp_path / "run", tmp_path / "hidden")
        clock.at_each_sleep.append(
            lambda: clock.now != 30 or os.rename(tmp_path / "hidden", tmp_path / "run")
        )
        joined(first).close()
    assert clock.now == 30


def test_a_rank_of_a_job_that_has_ended_writes_no_more(tmp_path):
    with open_checkpoint(tmp_path, SETTINGS) as first:
        second = joined(first)
        append(second.journal(0), 1)
    for touch in (
        second.journal(0).read,
        second.journal(1).read,
        lambda: append(second.journal(0), 2),
    ):
        with pytest.raises(ModelError, match="is gone, so nothing more is stored"):
            touch()
    second.close()
    assert len(list(tmp_path.iterdir())) == 2
    assert [p.name for p in tmp_path.glob("chains.*/*")] == ["chain-0.0-0.segment"]
    with open_checkpoint(tmp_path, SETTINGS) as first:
        assert numbers_in(first.journal(0)) == [1]


def test_a_job_that_is_taken_over_writes_no_more(tmp_path, clock, monkeypatch):
    """Neither its first rank, which was suspended, nor another that is still running."""
    with job_of_elsewhere(monkeypatch, tmp_path) as (first, second):
        append(first.journal(0), 1)
        append(second.journal(1), 2)
        with open_checkpoint(tmp_path, SETTINGS) as fresh:
            append(fresh.journal(1), 3)
            whole = contents(tmp_path)
            for chain in (first.journal(0), first.journal(1), second.journal(1), second.journal(2)):
                with pytest.raises(ModelError, match="another job took the folder over"):
                    append(chain, 4)
            assert contents(tmp_path) == whole
            assert numbers_in(fresh.journal(0)) == [1]
            assert numbers_in(fresh.journal(1)) == [2, 3]
            assert numbers_in(fresh.journal(2)) == []


@pytest.mark.skipif(os.name == "nt", reason="an open file is not replaced")
def test_a_write_that_is_on_its_way_goes_nowhere(tmp_path, clock, monkeypatch):
    with job_of_elsewhere(monkeypatch, tmp_path) as (_, second):
        append(second.journal(0), 1)
        with open_checkpoint(tmp_path, SETTINGS) as fresh:
            chain = second.journal(0)
            monkeypatch.setattr(chain, "_check", lambda: None)  # it has looked just before
            with pytest.raises(CheckpointError, match="cannot be written"):
                append(chain, 2)
            assert numbers_in(fresh.journal(0)) == [1]
            append(fresh.journal(0), 5)
            with pytest.raises(OSError, match="No such file"):
                append(chain, 3)
    with open_checkpoint(tmp_path, SETTINGS) as fresh:
        assert numbers_in(fresh.journal(0)) == [1, 5]


@pytest.mark.parametrize("call", ["fsync", "replace"])
@pytest.mark.skipif(os.name == "nt", reason="an open file is not replaced")
def test_a_write_that_is_taken_over_in_its_midst_goes_nowhere(tmp_path, clock, monkeypatch, call):
    with job_of_elsewhere(monkeypatch, tmp_path) as (_, second):
        append(second.journal(0), 1)
        opened, function = [], getattr(os, call)

        def slow(*args):
            disk.undo()
            opened.append(open_checkpoint(tmp_path, SETTINGS))
            append(opened[0].journal(0), 5)
            function(*args)

        with monkeypatch.context() as disk:
            disk.setattr(journal.os, call, slow)
            with pytest.raises(ModelError, match="is gone"):
                append(second.journal(0), 2)
        with opened[0] as fresh:
            assert numbers_in(fresh.journal(0)) == [1, 5]


@pytest.mark.skipif(os.name == "nt", reason="an open file is not replaced")
def test_a_write_that_fails_when_taken_over_cuts_nothing_off(tmp_path, clock, monkeypatch):
    with job_of_elsewhere(monkeypatch, tmp_path) as (_, second):
        append(second.journal(0), 1)
        opened = []

        def stale(_):
            disk.undo()
            opened.append(open_checkpoint(tmp_path, SETTINGS))
            append(opened[0].journal(0), 5)
            raise OSError(116, "Stale file handle")

        with monkeypatch.context() as disk:
            disk.setattr(journal.os, "fsync", stale)
            with pytest.raises(ModelError, match="is gone"):
                append(second.journal(0), 2)
        with opened[0] as fresh:
            assert numbers_in(fresh.journal(0)) == [1, 5]


@pytest.mark.skipif(os.name == "nt", reason="an open file is not replaced")
def test_a_job_that_is_refused_leaves_no_writer_behind(tmp_path, clock, monkeypatch):
    """It has removed the lease of the dead job, so the next one does not know of that."""
    with job_of_elsewhere(monkeypatch, tmp_path) as (_, second):
        append(second.journal(0), 1)
        with pytest.raises(DataMismatchError):
            open_checkpoint(tmp_path, {"draws": 5})
        with open_checkpoint(tmp_path, SETTINGS) as fresh:
            monkeypatch.setattr(second.journal(0), "_check", lambda: None)
            with pytest.raises(CheckpointError, match="cannot be written"):
                append(second.journal(0), 2)
            assert numbers_in(fresh.journal(0)) == [1]


def test_a_folder_that_cannot_be_cleared_of_a_dead_job_is_refused(tmp_path, monkeypatch):
    with open_checkpoint(tmp_path, SETTINGS) as first:
        append(first.journal(0), 1)

    def busy(path):
        raise OSError(39, "Directory not empty")

    with monkeypatch.context() as disk:
        disk.setattr(checkpoint.shutil, "rmtree", busy)
        with pytest.raises(ModelError, match=r"cannot be written to \(Directory not empty\)"):
            open_checkpoint(tmp_path, SETTINGS)
    with open_checkpoint(tmp_path, SETTINGS) as first:
        assert numbers_in(first.journal(0)) == [1]
    assert len(list(tmp_path.glob("chains.*"))) == 1


NAMES = [
    *("M1", "m1", "M 1", "M_1", "M-1", "M/1", "M.1", "M1 ", " M1", "M1.", "M\t1", "M\\1", "M:1"),
    *("", ".", "..", "/", "-", "CON", "nul", "aux.txt", "lock.a@b.1.2", "run.json", "~", "*?"),
    *"\u00e9 e\u0301 e stra\u00dfe STRASSE \u00df \u1e9e \ufb01 fi \u0130 i \u0131".split(),
    *("\u03a9", "\u2126", "模型", "模" * 300, "🙂", "\ud800", "a\x00b", "x" * 1000, "x" * 1001),
    *(folder_name("M1"), "M1-" + folder_name("M1")),
]


def test_folders_of_all_names_are_different_on_any_disk(tmp_path):
    folders = [folder_name(name) for name in NAMES]
    assert len({unicodedata.normalize("NFKC", f).casefold() for f in folders}) == len(set(NAMES))
    for name, folder in zip(NAMES, folders, strict=True):
        assert re.fullmatch("([A-Za-z0-9]+-)*[0-9a-f]{10}", folder), name
        assert len(folder) <= 51
        (tmp_path / folder).mkdir()
    assert folder_name("Modèle à bruit (2)").startswith("Modele-a-bruit-2-")
