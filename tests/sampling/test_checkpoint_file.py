"""The file of a checkpoint: what survives a kill, what is noticed, and what is said."""

import itertools
import os
import subprocess
import sys
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from pymc_statespace_filters.errors import (
    CheckpointError,
    CheckpointWarning,
    DataMismatchError,
    ModelError,
)
from pymc_statespace_filters.sampling.checkpoint import record_file
from pymc_statespace_filters.sampling.checkpoint.checkpoint import open_checkpoint
from tests.sampling.alone import WITHOUT_PYMC
from tests.waiting import LIMIT

# Windows has no words of its own for these.
IS_FOLDER = "Permission denied" if os.name == "nt" else "Is a directory"
INSIDE_FILE = r"inside' cannot be written to \(Not a directory\)"
if os.name == "nt":
    INSIDE_FILE = "draws.nc' is a file: expected a folder"

SETTINGS = {"draws": 1000, "chains": 2, "model": "5f2c", "stages": [2, 1], "step": None}
KEY = "chain 0"


def draws_of(first, n):
    """Draws that tell which they are."""
    number = np.arange(first, first + n)
    return {"x": number[:, None] + np.array([0.0, 0.25]), "moved": number % 2 == 0}


def state_of(iteration):
    return {
        "rng": np.array([2**64 - 1, iteration], dtype=np.uint64),
        "nothing": np.zeros((0, 3)),
    }


def append_all(checkpoint, sizes, first=0, key=KEY):
    """Write records of these numbers of draws."""
    for size in sizes:
        checkpoint.append(key, draws_of(first, size), state_of(first + size))
        first += size


def write(folder, sizes, settings=SETTINGS, key=KEY):
    """Write records; the file, and where each begins and the last ends."""
    ends = []
    with open_checkpoint(folder, settings) as checkpoint:
        path = folder / "run.checkpoint"
        for i, size in enumerate(sizes):
            ends.append(path.stat().st_size)
            append_all(checkpoint, [size], sum(sizes[:i]), key)
    return path, [*ends, path.stat().st_size]


def read(folder, settings=SETTINGS, key=KEY):
    with open_checkpoint(folder, settings) as checkpoint:
        return checkpoint.read(key)


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


def test_a_checkpoint_gives_back_all_draws_and_the_last_state(tmp_path):
    write(tmp_path / "run", [3, 0, 1, 5])
    assert_holds(read(tmp_path / "run"), 9)
    assert {path.name for path in (tmp_path / "run").iterdir()} == {
        "run.checkpoint", "run.lock", "run.owner",
    }  # fmt: skip


def test_a_checkpoint_goes_on_whether_it_is_read_or_not(tmp_path):
    write(tmp_path, [3])
    with open_checkpoint(tmp_path, SETTINGS) as checkpoint:
        append_all(checkpoint, [2], first=3)
        assert_holds(checkpoint.read(KEY), 5)
        append_all(checkpoint, [1], first=5)
    assert_holds(read(tmp_path), 6)


def test_several_threads_write_to_it(tmp_path):
    keys = [f"chain {i}" for i in range(4)]
    with open_checkpoint(tmp_path, SETTINGS) as checkpoint:
        threads = [
            Thread(target=append_all, args=(checkpoint, [7] * 20), kwargs={"key": key})
            for key in keys
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(LIMIT)
    for key in keys:
        assert_holds(read(tmp_path, key=key), 140)


def test_arrays_of_any_layout_are_kept_bit_for_bit(tmp_path):
    square = np.arange(6.0).reshape(2, 3)
    draws = {
        "columns": np.asfortranarray(square),
        "every second": np.arange(4)[::2],
        "big-endian": np.array([1.5, -0.0], dtype=">f8"),
        "special": np.array([np.nan, -np.inf]),
    }
    state = {"number": np.array(3), "square": square.T, "flag": np.True_}
    with open_checkpoint(tmp_path, {}) as checkpoint:
        checkpoint.append(KEY, draws, state)
    stored = read(tmp_path, {})
    same(stored.draws, draws | {"big-endian": np.array([1.5, -0.0])})
    same(stored.state, state)


def test_python_objects_are_refused(tmp_path):
    with open_checkpoint(tmp_path, {}) as checkpoint:
        with pytest.raises(ValueError, match="arrays of Python objects cannot be stored"):
            checkpoint.append(KEY, {"cause": np.array([None])}, {})
        assert checkpoint.read(KEY) is None


def test_a_record_costs_its_own_length_alone(tmp_path):
    _, ends = write(tmp_path, [7] * 5)
    assert len(set(np.diff(ends))) == 1


@pytest.fixture
def states_are_many(monkeypatch):
    monkeypatch.setattr(record_file, "_MAX_OLD_STATES", 40_000)


@pytest.mark.usefixtures("states_are_many")
def test_old_states_do_not_fill_the_disk(tmp_path, monkeypatch):
    """A chain that carries its noise has a state of megabytes, each few seconds."""
    written, flush = [], record_file._flush
    monkeypatch.setattr(
        record_file, "_flush", lambda file: (written.append(file.tell()), flush(file))
    )
    with open_checkpoint(tmp_path, SETTINGS) as checkpoint:
        append_all(checkpoint, [4, 3], key="chain 1")
        before = len(written)
        for i in range(60):
            checkpoint.append(KEY, draws_of(10 * i, 10), {"noise": np.full(1250, float(i))})
            assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 100_000
        draws, state = checkpoint.read(KEY)
    assert len(written) - before < 60 + 15  # times that the file was written anew
    same(draws, draws_of(0, 600))
    np.testing.assert_array_equal(state["noise"], 59.0)
    same(read(tmp_path).draws, draws)
    assert_holds(read(tmp_path, key="chain 1"), 7)


@pytest.mark.usefixtures("states_are_many")
def test_what_is_damaged_after_it_was_written_is_an_error(tmp_path):
    """Also where the file is to be written anew: nothing is lost by that."""
    with open_checkpoint(tmp_path, SETTINGS) as checkpoint:
        append_all(checkpoint, [2, 1])
        path = tmp_path / "run.checkpoint"
        content = bytearray(path.read_bytes())
        content[-1] ^= 1
        path.write_bytes(content)
        message = r"run\.checkpoint: record 2 was damaged after it had been written"
        with pytest.raises(CheckpointError, match=message):
            checkpoint.read(KEY)
        for _ in range(7):
            checkpoint.append("chain 1", {}, {"noise": np.zeros(1250)})
        with pytest.raises(CheckpointError, match=message):
            checkpoint.append("chain 1", {}, {"noise": np.zeros(1250)})
    with pytest.warns(CheckpointWarning, match="record 2 is torn or damaged"):
        assert_holds(read(tmp_path), 2)


def test_a_file_that_is_torn_anywhere_goes_on_from_the_record_before(tmp_path):
    path, ends = write(tmp_path, [2, 1, 1])
    whole = path.read_bytes()
    for size in set(range(ends[0], ends[-1], 5)) - set(ends):
        path.write_bytes(whole[:size])
        n_left = sum(end < size for end in ends[1:])
        message = f"record {n_left + 1} is torn or damaged"
        with pytest.warns(CheckpointWarning, match=message):
            assert_holds(read(tmp_path), [0, 2, 3][n_left])
        with open_checkpoint(tmp_path, SETTINGS) as checkpoint:  # the warning comes once
            append_all(checkpoint, [2, 1, 1][n_left:], [0, 2, 3][n_left])
        assert path.read_bytes() == whole


def test_every_altered_byte_is_noticed(tmp_path):
    path, ends = write(tmp_path, [2, 1, 1])
    whole = path.read_bytes()
    for at in range(ends[0], len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ (1 << at % 8)]) + whole[at + 1 :])
        with pytest.warns(CheckpointWarning):
            assert_holds(read(tmp_path), [0, 2, 3][sum(end <= at for end in ends[1:])])
    for at in range(ends[0]):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises(ModelError, match=r"damaged|another version"):
            read(tmp_path, SETTINGS)
        path.write_bytes(whole[:at])
        with pytest.raises(ModelError, match=r"damaged|another version"):
            read(tmp_path, SETTINGS)
    path.write_bytes(whole)
    assert_holds(read(tmp_path), 4)


@pytest.mark.parametrize(
    ("damage", "n_left"),
    [
        (lambda head, a, b, c: head + b + c, 0),
        (lambda head, a, b, c: head + a + c, 2),
        (lambda head, a, b, c: head + b + a + c, 0),
        (lambda head, a, b, c: head + a + c + b, 2),
        (lambda head, a, b, c: head + a + b + b, 3),
        (lambda head, a, b, c: head + a + b"garbage" + b + c, 2),
        (lambda head, a, b, c: head + a + b + c + bytes(4096), 4),
        (lambda head, a, b, c: head + bytes(len(a)) + b + c, 0),
    ],
)
def test_good_records_in_the_wrong_place_are_noticed(tmp_path, damage, n_left):
    path, ends = write(tmp_path, [2, 1, 1])
    whole = path.read_bytes()
    path.write_bytes(damage(*(whole[i:j] for i, j in itertools.pairwise([0, *ends]))))
    with pytest.warns(CheckpointWarning):
        assert_holds(read(tmp_path), n_left)
    assert_holds(read(tmp_path), n_left)


def test_a_record_of_another_run_is_noticed(tmp_path):
    path, (begin, _) = write(tmp_path / "run", [2])
    other, (other_begin, _) = write(tmp_path / "other", [2], SETTINGS | {"draws": 1001})
    path.write_bytes(path.read_bytes()[:begin] + other.read_bytes()[other_begin:])
    with pytest.warns(CheckpointWarning) as caught:
        assert_holds(read(tmp_path / "run"), 0)
    assert str(caught[0].message) == (
        f"{path}: record 1 is torn or damaged. It and all later ones are removed; the run begins "
        "anew"
    )


@pytest.mark.parametrize(
    ("error", "caught"),
    [(OSError(28, "No space left on device"), CheckpointError), (KeyboardInterrupt(), None)],
)
def test_a_record_that_cannot_be_written_is_not_there(tmp_path, monkeypatch, error, caught):
    path, (*_, end) = write(tmp_path, [2])

    def full(descriptor):
        raise error

    with open_checkpoint(tmp_path, SETTINGS) as checkpoint:
        with monkeypatch.context() as disk:
            disk.setattr(record_file.os, "fsync", full)
            with pytest.raises(caught or type(error)) as raised:
                append_all(checkpoint, [50], first=2)
        assert path.stat().st_size == end
        append_all(checkpoint, [1], first=2)
    if caught is not None:
        assert str(raised.value) == (
            f"{path}: record 2 cannot be written (No space left on device). The 1 before it are "
            "kept: when that is mended, the same call resumes after them"
        )
    assert_holds(read(tmp_path), 3)


def test_a_file_that_another_process_has_touched_is_left_alone(tmp_path):
    """As on a file system without locks: neither writes over what the other has stored."""
    path, _ = write(tmp_path, [2])
    with open_checkpoint(tmp_path, SETTINGS) as checkpoint:
        other = record_file.RecordFile(path, record_file.header_of(path))
        other.append(KEY, draws_of(2, 1), state_of(3))
        with pytest.raises(CheckpointError, match="another process has written to this file"):
            append_all(checkpoint, [1], first=2)
        path.unlink()
        with pytest.raises(CheckpointError, match=r"run\.checkpoint is gone: it was moved or"):
            other.append(KEY, draws_of(3, 1), state_of(4))


@pytest.mark.parametrize("name", ["run.checkpoint", "run.unfinished", "run.owner"])
def test_a_folder_in_the_place_of_a_file_is_named(tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(ModelError, match=rf"cannot be written to \({IS_FOLDER} at {name}\)"):
        read(tmp_path, SETTINGS)


def test_other_arguments_are_named_with_both_values(tmp_path):
    write(tmp_path, [2])
    settings = {"draws": 2000, "chains": 2, "model": "77aa", "stages": [2, 1], "cores": 1}
    with pytest.raises(DataMismatchError) as caught:
        read(tmp_path, settings)
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
    read(tmp_path, {"it": value, "more": 1})
    read(tmp_path, {"more": 1, "it": value})


@pytest.mark.parametrize(("one", "other"), [(1, 1.0), (1, True), (0.1 + 0.2, 0.3), (None, 0)])
def test_arguments_of_another_type_are_others(tmp_path, one, other):
    read(tmp_path, {"it": one})
    with pytest.raises(DataMismatchError, match="it: the checkpoint has"):
        read(tmp_path, {"it": other})


def test_long_arguments_are_shortened_in_the_message(tmp_path):
    read(tmp_path, {"start": [0] * 10_000})
    with pytest.raises(DataMismatchError) as caught:
        read(tmp_path, {"start": [1] * 10_000})
    assert len(str(caught.value)) < 500


def test_another_version_is_refused(tmp_path):
    path, _ = write(tmp_path, [])
    path.write_bytes(path.read_bytes().replace(b"checkpoint 3", b"checkpoint 7"))
    with pytest.raises(ModelError, match="has the format 7 of another version of this package"):
        read(tmp_path, SETTINGS)


def test_another_file_of_that_name_is_refused_and_left_alone(tmp_path):
    (tmp_path / "run.checkpoint").write_text("something else", encoding="utf-8")
    with pytest.raises(ModelError, match=r"its run\.checkpoint is damaged or not of a checkpoint"):
        read(tmp_path, SETTINGS)
    assert (tmp_path / "run.checkpoint").read_text(encoding="utf-8") == "something else"


def test_paths_that_cannot_be_folders_are_refused(tmp_path):
    file = tmp_path / "draws.nc"
    file.write_text("x", encoding="utf-8")
    with pytest.raises(ModelError, match=r"draws.nc' is a file: expected a folder"):
        read(file, SETTINGS)
    with pytest.raises(ModelError, match=INSIDE_FILE):
        read(file / "inside", SETTINGS)


@pytest.mark.skipif(getattr(os, "geteuid", lambda: 0)() == 0, reason="root may write anywhere")
def test_a_folder_that_is_read_only_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(ModelError, match=r"cannot be written to \(Permission denied"):
        read(tmp_path, SETTINGS)


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
from pymc_statespace_filters.sampling.checkpoint import checkpoint, record_file

record_file._MAX_OLD_STATES = int(sys.argv[2])
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
record_file.open = lambda *args: TornFile(open(*args))

def run(folder):
    with checkpoint.open_checkpoint(folder, {"draws": 6}) as opened:
        stored = opened.read("chain 0")
        n = 0
        if stored is not None:
            n = len(stored.draws["x"])
            assert np.array_equal(stored.draws["x"], np.arange(n))
            assert stored.state["sum"] == n * (n - 1) // 2
        while n < 6:
            n += 2
            sums = {"sum": np.array(n * (n - 1) // 2)}
            opened.append("chain 0", {"x": np.arange(n - 2, n)}, sums)

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

def file_in(folder):
    return (folder / "run.checkpoint").read_bytes()

run(root / "whole")
n_calls, whole = calls, file_in(root / "whole")
for at in range(1, n_calls + 1):
    folder = root / str(at)
    calls = 0
    assert killed(folder, at)
    again = 41
    while killed(folder, again):  # each time a little later, or it might never come further
        again += 11
    assert file_in(folder) == whole
print(n_calls)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork, no kill -9")
@pytest.mark.parametrize("most_old_states", [10**6, -1000])
def test_a_run_killed_at_any_call_ends_as_if_it_had_not_been(tmp_path, most_old_states):
    """Also where the file is written anew on the way."""
    with in_another_process(KILLED_RUNS, str(tmp_path), str(most_old_states)) as process:
        output, errors = process.communicate(timeout=LIMIT)
    assert process.returncode == 0, errors
    assert int(output) > 20  # so many places to die
