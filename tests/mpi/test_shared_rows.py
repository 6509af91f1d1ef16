"""Functions whose points ranks share: the numbers of one process, on one, two and four ranks."""

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.native.rows import Rows
from pymc_statespace_filters.pymc_model.prior import ModelPrior
from tests.mpi.launch import on_ranks
from tests.parameter_particles.autoregression import model

SMC = {
    "draws": 30, "populations": 3, "random_seed": 2, "progressbar": False,
    "compute_convergence_checks": False,
}  # fmt: skip
RUNS = {
    "tempered": {"inner": psf.BootstrapPF(20)},
    "sequential": {"inner": psf.BootstrapPF(6), "data": "sequential"},
}


def _numbers(tree):
    """All that a result holds, by group and name."""
    return {
        (group.path, name): values.values
        for group in tree.subtree
        for name, values in group.to_dataset().data_vars.items()
        if "time" not in name
    }


def particles(comm=None):
    """Runs of parameter particles."""
    return {
        name: _numbers(psf.sample_smc(model=model(psf.EKF(), 12), comm=comm, **SMC, **settings))
        for name, settings in RUNS.items()
    }


def by_sizes(comm):
    """The same by communicators of two and of four of the four ranks."""
    found = {}
    for size in (2, 4):
        part = comm.Split(comm.rank // size)
        found[size] = particles(psf.Ranks(part, gather="all"))
        part.Free()
    return found


@pytest.mark.filterwarnings("ignore:the log-evidence")  # few particles
def test_results_are_bitwise_equal_on_any_number_of_ranks():
    expected = particles()
    for rank, sizes in enumerate(on_ranks(4, by_sizes, env={"PYTHONWARNINGS": "ignore"})):
        for size, runs in sizes.items():
            for run, numbers in runs.items():
                assert numbers.keys() == expected[run].keys()
                for what, values in numbers.items():
                    where = f"{run} {what} on rank {rank} of {size}"
                    np.testing.assert_array_equal(values, expected[run][what], where)


def failures(comm):
    """How both ranks end, where one of them fails, diverges or has other data."""
    ends = {}
    draw = ModelPrior.sample

    def raising(*arguments):
        raise ArithmeticError("no more")

    for fault in ("fails", "fails within", "diverges", "other data", "other seed", "per_chain"):
        is_faulty = comm.rank == 1
        with pytest.MonkeyPatch.context() as patch:
            if is_faulty and fault == "fails":
                patch.setattr(ModelPrior, "sample", raising)
            if is_faulty and fault == "fails within":
                patch.setattr(Rows, "_evaluated", raising)
            if is_faulty and fault == "diverges":
                patch.setattr(ModelPrior, "sample", lambda *given: draw(*given) + 1e-15)
            data = [0.3, 0.4 if is_faulty and fault == "other data" else 1.0]
            settings = SMC | {"random_seed": 1 + (is_faulty and fault == "other seed")}
            ranks = psf.Ranks(comm, per_chain=2 if fault == "per_chain" else 1)
            with pm.Model():
                pm.Normal("y", pm.Normal("mu"), 1.0, observed=data)
                try:
                    psf.sample_smc(comm=ranks, **settings)
                except Exception as error:
                    ends[fault] = f"{type(error).__name__}: {error}"
    return ends


def test_all_ranks_end_with_one():
    first, second = on_ranks(2, failures)
    stopped = "ParallelError: rank 1 of 2 has stopped the run: ArithmeticError: no more"
    assert first["fails"] == first["fails within"] == stopped
    assert second["fails"] == second["fails within"] == "ArithmeticError: no more"
    assert "ParallelError: rank 1 of 2 and rank 0 have computed different" in first["diverges"]
    for fault, name in {"other data": "data", "other seed": "random_seed"}.items():
        assert f"DataMismatchError: rank 1 of 2 and rank 0 differ in {name};" in first[fault]
    assert "per_chain of Ranks must be 1 without chains, got 2" in first["per_chain"]
    alike = {"diverges", "other data", "other seed", "per_chain"}
    assert all(first[fault] == second[fault] for fault in alike)
