"""Runs in several threads of the user leave PyTensor as it was."""

from concurrent.futures import ThreadPoolExecutor

import pymc as pm
import pytensor

import pymc_statespace_filters as psf


def run(number):
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 1 + number)
        pm.Normal("y", mu, pm.HalfNormal("sd", 1), observed=[0.3, 1.2])
    return psf.sample_dram(
        20,
        tune=20,
        chains=1,
        model=model,
        random_seed=1,
        progressbar=False,
        compute_convergence_checks=False,
    )


def test_runs_at_once_leave_the_flags_and_the_draws_as_alone():
    names = ("mode", "linker", "optimizer", "cxx")
    before = [getattr(pytensor.config, name) for name in names]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(run, range(4)))
    assert [getattr(pytensor.config, name) for name in names] == before
    for number in (0, 3):
        alone = run(number)["posterior"]["mu"].values
        assert (found[number]["posterior"]["mu"].values == alone).all()
