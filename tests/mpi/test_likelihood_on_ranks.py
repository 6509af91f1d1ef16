"""A likelihood whose members belong to several ranks."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from tests.mpi.launch import on_ranks
from tests.systems import PAIR, PAIR_DATA, STEPS

FILTERS = (
    psf.EnKF(300),
    psf.BootstrapPF(300, resample_below=1),
    psf.GuidedPF(300, resample_below=1),
    psf.PFEnKF(300),
)
POINTS = {"a": [0.9, 0.3], "b": 0.1}


def likelihoods(comm):
    return [
        psf.log_likelihood(PAIR, filter_, POINTS, PAIR_DATA, steps=STEPS, seed=7, comm=comm)
        for filter_ in FILTERS
    ]


def refusals(comm):
    refused = []
    for filter_ in (psf.EnKF(64), psf.EKF()):
        with pytest.raises(psf.errors.ModelError) as raised:
            psf.log_likelihood(PAIR, filter_, POINTS, PAIR_DATA, steps=STEPS, comm=comm)
        refused.append(str(raised.value))
    for other in ({"seed": comm.rank}, {"params": {"a": 0.9 + comm.rank, "b": 0.1}}):
        call = {"params": {"a": 0.9, "b": 0.1}, "seed": 1} | other
        with pytest.raises(psf.errors.DataMismatchError, match="on rank 1 of 2 than"):
            psf.log_likelihood(
                PAIR, psf.EnKF(130), observed=PAIR_DATA, steps=STEPS, comm=comm, **call
            )
    return refused


def by_sizes(comm):
    """On one, two and four of the four ranks; and what is said on two."""
    results = {size: likelihoods(comm.Split(comm.rank // size)) for size in (1, 2, 4)}
    return results, refusals(comm.Split(comm.rank // 2))


def test_it_is_the_same_to_the_bit_on_any_number_of_ranks():
    alone = likelihoods(None)
    assert np.all(np.isfinite(alone))
    for results, (few, none) in on_ranks(4, by_sizes):
        for size, found in results.items():
            assert np.array_equal(found, alone), size
        assert "members for 1 of 2 ranks" in few
        assert "no members to distribute over 2 ranks" in none
