"""The lease of a folder: who is refused, and when an owner counts as dead, here and elsewhere."""

import os
import re
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from threading import Barrier, BrokenBarrierError, Thread

import pytest
from filelock import SoftFileLease

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling.checkpoint import lease
from pymc_statespace_filters.sampling.checkpoint.lease import FolderLease, check_held
from tests.sampling.alone import WITHOUT_PYMC
from tests.sampling.lease_clock import lease_file, lease_of_elsewhere
from tests.waiting import LIMIT, python, wait_until

with tempfile.TemporaryDirectory() as folder, SoftFileLease(Path(folder, "lease")) as held:
    HOST = held.owner.hostname

HELD_IS_FIXED = pytest.mark.skipif(os.name == "nt", reason="what is held is not moved or removed")

HOLDER = f"""
import sys, time
from pathlib import Path
{WITHOUT_PYMC}
from pymc_statespace_filters.sampling.checkpoint.lease import FolderLease
lease = FolderLease(Path(sys.argv[1]))
print(flush=True)
time.sleep(10_000)
"""


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def heartbeat(path):
    """Touch a lease as its owner does."""
    time.sleep(0.01)  # the resolution of time stamps
    os.utime(path)


def test_a_living_process_is_respected_and_a_killed_one_is_not(tmp_path, clock):
    with python("-c", HOLDER, tmp_path) as process:
        process.stdout.readline()
        (path,) = tmp_path.iterdir()
        assert re.search("host=(.*)", path.read_text())[1] == HOST
        touched = path.stat().st_mtime_ns

        def heard():
            return path.stat().st_mtime_ns != touched

        clock.at_each_sleep.append(lambda: wait_until(heard))
        with pytest.raises(ModelError) as caught:
            FolderLease(tmp_path)
        assert re.fullmatch(
            rf"{re.escape(str(tmp_path))} is in use by process {process.pid} on \S+, which "
            rf"holds {path.name}: wait for its end or give another path",
            str(caught.value),
        )
        assert names(tmp_path) == [path.name]
    clock.now = 0
    FolderLease(tmp_path).release()
    assert clock.now == 0  # the table of processes tells at once
    assert not names(tmp_path)


def test_a_folder_is_held_once_by_a_process(tmp_path, clock):
    held = FolderLease(tmp_path)
    with pytest.raises(ModelError, match="in use by this process already"):
        FolderLease(tmp_path)
    assert names(tmp_path) == [held.path.name]
    held.release()
    FolderLease(tmp_path).release()
    assert clock.now == 0


@pytest.mark.parametrize("pid", [os.getpid(), os.getppid()], ids=["itself", "parent"])
def test_a_process_that_has_the_number_of_a_dead_one_is_not_it(tmp_path, clock, pid):
    lease_file(tmp_path, pid, HOST, start=1, name=f"lease.{lease._process_table()}-0")
    FolderLease(tmp_path).release()
    assert not names(tmp_path)
    assert clock.now == (0 if os.name == "nt" else 20)  # Windows removes no file that is held


def test_windows_tells_by_the_removal(tmp_path, clock, monkeypatch):
    path = lease_file(tmp_path, os.getppid(), HOST, name="lease.here-0")
    with monkeypatch.context() as windows:
        windows.setattr(lease, "_process_table", lambda: "here")
        windows.setattr(lease.os, "name", "nt")
        assert lease._has_ended(path)

    def unlink(self, missing_ok=False):
        raise PermissionError(13, "The file is used by another process", str(self))

    with monkeypatch.context() as windows:
        windows.setattr(type(path), "unlink", unlink)
        windows.setattr(lease, "_has_ended", lambda path: True)
        windows.setattr(lease.FolderLease, "release", lambda self: None)
        with pytest.raises(
            ModelError, match=f"in use by process {os.getppid()} on .* lease.here-0"
        ):
            FolderLease(tmp_path)
    assert clock.now == 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_fork_does_not_release_the_folder_of_its_parent(tmp_path):
    held = FolderLease(tmp_path)
    child = os.fork()
    if child == 0:
        held.release()
        os._exit(0)
    os.waitpid(child, 0)
    check_held(held.path)
    held.release()
    assert not names(tmp_path)


# Owners on another computer, or in another container: only their heartbeats tell that they live.


@pytest.mark.parametrize("host", ["node7", "a.b.c", HOST, f"{HOST}?pidns-f0000001"])
@pytest.mark.parametrize("number_lives_here", [True, False])
def test_a_lease_of_elsewhere_that_is_not_touched_expires(tmp_path, clock, host, number_lives_here):
    path = lease_file(tmp_path, os.getpid() if number_lives_here else 2**22 + 1, host)
    os.utime(path, (2**31, 2**31))  # clocks are not compared
    held = FolderLease(tmp_path)
    assert clock.now == 20
    assert names(tmp_path) == [held.path.name]
    held.release()


@pytest.mark.parametrize("content", ["", "filelock/2\npi", "something else"])
def test_a_lease_without_an_owner_expires(tmp_path, clock, content):
    """Its process was killed before it had written its name."""
    (tmp_path / "lease.0").write_text(content)
    FolderLease(tmp_path).release()
    assert clock.now == 20
    assert not names(tmp_path)


@HELD_IS_FIXED
@pytest.mark.parametrize("host", ["node7", "vm?pidns-f0000001"])
def test_a_lease_of_elsewhere_that_is_touched_is_respected(tmp_path, clock, monkeypatch, host):
    dead = lease_file(tmp_path, 12, "node3")
    with lease_of_elsewhere(monkeypatch, tmp_path / "..", host) as held:
        held.path.rename(tmp_path / held.path.name)
        clock.at_each_sleep.append(lambda: heartbeat(tmp_path / held.path.name))
        with pytest.raises(ModelError) as caught:
            FolderLease(tmp_path)
    assert str(caught.value) == (
        f"{tmp_path} is in use by process {os.getpid()} on {host.partition('?')[0]}, which holds "
        f"{held.path.name}: wait for its end or give another path"
    )
    assert clock.now < 5
    # A job that is refused removes nothing.
    assert names(tmp_path) == sorted([dead.name, held.path.name])


def test_expired_leases_are_waited_for_together(tmp_path, clock):
    for pid in range(1, 6):
        lease_file(tmp_path, pid, name=f"lease.{pid}")
    FolderLease(tmp_path).release()
    assert clock.now == 20
    assert not names(tmp_path)


def test_an_owner_that_stops_for_a_while_is_respected(tmp_path, clock):
    path = lease_file(tmp_path, 12)
    clock.at_each_sleep.append(lambda: clock.now < 17 or heartbeat(path))
    with pytest.raises(ModelError, match="in use by process 12 on node7"):
        FolderLease(tmp_path)


def test_an_owner_is_respected_however_long_the_newcomer_stops_between_two_polls(tmp_path, clock):
    """Polls are counted: while all computers are suspended, nobody expires."""
    path, polls = lease_file(tmp_path, 12), []

    def suspended():
        polls.append(clock.now)
        clock.now += 3600
        if len(polls) == 5:
            heartbeat(path)

    clock.at_each_sleep.append(suspended)
    with pytest.raises(ModelError, match="in use by process 12 on node7"):
        FolderLease(tmp_path)


def test_an_owner_that_ends_meanwhile_is_not_waited_for(tmp_path, clock):
    path = lease_file(tmp_path, 12)
    clock.at_each_sleep.append(lambda: clock.now < 7 or path.unlink(missing_ok=True))
    held = FolderLease(tmp_path)
    assert clock.now == 7
    held.release()


@HELD_IS_FIXED
def test_an_owner_that_was_taken_for_dead_is_told(tmp_path, clock, monkeypatch):
    with lease_of_elsewhere(monkeypatch, tmp_path) as suspended:
        check_held(suspended.path)
        held = FolderLease(tmp_path)
        with pytest.raises(ModelError) as caught:
            check_held(suspended.path)
    assert str(caught.value) == (
        f"{tmp_path}: the lease file {suspended.path.name} of this job is gone, so nothing more is "
        f"stored: another job took the folder over after 20 s without a heartbeat, or the file was "
        f"deleted"
    )
    assert names(tmp_path) == [held.path.name]  # its release removes nothing of another job
    held.release()


def test_of_two_newcomers_the_first_gets_the_folder(tmp_path, monkeypatch):
    """Both watch the lease of the dead, and the second one that of the first, in step."""
    lease_file(tmp_path, 12, "node3")
    step, got, living = Barrier(2), {}, []

    def sleep(_):
        for path in list(living):
            with suppress(FileNotFoundError):  # the other one has ended
                heartbeat(path)
        try:
            step.wait(LIMIT)
        except BrokenBarrierError:
            pass  # the other one has ended

    def come(name):
        try:
            got[name] = FolderLease(tmp_path)
        except ModelError as error:
            got[name] = error
        step.abort()

    monkeypatch.setattr(lease, "sleep", sleep)
    threads = [Thread(target=come, args=[name]) for name in ("first", "second")]
    for name, thread in zip(("first", "second"), threads, strict=True):
        monkeypatch.setattr(lease, "_process_table", lambda name=name: name)
        thread.start()
        # Until it has looked at the others.
        wait_until(lambda thread=thread: step.n_waiting or not thread.is_alive())
        for path in tmp_path.glob(f"lease.{name}-*"):
            path.write_text(re.sub("host=.*", f"host=node-{name}", path.read_text()))
            living.append(path)
    for thread in threads:
        thread.join(LIMIT)
    assert "on node-first" in str(got["second"])
    assert names(tmp_path) == [got["first"].path.name]
    got["first"].release()


def test_a_heartbeat_touches_the_lease_while_python_waits(tmp_path, monkeypatch):
    monkeypatch.setattr(lease, "_HEARTBEAT_SECONDS", 0.02)
    held = FolderLease(tmp_path)
    touched = set()

    def touched_again():
        touched.add(held.path.stat().st_mtime_ns)
        return len(touched) >= 4

    wait_until(touched_again)
    held.release()
