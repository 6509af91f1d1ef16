"""Chains of several models over two and four ranks: the draws of a process without MPI."""

import numpy as np

import pymc_statespace_filters as psf
from tests.kernels import with_kernel
from tests.mpi.launch import on_ranks
from tests.sampling.test_record_chains import NOISY, panel_model
from tests.sampling.test_sample_dram import state_space_model

FILTERS = {"exact": [psf.EKF()], "noisy": [psf.BootstrapPF(20), psf.EKF()]}
# Runs of one length, and runs that go on: the first model for longer.
RULES = {"one round": {}, "rounds": {"until_ess": 250, "max_draws": 4000}}


def draws_of_all(**settings):
    """Everything that was drawn, by model, group and name; of unequal costs, some with warm-up."""
    trees = psf.run_models(
        {name: state_space_model(*filters) for name, filters in FILTERS.items()},
        sampler="dram",
        draws=150,
        tune=300,
        chains=3,
        random_seed=4,
        discard_tuned_samples=False,
        progressbar=False,
        **with_kernel(settings),
    )
    return {
        (model, group, name): tree[group][name].values
        for model, tree in trees.items()
        for group in ("posterior", "warmup_posterior", "sample_stats")
        for name in tree[group].data_vars
        if "time" not in name
    }


def by_sizes(comm):
    """The same by communicators of two and of four of the four ranks."""
    sizes = {}
    for size in (2, 4):
        part = comm.Split(comm.rank // size)
        for rule, settings in RULES.items():
            sizes[size, rule] = draws_of_all(comm=part, gather="all", cores=1, **settings)
        part.Free()
    return sizes


def test_draws_are_bitwise_equal_on_any_number_of_ranks():
    by_rule = {rule: draws_of_all(**settings) for rule, settings in RULES.items()}
    assert {"d0_seed", "phi"} <= {name for _, _, name in by_rule["one round"]}
    lengths = [by_rule["rounds"][model, "posterior", "phi"].shape[1] for model in FILTERS]
    assert 150 < lengths[1] <= lengths[0]
    for rank, sizes in enumerate(on_ranks(4, by_sizes)):
        for (size, rule), found in sizes.items():
            expected = by_rule[rule]
            assert found.keys() == expected.keys()
            for what, values in found.items():
                np.testing.assert_array_equal(values, expected[what], f"{rank} {size} {what}")


# Chains that move the records of a panel one by one, on two ranks: the draws of one process.


def draws(comm=None):
    """Everything that was drawn, by group and name."""
    tree = psf.sample_dram(
        100,
        tune=100,
        chains=3,
        model=panel_model(NOISY, centred=False),
        random_seed=4,
        progressbar=False,
        compute_convergence_checks=False,
        comm={"comm": comm, "gather": "all"},
    )
    return {
        (group, name): tree[group][name].values
        for group in ("posterior", "sample_stats")
        for name in tree[group].data_vars
    }


def test_draws_are_bitwise_equal_on_two_ranks():
    expected = draws()
    assert ("sample_stats", "record_accepted") in expected
    for found in on_ranks(2, draws):
        assert found.keys() == expected.keys()
        for what, values in found.items():
            np.testing.assert_array_equal(values, expected[what], f"{what}")
