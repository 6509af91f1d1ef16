"""Ranks that fail, are killed or disagree: the job ends soon, says why, and can go on later."""

import os
import pickle
import re
import signal
import time

import arviz as az
import numpy as np
import pytest

import pymc_statespace_filters as psf
from tests.kernels import with_kernel
from tests.mpi.launch import Job, mpiexec, on_ranks
from tests.mpi.programs import resumed
from tests.sampling.test_sample_dram import state_space_model
from tests.waiting import wait_until

PROGRAMS = ["-m", "tests.mpi.programs"]


@pytest.mark.parametrize(("chain", "rank", "abort"), [(2, 1, True), (0, 0, False)])
def test_a_model_that_raises_stops_all_ranks(chain, rank, abort):
    """The first chains are those of rank 0."""
    done = mpiexec(2, [*PROGRAMS, "failing"], chain, abort=abort)
    assert done.status == 1
    where = rf"in chain {chain}, after \d+ iterations"
    assert re.search(rf"^ArithmeticError: no more\n{where}", done.stderr, re.MULTILINE)
    told = (
        rf"ParallelError: rank {rank} of 2 has stopped the run: ArithmeticError: no more \({where}"
    )
    assert re.search(told, done.stderr)


# A rank that fails before it comes to the package, while another waits there for it.
EARLY_ERROR = """
from mpi4py import MPI
if MPI.COMM_WORLD.rank == 1:
    raise FileNotFoundError("no data on this computer")
from pymc_statespace_filters.parallel.communicator import communicator_of
communicator_of("world").barrier()
"""


def test_a_script_that_fails_on_one_rank_does_not_leave_the_others_waiting():
    done = mpiexec(2, ["-c", EARLY_ERROR])
    assert done.status == 1
    assert "FileNotFoundError: no data on this computer" in done.stderr


def disagreements(comm):
    """What is said where rank 1 makes another call than rank 0."""
    model, other = (state_space_model(psf.EKF(), *more) for more in ([], [psf.EKF()]))
    call = {"draws": 20, "tune": 10, "random_seed": 1, "progressbar": False, "comm": comm}
    variants = [
        {"draws": 30},
        {"random_seed": 2},
        {"checkpoint": "never-made"},
        {"gather": "all"},
        {"per_chain": 2},
        {"initvals": {"phi": 0.1}},
        {"models": {"another": model}},
        {"models": {"M": model, "M2": model}},
        {"models": {"M": other}},
        {"random_seed": np.random.default_rng(1)},
        {"proposal_cov": [[1.0]]},
        {"pilot": az.from_dict({"posterior": {"phi": np.linspace(0.3, 0.6, 40).reshape(2, 20)}})},
    ]
    heard = []
    for changes in variants:
        with pytest.raises(psf.errors.DataMismatchError) as caught:
            psf.run_models(
                sampler="dram",
                **with_kernel(
                    {"models": {"M": model}} | call | (changes if comm.rank == 1 else {})
                ),
            )
        heard.append(str(caught.value))
    return heard


def test_ranks_that_make_different_calls_are_told():
    zero, one = on_ranks(2, disagreements)
    assert zero == one
    said = [re.search("rank 1 of 2 and rank 0 differ in (.*);", text).group(1) for text in zero]
    assert said[:6] == [
        "draws", "random_seed", "checkpoint", "gather", "per_chain", "initvals"
    ]  # fmt: skip
    assert said[6:8] == ["models", "models"]
    assert said[8].startswith("model")
    assert [("the same integer as random_seed" in text) for text in zero] == [
        "random_seed" in what for what in said
    ]
    assert said[9:11] == ["random_seed", "proposal_cov"]
    assert {"initvals", "proposal_cov", "pilot"} <= set(said[11].split(", "))
    assert [("the same pilot" in text) for text in zero] == [False] * 11 + [True]


def wait_for_a_checkpoint(path, since, before):
    """Wait until chains have been stored after a time, beyond some bytes."""

    def is_stored():
        if not path.exists() or path.stat().st_mtime < since:
            return False
        return path.stat().st_size > before + 10_000

    wait_until(is_stored)


def disturb(n, folder, iterations, how):
    """Start the long run, whose chains make no more than these iterations, and end it."""
    begin, path = time.time(), folder / "run" / "run.checkpoint"
    before = path.stat().st_size if path.exists() else 0
    job = Job(n, "-m", "mpi4py", *PROGRAMS, "long_run", folder, iterations)
    try:
        wait_for_a_checkpoint(path, begin, before)
        how(job)
        done = job.wait()
    finally:
        job.end()
    assert done.status != 0
    assert not (folder / "draws").exists()


def test_killed_and_interrupted_and_taken_up_by_other_numbers_of_ranks(tmp_path):
    disturb(2, tmp_path, 3000, lambda job: os.kill(max(job.ranks()), signal.SIGKILL))
    disturb(3, tmp_path, 6000, lambda job: job.process.send_signal(signal.SIGINT))
    done = mpiexec(2, [*PROGRAMS, "long_run"], tmp_path)
    assert done.status == 0, done.stderr
    assert not (tmp_path / "not-seen").exists()
    found = pickle.loads((tmp_path / "draws").read_bytes())
    undisturbed = resumed()["posterior"]
    assert list(found) == list(undisturbed.data_vars)
    for name, draws in found.items():
        np.testing.assert_array_equal(draws, undisturbed[name])
