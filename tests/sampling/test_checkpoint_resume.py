"""Runs that are killed and called again: the same draws as of a run that was not."""

import itertools
import os
import warnings

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import CheckpointWarning, DataMismatchError
from pymc_statespace_filters.sampling.run import chain_task
from pymc_statespace_filters.sampling.run.thread_pool import ChainPool
from tests.interrupts import interrupt
from tests.kernels import with_kernel
from tests.sampling.test_sample_dram import assert_identical, sample_dram, state_space_model
from tests.waiting import python, wait_until

KINDS = {
    "deterministic": (psf.EKF(), {}),
    "estimated": (psf.BootstrapPF(20), {}),
    "correlated": (psf.BootstrapPF(20), {"correlation": 0.9, "stages": 1}),
    "screened": (psf.BootstrapPF(20), {"screen": psf.EKF(), "screen_power": 0.8}),
}


def sample_kind(kind, **changes):
    filter, settings = KINDS[kind]
    arguments = {"draws": 700, "tune": 400, "discard_tuned_samples": False} | settings
    return sample_dram(state_space_model(filter), **with_kernel(arguments | changes))


# A run long enough to be killed in its midst.
LONG = {"draws": 3000, "tune": 1000}

# It says when a chain begins and has made so many iterations, and waits there to
# be killed.
KILLED = """
import os, sys, time, warnings
warnings.simplefilter("ignore")
from pymc_statespace_filters.sampling.run import chain_task
from tests.sampling.test_checkpoint_resume import LONG, sample_kind
chain_task.CHECKPOINT_SECONDS = 0.01
made = chain_task.ChainTask._advance
def advance(self):
    if self.n_done >= int(sys.argv[2]):
        os.write(1, b"there\\n")  # whole, whichever thread says it
        time.sleep(0.001 * (1 + self.n_done % 7))
    made(self)
chain_task.ChainTask._advance = advance
sample_kind("estimated", checkpoint=sys.argv[1], cores=2, **LONG)
print("done", flush=True)
"""


def kill_after(folder, iterations):
    """Run in a process that is killed once a chain has made so many iterations."""
    with python("-c", KILLED, folder, iterations) as child:
        assert child.stdout.readline() == "there\n"


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_killed_and_resumed(tmp_path):
    """Within the draws: nothing shows in the end."""
    kill_after(tmp_path / "run", 2500)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CheckpointWarning)  # killed while it wrote
        found = sample_kind("estimated", checkpoint=tmp_path / "run", cores=1, **LONG)
    expected = sample_kind("estimated", **LONG)
    assert_identical(found, expected)
    assert found.attrs == expected.attrs


# The moments at which a process dies, without a process: quick enough for many of them.


SMALL = {"draws": 700, "tune": 400}


@pytest.fixture(scope="module")
def small():
    return state_space_model(psf.BootstrapPF(10))


@pytest.fixture(scope="module")
def finished(small, tmp_path_factory):
    """The folder of a run and its draws, which no test may change."""
    folder = tmp_path_factory.mktemp("finished")
    return folder, sample_dram(small, checkpoint=folder, **with_kernel(SMALL))


@pytest.fixture
def often(monkeypatch):
    monkeypatch.setattr(chain_task, "CHECKPOINT_SECONDS", 0.0)


def test_a_checkpoint_changes_no_draw(small, finished):
    assert_identical(sample_dram(small, **with_kernel(SMALL)), finished[1])


def test_a_file_torn_anywhere(small, finished, tmp_path, often):
    folder, (_, expected) = tmp_path / "run", finished
    assert_identical(sample_dram(small, checkpoint=folder, **with_kernel(SMALL)), expected)
    for share in (0.2, 0.6, 1.0):
        path = folder / "run.checkpoint"
        content = path.read_bytes()
        path.write_bytes(content[: int(share * (len(content) - 1))])
        with pytest.warns(CheckpointWarning, match="checkpoint: record"):
            found = sample_dram(small, checkpoint=folder, **with_kernel(SMALL))
        assert_identical(found, expected)
        # It is mended: not a byte differs in what is stored of the draws.
        assert_identical(sample_dram(small, checkpoint=folder, **with_kernel(SMALL)), expected)


@pytest.mark.parametrize("kind", KINDS)
def test_dead_and_resumed(kind, tmp_path, often, monkeypatch):
    """At the start, within warm-up and within the draws."""
    blocks, advance = itertools.count(), chain_task.ChainTask._advance
    fatal = {0, 3, 12}

    def die(self):
        if next(blocks) in fatal:
            raise MemoryError("no more")
        advance(self)

    with monkeypatch.context() as patch:
        patch.setattr(chain_task.ChainTask, "_advance", die)
        for _ in fatal:
            with pytest.raises(MemoryError):
                sample_kind(kind, checkpoint=tmp_path, cores=1)
        found = sample_kind(kind, checkpoint=tmp_path, cores=1)
    expected = sample_kind(kind)
    assert_identical(found, expected)
    assert found.attrs == expected.attrs


def test_a_finished_run_returns_at_once(small, finished, monkeypatch):
    folder, first = finished
    monkeypatch.setattr(chain_task.ChainTask, "_advance", None)
    assert_identical(sample_dram(small, checkpoint=folder, cores=1, **with_kernel(SMALL)), first)


@pytest.mark.parametrize("random_seed", [None, "generator"])
def test_resumed_with_any_seed(small, tmp_path, often, monkeypatch, random_seed):
    def seed():
        return np.random.default_rng(5) if random_seed else None

    blocks, advance = itertools.count(), chain_task.ChainTask._advance

    def die(self):
        if next(blocks) == 5:
            raise MemoryError("no more")
        advance(self)

    with monkeypatch.context() as patch:
        patch.setattr(chain_task.ChainTask, "_advance", die)
        with pytest.raises(MemoryError):
            sample_dram(
                small, checkpoint=tmp_path, random_seed=seed(), cores=1, **with_kernel(SMALL)
            )
    assert (tmp_path / "run.checkpoint").stat().st_size > 10_000
    tree = sample_dram(small, checkpoint=tmp_path, random_seed=seed(), **with_kernel(SMALL))
    again = sample_dram(small, checkpoint=tmp_path, random_seed=seed(), **with_kernel(SMALL))
    assert_identical(again, tree)
    if random_seed:
        assert_identical(sample_dram(small, random_seed=seed(), **with_kernel(SMALL)), tree)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"draws": 701}, r"draws: the checkpoint has 700, this run has 701"),
        ({"random_seed": 2}, r"random_seed: the checkpoint has \[1\], this run has \[2\]"),
        ({"random_seed": None}, r"random_seed: the checkpoint has \[1\], this run has null"),
        ({"stages": 2}, r"stages: "),
        ({"initvals": {"phi": 0.1}}, r"initvals: "),
        ({"proposal_cov": [[0.1]]}, r"proposal_cov: "),
        ({"discard_tuned_samples": False}, r"discard_tuned_samples: "),
        ({"model": state_space_model(psf.BootstrapPF(11))}, r"model: "),
        ({"screen": psf.EKF()}, r"screen: "),
    ],
)
def test_a_checkpoint_of_another_run(small, finished, changes, message):
    with pytest.raises(DataMismatchError, match=message):
        sample_dram(**with_kernel({"model": small, **SMALL} | changes), checkpoint=finished[0])


def test_numbers_of_numpy_are_numbers(small, tmp_path):
    plain = SMALL | {"adapt_every": 50, "stage_scale": 0.5}
    first = sample_dram(small, checkpoint=tmp_path, **with_kernel(plain))
    of_numpy = {name: np.array(value)[()] for name, value in plain.items()}
    assert_identical(sample_dram(small, checkpoint=tmp_path, **with_kernel(of_numpy)), first)


def test_a_checkpoint_of_other_data(tmp_path):
    with pm.Model() as model:
        record = pm.Data("record", [1.0, 2.0])
        pm.Normal("y", pm.Normal("mu"), 1.0, observed=record)
    sample_dram(model, checkpoint=tmp_path)
    pm.set_data({"record": [1.0, 2.5]}, model=model)
    with pytest.raises(DataMismatchError, match=r"of another run: data: "):
        sample_dram(model, checkpoint=tmp_path)


@pytest.mark.usefixtures("interrupts_arrive")
def test_an_interrupted_run_goes_on(small, tmp_path, monkeypatch):
    asked = SMALL | {"discard_tuned_samples": False, "checkpoint": tmp_path}
    finished, looks = ChainPool.finished, itertools.count()

    def interrupted(pool, *others):
        wait_until(lambda: min(task.n_done for task in pool.running.values()) >= 1)
        next(looks)
        interrupt()
        return []

    monkeypatch.setattr(ChainPool, "finished", interrupted)
    part = sample_dram(small, **with_kernel(asked))
    monkeypatch.setattr(ChainPool, "finished", finished)
    assert_identical(
        sample_dram(small, **with_kernel(asked)),
        sample_dram(small, **with_kernel(asked | {"checkpoint": None})),
    )
    assert next(looks) == 1
    assert "warmup_posterior" in part.children
