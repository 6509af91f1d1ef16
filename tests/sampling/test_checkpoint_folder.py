"""The folder of a checkpoint: of one process at a time, and with a name for any text."""

import errno
import os
import platform
import re
import unicodedata
from contextlib import ExitStack

import numpy as np
import pytest
from filelock import FileLock

from pymc_statespace_filters.errors import CheckpointError, DataMismatchError, ModelError
from pymc_statespace_filters.sampling.checkpoint.checkpoint import folder_name, open_checkpoint
from tests.sampling.alone import WITHOUT_PYMC
from tests.waiting import python

SETTINGS = {"draws": 1000, "chains": 2}

HOLDER = f"""
import sys, time
{WITHOUT_PYMC}
from pymc_statespace_filters.sampling.checkpoint.checkpoint import open_checkpoint
with open_checkpoint(sys.argv[1], {SETTINGS}):
    print(flush=True)
    time.sleep(10_000)
"""


def open_and_close(folder, settings=SETTINGS):
    with open_checkpoint(folder, settings):
        pass


def opens(folder):
    """Whether the folder is free."""
    try:
        open_and_close(folder)
    except ModelError:
        return False
    return True


def test_a_folder_is_of_one_process_at_a_time_and_free_when_that_is_killed(tmp_path):
    with python("-c", HOLDER, tmp_path) as process:
        process.stdout.readline()
        with pytest.raises(ModelError) as caught:
            open_and_close(tmp_path)
        assert str(caught.value) == (
            f"{tmp_path} is in use by process {process.pid} on {platform.node()}: wait for its end "
            "or give another path"
        )
    assert opens(tmp_path)


def test_a_folder_is_one_checkpoint_at_a_time_in_a_process(tmp_path):
    with open_checkpoint(tmp_path, SETTINGS):
        with pytest.raises(ModelError, match=f"is in use by process {os.getpid()} on"):
            open_and_close(tmp_path)
    assert opens(tmp_path)


def test_a_run_that_is_refused_frees_the_folder(tmp_path):
    assert opens(tmp_path)
    with pytest.raises(DataMismatchError):
        open_and_close(tmp_path, {"draws": 5})
    assert opens(tmp_path)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_fork_does_not_free_the_folder_of_its_parent(tmp_path):
    with open_checkpoint(tmp_path, SETTINGS):
        child = os.fork()
        if child == 0:
            os._exit(0)
        os.waitpid(child, 0)
        assert not opens(tmp_path)
    assert opens(tmp_path)


@pytest.mark.parametrize("ends", [True, False])
def test_an_owner_on_another_computer_is_waited_for(tmp_path, monkeypatch, ends):
    """A server keeps the lock of a computer that has failed for a while."""
    held = ExitStack()
    held.enter_context(open_checkpoint(tmp_path, SETTINGS))
    (tmp_path / "run.owner").write_text("process 12 on node7", encoding="utf-8")
    waited, acquire = [], FileLock.acquire

    def in_time(self, timeout, **settings):
        waited.append(timeout)
        if ends:
            held.close()
        return acquire(self, timeout=0.0)

    monkeypatch.setattr(FileLock, "acquire", in_time)
    if ends:
        assert opens(tmp_path)
    else:
        with pytest.raises(ModelError, match="is in use by process 12 on node7: wait for its end"):
            open_and_close(tmp_path)
    assert waited == [120.0]


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK])
def test_without_locks_no_second_process_writes_over_what_the_first_has_stored(
    tmp_path, monkeypatch, number
):
    def unknown(self, **settings):
        raise OSError(number, "no locks here")

    monkeypatch.setattr(FileLock, "acquire", unknown)
    with open_checkpoint(tmp_path, SETTINGS) as one, open_checkpoint(tmp_path, SETTINGS) as other:
        one.append("chain 0", {"x": np.arange(3)}, {})
        for key in ("chain 0", "chain 1"):
            with pytest.raises(CheckpointError, match="another process has written to this file"):
                other.append(key, {"x": np.arange(3)}, {})
        one.append("chain 0", {"x": np.arange(3, 5)}, {})
    with open_checkpoint(tmp_path, SETTINGS) as again:
        found = again.read("chain 0")
    np.testing.assert_array_equal(found.draws["x"], np.arange(5))


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
