"""Chains whose likelihoods several ranks evaluate together: the draws of one process."""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from tests.kernels import with_kernel
from tests.mpi.launch import on_ranks
from tests.sampling.test_sample_dram import state_space_model

SETTINGS = {
    "draws": 40,
    "tune": 20,
    "chains": 2,
    "random_seed": 5,
    "progressbar": False,
    "discard_tuned_samples": False,
}


def models():
    return {
        "mixed": state_space_model(psf.EnKF(300), psf.BootstrapPF(260, resampling="multinomial")),
        "nudged": state_space_model(psf.PFEnKF(270)),
    }


def draws_of_all(**settings):
    """Everything that was drawn, by model, group and name."""
    return {
        (model, group, name): values.to_numpy()
        for model, tree in psf.run_models(
            models(), sampler="dram", **with_kernel(SETTINGS | settings)
        ).items()
        for group in ("posterior", "warmup_posterior", "sample_stats")
        for name, values in tree[group].data_vars.items()
    }


def shared(comm):
    """By one group of four ranks, and by two of two."""
    return [draws_of_all(comm=comm, per_chain=n, gather="all") for n in (4, 2)], refusals(comm)


def refusals(comm):
    """What is said of chains that ranks cannot share."""
    settings = SETTINGS | {"comm": comm, "per_chain": 4}
    asked = [
        (psf.EKF(), {}),
        (psf.EnKF(130), {}),
        (psf.EnKF(300), {"per_chain": 3}),
        (psf.EnKF(300), {"correlation": 0.9, "stages": 1}),
    ]
    said = []
    for filter, changes in asked:
        with pytest.raises((psf.errors.ModelError, psf.errors.ParallelError)) as caught:
            psf.sample_dram(model=state_space_model(filter), **with_kernel(settings | changes))
        said.append(str(caught.value))
    return said


def test_draws_do_not_depend_on_who_evaluates():
    expected = draws_of_all()
    for found, said in on_ranks(4, shared):
        for of_groups in found:
            assert of_groups.keys() == expected.keys()
            for what, values in of_groups.items():
                np.testing.assert_array_equal(values, expected[what], str(what))
        nothing, blocks, groups, moved = said
        assert "a model without a StateSpace variable whose filter has particles" in nothing
        assert "64" in blocks
        assert "per_chain=3 with 4 ranks" in groups
        assert "correlation=0.9" in moved
