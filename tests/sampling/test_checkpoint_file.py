"""The folder of a checkpoint and its logs: what survives a kill, and what is noticed."""

import json
import os
import subprocess
import sys
import warnings
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pymc_statespace_filters.errors import CheckpointWarning, DataMismatchError, ModelError
from pymc_statespace_filters.sampling.checkpoint import journal as chain_log
from pymc_statespace_filters.sampling.checkpoint.checkpoint import open_checkpoint
from pymc_statespace_filters.sampling.checkpoint.journal import ChainLog

ASKED = {"draws": 1000, "chains": 2, "model": "5f2c", "stages": [2, 1], "step": None}


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


def append_all(log, sizes):
    """Write records of these numbers of draws; give the file, and its length after each."""
    lengths, n = [], 0
    for size in sizes:
        log.append(draws_of(n, size), state_of(n + size))
        n += size
        lengths.append(log.path.stat().st_size)
    return log.path, lengths


def write_log(path, sizes):
    with closing(ChainLog(path, b"a run")) as log:
        return append_all(log, sizes)


def read_log(path):
    with closing(ChainLog(path, b"a run")) as log:
        return log.read()


def write(folder, sizes, asked=ASKED, chain=0):
    with open_checkpoint(folder, asked) as checkpoint:
        return append_all(checkpoint.log(chain), sizes)


def read(folder, asked=ASKED, chain=0):
    with open_checkpoint(folder, asked) as checkpoint:
        return checkpoint.log(chain).read()


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


def test_log_gives_back_all_draws_and_the_last_state(tmp_path):
    write(tmp_path / "run", [3, 0, 1, 5])
    assert_holds(read(tmp_path / "run"), 9)


def test_log_goes_on_in_another_process_without_being_read(tmp_path):
    write(tmp_path, [3])
    with open_checkpoint(tmp_path, ASKED) as checkpoint:
        checkpoint.log(0).append(draws_of(3, 2), state_of(5))
        assert_holds(checkpoint.log(0).read(), 5)
        checkpoint.log(0).append(draws_of(5, 1), state_of(6))
    assert_holds(read(tmp_path), 6)


def test_log_takes_arrays_of_any_layout_bit_for_bit(tmp_path):
    square = np.arange(6.0).reshape(2, 3)
    draws = {
        "columns": np.asfortranarray(square),
        "every second": np.arange(4)[::2],
        "big-endian": np.array([1.5, -0.0], dtype=">f8"),
        "special": np.array([np.nan, -np.inf]),
    }
    state = {"number": np.array(3), "square": square.T, "flag": np.True_}
    with open_checkpoint(tmp_path, {}) as checkpoint:
        checkpoint.log(0).append(draws, state)
    stored = read(tmp_path, {})
    same(stored.draws, draws | {"big-endian": np.array([1.5, -0.0])})
    same(stored.state, state)


def test_log_refuses_what_is_not_numbers(tmp_path):
    with open_checkpoint(tmp_path, {}) as checkpoint:
        log = checkpoint.log(0)
        with pytest.raises(TypeError, match="cause: a log holds numbers and booleans, got object"):
            log.append({"cause": np.array([None])}, {})
        assert log.read() is None


def test_a_record_costs_its_own_length_alone(tmp_path):
    _, lengths = write(tmp_path, [7] * 5)
    assert len(set(np.diff(lengths, prepend=0))) == 1


def test_overtaken_states_do_not_fill_the_disk(tmp_path, monkeypatch):
    """A chain that carries its noise has a state of megabytes, each few seconds."""
    monkeypatch.setattr(chain_log, "_SPARE", 100_000)
    path = tmp_path / "log"
    with closing(ChainLog(path, b"a run")) as log:
        for i in range(60):
            log.append(draws_of(10 * i, 10), {"noise": np.full(1250, float(i))})
            assert path.stat().st_size < 150_000
        draws, state = log.read()
    same(draws, draws_of(0, 600))
    np.testing.assert_array_equal(state["noise"], 59.0)
    same(read_log(path).draws, draws)
    assert [p.name for p in tmp_path.iterdir()] == ["log"]


def test_every_truncation_gives_the_records_before_it(tmp_path):
    path, lengths = write_log(tmp_path / "log", [2, 1, 1])
    whole, counts = path.read_bytes(), [0, 2, 3, 4]
    for size in range(len(whole) + 1):
        path.write_bytes(whole[:size])
        n_good = sum(length <= size for length in lengths)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            stored = read_log(path)
        assert_holds(stored, counts[n_good])
        at_a_record = size in [0, *lengths]
        assert len(caught) == (not at_a_record)
        assert path.stat().st_size == [0, *lengths][n_good]


def test_every_altered_byte_cuts_the_log_at_its_record(tmp_path):
    path, lengths = write_log(tmp_path / "log", [2, 1, 1])
    whole, counts = path.read_bytes(), [0, 2, 3, 4]
    for at in range(len(whole)):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << at % 8
        path.write_bytes(damaged)
        n_good = sum(length <= at for length in lengths)
        with pytest.warns(CheckpointWarning, match=f"record {n_good + 1}, at byte"):
            stored = read_log(path)
        assert_holds(stored, counts[n_good])


def test_a_cut_log_goes_on_as_if_it_had_never_been_torn(tmp_path):
    path, lengths = write(tmp_path, [2, 1, 1])
    whole = path.read_bytes()
    path.write_bytes(whole[: lengths[1] + 5])
    with open_checkpoint(tmp_path, ASKED) as checkpoint:
        with pytest.warns(CheckpointWarning) as caught:
            checkpoint.log(0).read()
        checkpoint.log(0).append(draws_of(3, 1), state_of(4))
    assert path.read_bytes() == whole
    assert str(caught[0].message) == (
        f"{path}: record 3, at byte {lengths[1]}, is torn or damaged. The last 5 bytes are lost "
        f"and cut off; the chain goes on from record 2"
    )


def exchanged(whole, ends):
    return whole[: ends[0]] + whole[ends[1] : ends[2]] + whole[ends[0] : ends[1]]


@pytest.mark.parametrize(
    ("damage", "n_left"),
    [
        (lambda whole, ends: b"garbage" + whole, 0),
        (lambda whole, ends: whole[ends[0] :], 0),  # the first record is gone
        (lambda whole, ends: whole[: ends[0]] + whole[ends[1] :], 2),  # the second is
        (lambda whole, ends: whole[: ends[1]] + whole[ends[0] :], 3),  # it is there twice
        (exchanged, 2),
        (lambda whole, ends: whole[: ends[0]] + b"?" + whole[ends[0] :], 2),
        (lambda whole, ends: whole + bytes(4096), 4),  # as some file systems leave it
        (lambda whole, ends: bytes(len(whole)), 0),
    ],
)
def test_good_records_in_the_wrong_place_are_noticed(tmp_path, damage, n_left):
    path, lengths = write(tmp_path, [2, 1, 1])
    path.write_bytes(damage(path.read_bytes(), lengths))
    with pytest.warns(CheckpointWarning):
        stored = read(tmp_path)
    assert_holds(stored, n_left)


def test_logs_of_another_chain_or_run_are_noticed(tmp_path):
    path, _ = write(tmp_path / "run", [2])
    other, _ = write(tmp_path / "other", [2], ASKED | {"draws": 1001})
    (tmp_path / "run" / "chain-1.log").write_bytes(path.read_bytes())
    with pytest.warns(CheckpointWarning, match="the chain begins anew"):
        assert read(tmp_path / "run", chain=1) is None
    path.write_bytes(other.read_bytes())
    with pytest.warns(CheckpointWarning):
        assert read(tmp_path / "run") is None


def test_a_record_that_cannot_be_written_is_taken_back(tmp_path, monkeypatch):
    path, lengths = write(tmp_path, [2])

    def full(descriptor):
        raise OSError(28, "No space left on device")

    with open_checkpoint(tmp_path, ASKED) as checkpoint:
        log = checkpoint.log(0)
        with monkeypatch.context() as disk:
            disk.setattr(chain_log.os, "fsync", full)
            with pytest.raises(OSError, match="No space left"):
                log.append(draws_of(2, 50), state_of(52))
        assert path.stat().st_size == lengths[0]
        log.append(draws_of(2, 1), state_of(3))
    assert_holds(read(tmp_path), 3)


def test_other_arguments_are_named_with_both_values(tmp_path):
    write(tmp_path, [2])
    asked = {"draws": 2000, "chains": 2, "model": "77aa", "stages": [2, 1], "cores": 1}
    with pytest.raises(DataMismatchError) as caught:
        open_checkpoint(tmp_path, asked)
    assert str(caught.value) == (
        f"checkpoint={str(tmp_path)!r} is of another run: "
        "draws: the checkpoint has 1000, asked for 2000; "
        'model: the checkpoint has "5f2c", asked for "77aa"; '
        "step: the checkpoint has null, asked for nothing; "
        "cores: the checkpoint has nothing, asked for 1; "
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


def test_every_altered_byte_and_truncation_of_what_was_asked_is_noticed(tmp_path):
    open_checkpoint(tmp_path, ASKED).close()
    path = tmp_path / "run.json"
    whole = path.read_bytes()
    altered = [bytes(whole[:i]) + bytes([whole[i] ^ 1]) + whole[i + 1 :] for i in range(len(whole))]
    for damaged in [*altered, *(whole[:i] for i in range(len(whole)))]:
        path.write_bytes(damaged)
        with pytest.raises(ModelError, match=r"damaged|newer version"):
            open_checkpoint(tmp_path, ASKED)
    path.write_bytes(whole)
    open_checkpoint(tmp_path, ASKED).close()


def test_a_version_from_the_future_is_refused(tmp_path):
    open_checkpoint(tmp_path, ASKED).close()
    path = tmp_path / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version": 7}))
    with pytest.raises(ModelError, match="has the format 7, of a newer version of this package"):
        open_checkpoint(tmp_path, ASKED)


def test_folders_that_are_no_checkpoints_are_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(ModelError, match=r"not a checkpoint: it holds thesis.tex but no run.json"):
        open_checkpoint(tmp_path, ASKED)
    (tmp_path / "run.json").write_text('{"name": "something else"}')
    with pytest.raises(ModelError, match="damaged or not of a checkpoint"):
        open_checkpoint(tmp_path, ASKED)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.json", "thesis.tex"]


def test_paths_that_cannot_be_folders_are_refused(tmp_path):
    file = tmp_path / "draws.nc"
    file.write_text("x")
    with pytest.raises(ModelError, match=r"draws.nc' is a file: expected a folder"):
        open_checkpoint(file, ASKED)
    with pytest.raises(ModelError, match=r"inside' cannot be written to \(Not a directory\)"):
        open_checkpoint(file / "inside", ASKED)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_is_read_only_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(ModelError, match=r"cannot be written to \(Permission denied\)"):
        open_checkpoint(tmp_path, ASKED)


def test_a_folder_is_one_checkpoint_at_a_time(tmp_path):
    with (
        open_checkpoint(tmp_path, ASKED),
        pytest.raises(ModelError, match="in use by this process already"),
    ):
        open_checkpoint(tmp_path, ASKED)
    open_checkpoint(tmp_path, ASKED).close()


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
KILLED_RUNS = """
import os, sys, types, warnings
from pathlib import Path
import numpy as np

# Without PyMC, which takes seconds to import and to fork.
for name in (
    "pymc_statespace_filters",
    "pymc_statespace_filters.sampling",
    "pymc_statespace_filters.sampling.checkpoint",
):
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = [name.replace(".", "/")]
from pymc_statespace_filters.sampling.checkpoint import checkpoint
from pymc_statespace_filters.sampling.checkpoint import journal as chain_log

chain_log._SPARE = int(sys.argv[2])
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
    def writelines(self, pieces):
        for piece in pieces:
            piece = bytes(piece)
            for part in (piece[: len(piece) // 2], piece[len(piece) // 2 :]):
                count()
                self.file.write(part)
                self.file.flush()
    def truncate(self, size):
        counted(self.file.truncate)(size)

os.fsync = lambda descriptor: None  # a kill loses nothing that was written
for name in ("open", "close", "fsync", "replace", "unlink", "mkdir", "truncate"):
    setattr(os, name, counted(getattr(os, name)))
fdopen = os.fdopen
os.fdopen = lambda *args: TornFile(fdopen(*args))

def run(folder):
    with checkpoint.open_checkpoint(folder, {"draws": 6}) as opened:
        log = opened.log(0)
        stored = log.read()
        n = 0
        if stored is not None:
            n = len(stored.draws["x"])
            assert np.array_equal(stored.draws["x"], np.arange(n))
            assert stored.state["sum"] == n * (n - 1) // 2
        while n < 6:
            n += 2
            log.append({"x": np.arange(n - 2, n)}, {"sum": np.array(n * (n - 1) // 2)})

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
run(root / "whole")
n_calls, whole = calls, (root / "whole" / "chain-0.log").read_bytes()
for at in range(1, n_calls + 1):
    folder = root / str(at)
    calls = 0
    assert killed(folder, at)
    again = 41
    while killed(folder, again):  # each time a little later, or it might never come further
        again += 11
    assert (folder / "chain-0.log").read_bytes() == whole
    assert sorted(p.name for p in folder.iterdir()) == ["chain-0.log", "run.json"]
print(n_calls)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork, no kill -9")
@pytest.mark.parametrize("spare", [10_000, -40], ids=["growing", "compacted"])
def test_a_run_killed_at_any_call_ends_as_if_it_had_not_been(tmp_path, spare):
    with in_another_process(KILLED_RUNS, str(tmp_path), str(spare)) as process:
        output, errors = process.communicate()
    assert process.returncode == 0, errors
    assert int(output) > 60  # so many places to die
