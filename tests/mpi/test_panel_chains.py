"""Chains that move the records of a panel one by one, on two ranks: the draws of one process."""

import numpy as np

import pymc_statespace_filters as psf
from tests.mpi.launch import on_ranks
from tests.sampling.test_record_chains import NOISY, panel_model


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
