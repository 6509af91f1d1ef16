"""Functions whose points ranks share: the numbers of one process, on one, two and four ranks."""

import os
import signal
import warnings

import arviz as az
import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.native.rows import Rows
from pymc_statespace_filters.parameter_particles import stored_steps
from pymc_statespace_filters.parameter_particles.stored_steps import StoredSteps
from pymc_statespace_filters.pymc_model.prior import ModelPrior
from tests.mpi.launch import on_ranks
from tests.parameter_particles.autoregression import model

SMC = {
    "draws": 20, "populations": 2, "random_seed": 2, "progressbar": False,
    "compute_convergence_checks": False,
}  # fmt: skip
SEQUENTIAL = {**SMC, "data": "sequential", "inner": psf.BootstrapPF(6)}
FOUR = 4


def _numbers(tree):
    """All that a result holds, by group and name."""
    return {
        (group.path, name): values.values
        for group in tree.subtree
        for name, values in group.to_dataset().data_vars.items()
        if "time" not in name
    }


def draws():
    normals = np.random.default_rng(1).normal(0.7, 0.2, (2, 100))
    return az.from_dict({"posterior": {"a": normals}})


def results(idata, comm=None):
    """Particles, and what follows from draws that only the first rank has."""
    built, own = model(psf.EKF(), 9), {"comm": comm, "progressbar": False}
    calls = {
        psf.estimate_evidence: {"estimators": "importance", "random_seed": 3},
        psf.reweight: {"filter": psf.BootstrapPF(20), "random_seed": 3},
        psf.forecast: {"n_steps": 3, "random_seed": 3},
        psf.leave_future_out: {"min_observations": 5},
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few particles, and what few draws say
        particles = psf.sample_smc(model=built, comm=comm, **SEQUENTIAL)
        terms = psf.select_terms(built, {"a": 0.0}, idata=idata, random_seed=3, **own)
        found = [call(idata, built, **own, **of_call) for call, of_call in calls.items()]
    evidence, reweighted, ahead, score = found
    trees = {"particles": particles, "reweighted": reweighted, "ahead": ahead, "terms": terms}
    return {
        "evidence": repr(evidence),
        "score": score.elpd_i.values,
        **{(name, *at): one for name, tree in trees.items() for at, one in _numbers(tree).items()},
    }


def by_sizes(comm):
    """The same on all ranks, and on two of them."""
    found = {}
    for size in (2, FOUR):
        part = comm.Split(comm.rank // size)
        if size == FOUR or comm.rank < 2:
            ranks = {"comm": part, "gather": "all"}
            found[size] = results(draws() if part.rank == 0 else None, ranks)
        part.Free()
    return found


def test_results_are_bitwise_equal_on_any_number_of_ranks():
    expected = results(draws())
    for rank, sizes in enumerate(on_ranks(FOUR, by_sizes)):
        assert list(sizes) == ([2, FOUR] if rank < 2 else [FOUR])
        for size, found in sizes.items():
            assert found.keys() == expected.keys()
            for what, values in found.items():
                where = f"{what} on rank {rank} of {size}"
                np.testing.assert_array_equal(values, expected[what], where)


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
            ranks = {"comm": comm, "per_chain": 2 if fault == "per_chain" else 1}
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
    assert "per_chain of comm must be 1 without chains, got 2" in first["per_chain"]
    alike = {"diverges", "other data", "other seed", "per_chain"}
    assert all(first[fault] == second[fault] for fault in alike)


def killed(comm, folder):
    """A run of two ranks that ends without notice when some rows are stored."""
    save, saved = StoredSteps.save, []

    def save_and_end(steps, arrays, **settings):
        save(steps, arrays, **settings)
        saved.append(1)
        if len(saved) == 5 and comm.rank == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    stored_steps.SECONDS, StoredSteps.save = 0.0, save_and_end
    psf.sample_smc(**SEQUENTIAL, model=model(psf.EKF(), 9), comm=comm, checkpoint=folder)


@pytest.mark.filterwarnings("ignore:the log-evidence")  # few particles
def test_a_run_that_was_killed_goes_on_with_another_number_of_ranks(tmp_path):
    with pytest.raises(AssertionError, match="exit status"):
        on_ranks(2, killed, tmp_path)
    assert (tmp_path / "run.checkpoint").stat().st_size > 10_000
    own = {**SEQUENTIAL, "model": model(psf.EKF(), 9)}
    resumed, whole = psf.sample_smc(**own, checkpoint=tmp_path), psf.sample_smc(**own)
    for what, values in _numbers(whole).items():
        np.testing.assert_array_equal(_numbers(resumed)[what], values, str(what))
