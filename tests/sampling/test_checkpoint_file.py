"""The folder of a checkpoint and its journals: what survives a kill, and what is noticed."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pymc_statespace_filters.errors import (
    CheckpointError,
    CheckpointWarning,
    DataMismatchError,
    ModelError,
)
from pymc_statespace_filters.sampling.checkpoint import journal
from pymc_statespace_filters.sampling.checkpoint.checkpoint import open_checkpoint
from pymc_statespace_filters.sampling.checkpoint.journal import ChainJournal
from tests.sampling.alone import WITHOUT_PYMC
from tests.waiting import LIMIT

# Windows has no words of its own for these.
IS_FOLDER = "Permission denied" if os.name == "nt" else "Is a directory"
INSIDE_FILE = r"inside' cannot be written to \(Not a directory\)"
if os.name == "nt":
    INSIDE_FILE = "draws.nc' is a file: expected a folder"

SETTINGS = {"draws": 1000, "chains": 2, "model": "5f2c", "stages": [2, 1], "step": None}


def draws_of(first, n):
    """Draws that tell which they are."""
    number = np.arange(first, first + n)
    return {
        "x": number[:, None] + np.array([0.0, 0.25]),
        "moved": number % 2 == 0,
    }


def state_of(iteration):
    return {
        "rng": np.array([2**64 - 1, iteration], dtype=np.uint64),
        "nothing": np.zeros((0, 3)),
    }


def append_all(stored, sizes, first=0):
    """Write records of these numbers of draws; give the folder of the segments."""
    for size in sizes:
        stored.append(draws_of(first, size), state_of(first + size))
        first += size
    return stored._path.parent


def journal_in(folder, chain=0):
    folder.mkdir(exist_ok=True)
    return ChainJournal(folder / f"chain-{chain}", b"a run")


def write_journal(folder, sizes):
    append_all(journal_in(folder), sizes)
    return segments_in(folder)


def segments_in(folder):
    return sorted(folder.glob("chain-*.segment"))


def write(folder, sizes, settings=SETTINGS, chain=0):
    with open_checkpoint(folder, settings) as checkpoint:
        return append_all(checkpoint.journal(chain), sizes)


def read(folder, settings=SETTINGS, chain=0):
    with open_checkpoint(folder, settings) as checkpoint:
        return checkpoint.journal(chain).read()


def same(arrays, others):
    assert list(arrays) == list(others)
    for name, array in arrays.items():
        other = np.asarray(others[name])
        assert (array.dtype, array.shape) == (other.dtype, other.shape)
        assert array.tobytes() == other.tobytes()
        assert array.flags.writeable


def assert_holds(stored, n_draws):
    if n_draws == 0:
        assert stored is None
        return
    same(stored.draws, draws_of(0, n_draws))
    same(stored.state, state_of(n_draws))


def test_a_journal_gives_back_all_draws_and_the_last_state(tmp_path):
    write(tmp_path / "run", [3, 0, 1, 5])
    assert_holds(read(tmp_path / "run"), 9)


def test_a_journal_goes_on_in_another_process_without_being_read(tmp_path):
    write(tmp_path, [3])
    with open_checkpoint(tmp_path, SETTINGS) as checkpoint:
        checkpoint.journal(0).append(draws_of(3, 2), state_of(5))
        assert_holds(checkpoint.journal(0).read(), 5)
        checkpoint.journal(0).append(draws_of(5, 1), state_of(6))
    assert_holds(read(tmp_path), 6)


def test_a_journal_takes_arrays_of_any_layout_bit_for_bit(tmp_path):
    square = np.arange(6.0).reshape(2, 3)
    draws = {
        "columns": np.asfortranarray(square),
        "every second": np.arange(4)[::2],
        "big-endian": np.array([1.5, -0.0], dtype=">f8"),
        "special": np.array([np.nan, -np.inf]),
    }
    state = {"number": np.array(3), "square": square.T, "flag": np.True_}
    with open_checkpoint(tmp_path, {}) as checkpoint:
        checkpoint.journal(0).append(draws, state)
    stored = read(tmp_path, {})
    same(stored.draws, draws | {"big-endian": np.array([1.5, -0.0])})
    same(stored.state, state)


def test_a_journal_refuses_python_objects(tmp_path):
    with open_checkpoint(tmp_path, {}) as checkpoint:
        chain = checkpoint.journal(0)
        with pytest.raises(ValueError, match="Object arrays cannot be saved"):
            chain.append({"cause": np.array([None])}, {})
        assert chain.read() is None


def test_a_record_costs_its_own_length_alone(tmp_path):
    sizes = [path.stat().st_size for path in write_journal(tmp_path, [7] * 5)]
    assert len(sizes) == 5
    assert max(sizes) - min(sizes) == 0


def test_segments_stay_few_and_draws_are_not_written_often(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "_FAN_IN", 4)
    replace, n_bytes = os.replace, []

    def counted(source, target):
        n_bytes.append(os.stat(source).st_size)
        replace(source, target)

    monkeypatch.setattr(journal.os, "replace", counted)
    stored = journal_in(tmp_path)
    for i in range(100):
        append_all(stored, [100], first=100 * i)
        assert len(list(tmp_path.iterdir())) <= 3 * 4 + 1  # 4^4 > 100
    of_one = n_bytes[0]
    assert sum(n_bytes) < 100 * of_one * 4.1
    assert_holds(journal_in(tmp_path).read(), 10_000)


def test_draws_that_are_many_are_not_merged(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "_FAN_IN", 4)
    monkeypatch.setattr(journal, "_MAX_MERGED_BYTES", 4 * 20 * 17)
    write_journal(tmp_path, [20] * 16)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {f"chain-0.{i}-{i + 3}.segment" for i in (0, 4, 8, 12)}
    assert_holds(journal_in(tmp_path).read(), 320)


def test_old_states_do_not_fill_the_disk(tmp_path, monkeypatch):
    """A chain that carries its noise has a state of megabytes, each few seconds."""
    monkeypatch.setattr(journal, "_MAX_OLD_STATE_BYTES", 40_000)
    stored = journal_in(tmp_path)
    for i in range(60):
        stored.append(draws_of(10 * i, 10), {"noise": np.full(1250, float(i))})
        assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 100_000
    draws, state = stored.read()
    same(draws, draws_of(0, 600))
    np.testing.assert_array_equal(state["noise"], 59.0)
    same(journal_in(tmp_path).read().draws, draws)


def test_a_segment_that_is_damaged_before_it_is_merged_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "_FAN_IN", 3)
    stored = journal_in(tmp_path)
    append_all(stored, [2, 1])
    segments_in(tmp_path)[1].write_bytes(b"")
    with pytest.raises(OSError, match=r"1-1\.segment was damaged after it had been written"):
        append_all(stored, [1], first=3)
    with pytest.warns(CheckpointWarning, match="record 2 is missing, damaged or"):
        assert_holds(journal_in(tmp_path).read(), 2)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_truncated_segment_is_as_if_it_were_not_there(tmp_path, number):
    paths = write_journal(tmp_path, [2, 1, 1])
    whole = [path.read_bytes() for path in paths]
    # Anywhere in the middle one; the same code reads the others.
    for size in range(0, len(whole[number]), 1 if number == 1 else 9):
        for path, content in zip(paths, whole, strict=True):
            path.write_bytes(content)
        paths[number].write_bytes(whole[number][:size])
        with pytest.warns(CheckpointWarning, match=f"record {number + 1} is missing, damaged or"):
            assert_holds(journal_in(tmp_path).read(), [0, 2, 3][number])
        assert [path.exists() for path in paths] == [i < number for i in range(3)]


def test_every_altered_byte_is_noticed(tmp_path):
    paths = write_journal(tmp_path, [2, 1, 1])
    whole = [path.read_bytes() for path in paths]
    for number, content in enumerate(whole):
        for at in range(len(content)):
            damaged = bytearray(content)
            damaged[at] ^= 1 << at % 8
            paths[number].write_bytes(damaged)
            assert journal_in(tmp_path)._load(journal._Segment(paths[number], 0, 0)) is None
        paths[number].write_bytes(content)
        assert journal_in(tmp_path)._load(journal._Segment(paths[number], 0, 0)) is not None
    for number in (2, 1, 0):
        paths[number].write_bytes(whole[number][:-1] + b"?")
        with pytest.warns(CheckpointWarning):
            assert_holds(journal_in(tmp_path).read(), [0, 2, 3][number])


def test_a_damaged_journal_goes_on_as_if_it_had_always_been_whole(tmp_path):
    folder = write(tmp_path, [2, 1, 1])
    whole = {path.name: path.read_bytes() for path in segments_in(folder)}
    damaged = folder / "chain-0.2-2.segment"
    damaged.write_bytes(damaged.read_bytes()[:5])
    with open_checkpoint(tmp_path, SETTINGS) as checkpoint:
        with pytest.warns(CheckpointWarning) as caught:
            checkpoint.journal(0).read()
        folder = append_all(checkpoint.journal(0), [1], first=3)
    assert {path.name: path.read_bytes() for path in segments_in(folder)} == whole
    assert str(caught[0].message) == (
        f"{folder / damaged.name}: record 3 is missing, damaged or of another chain. It and all "
        f"later ones are removed; the chain resumes after record 2"
    )


def exchange(first, second):
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "n_left"),
    [
        (lambda paths: paths[0].unlink(), 0),
        (lambda paths: paths[1].unlink(), 2),
        (lambda paths: exchange(paths[0], paths[1]), 0),
        (lambda paths: exchange(paths[1], paths[2]), 2),
        (lambda paths: paths[2].write_bytes(paths[1].read_bytes()), 3),
        (lambda paths: paths[1].write_bytes(b"garbage" + paths[1].read_bytes()), 2),
        (lambda paths: paths[1].write_bytes(paths[1].read_bytes() + bytes(4096)), 2),
        (lambda paths: paths[0].write_bytes(bytes(paths[0].stat().st_size)), 0),
        (lambda paths: paths[2].with_name("chain-0.5-5.segment").touch(), 4),
    ],
)
def test_good_records_in_the_wrong_place_are_noticed(tmp_path, damage, n_left):
    damage(segments_in(write(tmp_path, [2, 1, 1])))
    with pytest.warns(CheckpointWarning):
        stored = read(tmp_path)
    assert_holds(stored, n_left)
    assert_holds(read(tmp_path), n_left)  # the warning comes once


def test_segments_of_another_chain_or_run_are_noticed(tmp_path):
    folder = write(tmp_path / "run", [2])
    other = write(tmp_path / "other", [2], SETTINGS | {"draws": 1001})
    content = (folder / "chain-0.0-0.segment").read_bytes()
    (folder / "chain-1.0-0.segment").write_bytes(content)
    (folder / "chain-0.0-0.segment").write_bytes((other / "chain-0.0-0.segment").read_bytes())
    for chain in range(2):
        with pytest.warns(CheckpointWarning, match="the chain begins anew"):
            assert read(tmp_path / "run", chain=chain) is None


def test_a_record_that_cannot_be_written_is_not_there(tmp_path, monkeypatch):
    write(tmp_path, [2])

    def full(descriptor):
        raise OSError(28, "No space left on device")

    with open_checkpoint(tmp_path, SETTINGS) as checkpoint:
        stored = checkpoint.journal(0)
        stored.read()
        with monkeypatch.context() as disk:
            disk.setattr(journal.os, "fsync", full)
            message = (
                r"chain-0: record 2 of the chain cannot be written \(No space left on device\)"
            )
            with pytest.raises(CheckpointError, match=message) as caught:
                append_all(stored, [50], first=2)
            assert "The 1 before it are kept" in str(caught.value)
            assert str(tmp_path) in str(caught.value)
        folder = append_all(stored, [1], first=2)
        assert len(list(folder.iterdir())) == 2
    assert_holds(read(tmp_path), 3)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_folder_in_the_place_of_a_record_is_named(tmp_path, number):
    folder = write(tmp_path, [2, 1, 3])
    path = folder / f"chain-0.{number}-{number}.segment"
    content = path.read_bytes()
    path.unlink()
    path.mkdir()
    message = rf"{path.name}: record {number + 1} of the chain cannot be read \({IS_FOLDER}\)"
    with open_checkpoint(tmp_path, SETTINGS) as checkpoint:
        with pytest.raises(CheckpointError, match=message):
            checkpoint.journal(0).read()
    (path,) = tmp_path.rglob(path.name)  # in the subfolder of the last job
    path.rmdir()
    path.write_bytes(content)
    assert_holds(read(tmp_path), 6)


@pytest.mark.parametrize("name", ["run.json", "run.json.unfinished", "lease.x"])
def test_a_folder_in_the_place_of_another_file_is_named(tmp_path, name):
    (tmp_path / name).mkdir()
    message = rf"cannot be written to \({IS_FOLDER} at {name}\)"
    with pytest.raises(ModelError, match=message):
        open_checkpoint(tmp_path, SETTINGS)


def test_other_arguments_are_named_with_both_values(tmp_path):
    write(tmp_path, [2])
    settings = {"draws": 2000, "chains": 2, "model": "77aa", "stages": [2, 1], "cores": 1}
    with pytest.raises(DataMismatchError) as caught:
        open_checkpoint(tmp_path, settings)
    assert str(caught.value) == (
        f"checkpoint={str(tmp_path)!r} is of another run: "
        "draws: the checkpoint has 1000, this run has 2000; "
        'model: the checkpoint has "5f2c", this run has "77aa"; '
        "step: the checkpoint has null, this run has nothing; "
        "cores: the checkpoint has nothing, this run has 1; "
        "delete the folder or give another path"
    )
    assert_holds(read(tmp_path), 2)  # nothing is lost, and the folder is free again


@pytest.mark.parametrize("value", [0.1 + 0.2, float("nan"), (1, 2), {"b": 1, "a": None}, "ü"])
def test_equal_arguments_are_equal_after_a_round_trip(tmp_path, value):
    open_checkpoint(tmp_path, {"it": value, "more": 1}).close()
    open_checkpoint(tmp_path, {"more": 1, "it": value}).close()


@pytest.mark.parametrize(("one", "other"), [(1, 1.0), (1, True), (0.1 + 0.2, 0.3), (None, 0)])
def test_arguments_of_another_type_are_others(tmp_path, one, other):
    open_checkpoint(tmp_path, {"it": one}).close()
    with pytest.raises(DataMismatchError, match="it: the checkpoint has"):
        open_checkpoint(tmp_path, {"it": other})


def test_long_arguments_are_shortened_in_the_message(tmp_path):
    open_checkpoint(tmp_path, {"start": [0] * 10_000}).close()
    with pytest.raises(DataMismatchError) as caught:
        open_checkpoint(tmp_path, {"start": [1] * 10_000})
    assert len(str(caught.value)) < 500


def test_every_altered_byte_and_truncation_of_the_manifest_is_noticed(tmp_path):
    open_checkpoint(tmp_path, SETTINGS).close()
    path = tmp_path / "run.json"
    whole = path.read_bytes()
    altered = [bytes(whole[:i]) + bytes([whole[i] ^ 1]) + whole[i + 1 :] for i in range(len(whole))]
    for damaged in [*altered, *(whole[:i] for i in range(len(whole)))]:
        path.write_bytes(damaged)
        with pytest.raises(ModelError, match=r"damaged|another version"):
            open_checkpoint(tmp_path, SETTINGS)
    path.write_bytes(whole)
    open_checkpoint(tmp_path, SETTINGS).close()


def test_another_version_is_refused(tmp_path):
    open_checkpoint(tmp_path, SETTINGS).close()
    path = tmp_path / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version": 7}))
    with pytest.raises(ModelError, match="has the format 7 of another version of this package"):
        open_checkpoint(tmp_path, SETTINGS)


def test_folders_that_are_no_checkpoints_are_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(ModelError, match=r"not a checkpoint: it holds thesis.tex but no run.json"):
        open_checkpoint(tmp_path, SETTINGS)
    (tmp_path / "run.json").write_text('{"name": "something else"}')
    with pytest.raises(ModelError, match="damaged or not of a checkpoint"):
        open_checkpoint(tmp_path, SETTINGS)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.json", "thesis.tex"]


def test_paths_that_cannot_be_folders_are_refused(tmp_path):
    file = tmp_path / "draws.nc"
    file.write_text("x")
    with pytest.raises(ModelError, match=r"draws.nc' is a file: expected a folder"):
        open_checkpoint(file, SETTINGS)
    with pytest.raises(ModelError, match=INSIDE_FILE):
        open_checkpoint(file / "inside", SETTINGS)


@pytest.mark.skipif(getattr(os, "geteuid", lambda: 0)() == 0, reason="root may write anywhere")
def test_a_folder_that_is_read_only_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(ModelError, match=r"cannot be written to \(Permission denied\)"):
        open_checkpoint(tmp_path, SETTINGS)


def test_a_folder_is_one_checkpoint_at_a_time(tmp_path):
    with (
        open_checkpoint(tmp_path, SETTINGS),
        pytest.raises(ModelError, match="in use by this process already"),
    ):
        open_checkpoint(tmp_path, SETTINGS)
    open_checkpoint(tmp_path, SETTINGS).close()


def in_another_process(script, *arguments):
    return subprocess.Popen(
        [sys.executable, "-c", script, *arguments],
        cwd=Path(__file__).parents[2],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


# A run that is killed before or after a call that touches the disk, each in turn; then taken up
# again, and killed again a few calls later, until it is done.
KILLED_RUNS = f"""
import os, sys, warnings
from pathlib import Path
import numpy as np
{WITHOUT_PYMC}
"""
KILLED_RUNS += """
from pymc_statespace_filters.sampling.checkpoint import checkpoint, journal, lease

journal._FAN_IN = int(sys.argv[2])
lease.sleep = lambda seconds: None  # a lease without the name of its owner is watched
calls, fatal = 0, 0

def count():
    global calls
    calls += 1
    if calls == fatal:
        os.kill(os.getpid(), 9)

def counted(function):
    def call(*args, **kwargs):
        count()
        result = function(*args, **kwargs)
        count()
        return result
    return call

class TornFile:
    def __init__(self, file):
        self.file = file
    def __getattr__(self, name):
        return getattr(self.file, name)
    def __enter__(self):
        return self
    def __exit__(self, *error):
        self.file.close()
    def write(self, content):
        content = bytes(content)
        for part in (content[: len(content) // 2], content[len(content) // 2 :]):
            count()
            self.file.write(part)
            self.file.flush()

os.fsync = lambda descriptor: None  # a kill loses nothing that was written
for name in ("open", "close", "fsync", "rename", "replace", "unlink", "mkdir", "rmdir"):
    setattr(os, name, counted(getattr(os, name)))
journal.open = lambda *args: TornFile(open(*args))

def run(folder):
    with checkpoint.open_checkpoint(folder, {"draws": 6}) as opened:
        chain = opened.journal(0)
        stored = chain.read()
        n = 0
        if stored is not None:
            n = len(stored.draws["x"])
            assert np.array_equal(stored.draws["x"], np.arange(n))
            assert stored.state["sum"] == n * (n - 1) // 2
        while n < 6:
            n += 2
            chain.append({"x": np.arange(n - 2, n)}, {"sum": np.array(n * (n - 1) // 2)})

def killed(folder, at):
    global fatal
    child = os.fork()
    if child == 0:
        fatal = at
        try:
            run(folder)
        except BaseException:
            sys.excepthook(*sys.exc_info())
            os._exit(1)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0
    return os.WIFSIGNALED(status)

warnings.simplefilter("ignore")  # of what is torn
root = Path(sys.argv[1])

def segments(folder):
    (chains,) = folder.glob("chains.*")
    assert {p.name for p in folder.iterdir()} == {chains.name, "run.json"}
    return {p.name: p.read_bytes() for p in chains.iterdir()}

run(root / "whole")
n_calls, whole = calls, segments(root / "whole")
for at in range(1, n_calls + 1):
    folder = root / str(at)
    calls = 0
    assert killed(folder, at)
    again = 41
    while killed(folder, again):  # each time a little later, or it might never come further
        again += 11
    assert segments(folder) == whole
print(n_calls)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork, no kill -9")
def test_a_run_killed_at_any_call_ends_as_if_it_had_not_been(tmp_path):
    """Of its six draws four are merged."""
    with in_another_process(KILLED_RUNS, str(tmp_path), "2") as process:
        output, errors = process.communicate(timeout=LIMIT)
    assert process.returncode == 0, errors
    assert int(output) > 60  # so many places to die
