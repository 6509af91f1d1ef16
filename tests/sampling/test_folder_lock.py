"""The lock of a folder: who is kept out, and who is found to be dead, here and elsewhere."""

import os
import subprocess
import sys
import time
from pathlib import Path
from threading import Barrier, BrokenBarrierError, Thread

import pytest

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling.checkpoint import lease as folder_lock
from pymc_statespace_filters.sampling.checkpoint.lease import (
    FolderLock,
    _name,
    _Owner,
    _owner,
    _place,
)
from tests.sampling.lock_clock import lock_of_elsewhere

PROC = Path("/proc/self/stat")  # where the system tells when a process began
NODE = _place().partition("@")[0]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def beaten(path):
    """What makes a lock change as its owner's beats do."""
    return lambda: path.write_bytes(path.read_bytes() + b".")


def test_a_living_process_keeps_others_out_and_a_killed_one_does_not(tmp_path, clock):
    sleeping = [sys.executable, "-c", "import time; time.sleep(100)"]
    with subprocess.Popen(sleeping) as process:
        try:
            (tmp_path / _name(_owner(process.pid))).touch()
            with pytest.raises(ModelError, match=f"in use by process {process.pid} on {NODE}: "):
                FolderLock(tmp_path)
            assert len(list(tmp_path.iterdir())) == 1
        finally:
            process.kill()
        if PROC.exists():  # dead, and not yet buried
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
            FolderLock(tmp_path).release()
            assert not list(tmp_path.iterdir())
            (tmp_path / _name(_Owner(_place(), process.pid, 0))).touch()
    lock = FolderLock(tmp_path)
    assert lock.is_taken_over
    lock.release()
    assert not list(tmp_path.iterdir())
    assert clock.now == 0  # the table of processes knows at once


def test_a_folder_that_was_given_free_is_not_taken_over(tmp_path):
    for _ in range(2):
        lock = FolderLock(tmp_path)
        assert not lock.is_taken_over
        lock.release()


@pytest.mark.skipif(not PROC.exists(), reason="nothing tells when it began")
def test_a_process_that_has_the_number_of_a_dead_one_is_not_it(tmp_path):
    (tmp_path / _name(_Owner(_place(), os.getppid(), 1))).touch()
    (tmp_path / _name(_Owner(_place(), os.getpid(), 1))).touch()
    FolderLock(tmp_path).release()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "name",
    ["lock.elsewhere.12.345", f"lock.{NODE}.12.345", "lock.what", "lock.a@0.b.c", "lock.a@0.1"],
)
def test_locks_that_cannot_be_judged_are_respected(tmp_path, clock, name):
    """Such as those of earlier versions, whose owners did not beat."""
    (tmp_path / name).touch()
    with pytest.raises(ModelError, match=f"not running any more, delete .*{name}"):
        FolderLock(tmp_path)
    assert names(tmp_path) == [name]
    assert clock.now == 0


def test_a_fork_does_not_give_the_folder_of_its_parent_free(tmp_path, monkeypatch):
    lock = FolderLock(tmp_path)
    with monkeypatch.context() as child:
        child.setattr(os, "getpid", lambda: -1)
        lock.release()
    assert list(tmp_path.iterdir())
    lock.release()
    assert not list(tmp_path.iterdir())


# Owners in another table of processes: nothing but their beats tells whether they live.


@pytest.mark.parametrize("place", ["node7@5f2c", f"{NODE}@another", "a.b.c@"])
@pytest.mark.parametrize("number_lives_here", [True, False])
def test_a_lock_of_elsewhere_that_stands_still_is_removed(
    tmp_path, clock, place, number_lives_here
):
    pid = os.getpid() if number_lives_here else 2**22 + 1
    dead = tmp_path / _name(_Owner(place, pid, folder_lock._began(pid)))
    dead.touch()
    os.utime(dead, (2**31, 2**31))  # clocks are not compared
    lock = FolderLock(tmp_path)
    assert clock.now == 20
    assert lock.is_taken_over
    assert names(tmp_path) == [lock.path.name]
    lock.release()


@pytest.mark.parametrize("place", ["node7@5f2c", f"{NODE}@another"])
def test_a_lock_of_elsewhere_that_beats_is_respected(tmp_path, clock, monkeypatch, place):
    dead = tmp_path / _name(_Owner("node3@00", 12, 345))
    with lock_of_elsewhere(monkeypatch, tmp_path, place) as owner:
        dead.touch()
        clock.at_each_sleep.append(owner.beat)
        with pytest.raises(ModelError) as caught:
            FolderLock(tmp_path)
    assert str(caught.value) == (
        f"{tmp_path} is in use by process {os.getpid()} on {place.partition('@')[0]}, which "
        f"writes to {owner.path.name}: wait for its end, and 20 s in which that file does not "
        f"change, or give another path"
    )
    assert clock.now < 5
    # Nothing is removed by one who is refused: whoever comes next must know that a job has died.
    assert names(tmp_path) == [dead.name]


def test_the_dead_are_waited_for_together(tmp_path, clock):
    for pid in range(5):
        (tmp_path / _name(_Owner("node7@0", pid, 1))).touch()
    FolderLock(tmp_path).release()
    assert clock.now == 20
    assert not names(tmp_path)


def test_an_owner_that_stops_for_a_while_is_respected(tmp_path, clock):
    path = tmp_path / _name(_Owner("node7@0", 12, 345))
    path.touch()
    clock.at_each_sleep.append(lambda: clock.now < 17 or beaten(path)())
    with pytest.raises(ModelError, match="which writes to"):
        FolderLock(tmp_path)


def test_a_newcomer_that_stops_for_a_while_does_not_jump_to_conclusions(tmp_path, clock):
    path = tmp_path / _name(_Owner("node7@0", 12, 345))
    path.touch()
    clock.pace = 3600.0
    clock.at_each_sleep.append(lambda: clock.now < 5 * 3600 or beaten(path)())
    with pytest.raises(ModelError, match="which writes to"):
        FolderLock(tmp_path)


def test_an_owner_that_ends_meanwhile_is_not_waited_for(tmp_path, clock):
    path = tmp_path / _name(_Owner("node7@0", 12, 345))
    path.touch()
    clock.at_each_sleep.append(lambda: clock.now < 7 or path.unlink(missing_ok=True))
    lock = FolderLock(tmp_path)
    assert clock.now == 7
    assert not lock.is_taken_over
    lock.release()


def test_an_owner_that_was_taken_for_dead_stops(tmp_path, clock, monkeypatch):
    with lock_of_elsewhere(monkeypatch, tmp_path) as suspended:
        lock = FolderLock(tmp_path)
        with pytest.raises(ModelError) as caught:
            suspended.beat()
    assert str(caught.value) == (
        f"{tmp_path}: its lock {suspended.path.name} has gone, nothing more is stored there: "
        f"another job has taken the folder over, after 20 s without a sign of life, or the file "
        f"was deleted"
    )
    assert names(tmp_path) == [lock.path.name]  # it took nothing with it
    lock.release()


def test_of_two_newcomers_the_first_gets_the_folder(tmp_path, monkeypatch):
    """Both watch the lock of the dead, and the second one that of the first, in step."""
    (tmp_path / _name(_Owner("node3@0", 12, 345))).touch()
    step, got = Barrier(2), {}

    def sleep(_):
        try:
            step.wait(30)
        except BrokenBarrierError:
            pass  # the other one has ended

    def come(who):
        try:
            got[who] = FolderLock(tmp_path)
        except ModelError as error:
            got[who] = error
        step.abort()

    monkeypatch.setattr(folder_lock, "sleep", sleep)
    monkeypatch.setattr(folder_lock, "_BEAT_SECONDS", 0.0)
    threads = [Thread(target=come, args=[who], name=who) for who in ("first", "second")]
    for thread in threads:
        monkeypatch.setattr(folder_lock, "_place", lambda name=thread.name: f"{name}@0")
        thread.start()
        while thread.is_alive() and not step.n_waiting:
            time.sleep(0.001)  # until it has looked round
    for thread in threads:
        thread.join(60)
    assert "on first, which writes to" in str(got["second"])
    assert got["first"].is_taken_over
    assert names(tmp_path) == [got["first"].path.name]
    got["first"].release()


def test_beats_are_rare_and_each_one_shows(tmp_path, clock):
    lock = FolderLock(tmp_path)
    seen = []
    for _ in range(100):
        clock.now += 0.1
        lock.beat()
        seen.append(lock.path.read_bytes())
    assert len(set(seen)) == 4  # none yet, and at 3, 6 and 9 s
    assert len(seen[-1]) < 20
    lock.release()


@pytest.mark.parametrize("call", ["open", "_content"])
def test_a_beat_that_the_disk_refuses_is_a_beat_missed(tmp_path, clock, monkeypatch, call):
    lock = FolderLock(tmp_path)

    def refused(*_):
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as disk:
        disk.setattr(folder_lock, call, refused, raising=False)
        clock.now += 10
        lock.beat()
    assert lock.path.read_bytes() == b""
    clock.now += 10
    lock.beat()
    assert lock.path.read_bytes()
    lock.release()
