"""Records of designs that ranks share: the numbers of one process."""

import pymc_statespace_filters as psf
from tests.designs.test_expected_information import DESIGNS, FEW, model
from tests.mpi.launch import on_ranks


def shared(comm):
    """A comparison of two models, whose result all ranks get."""
    designs = {name: DESIGNS[name] for name in ("late", "twice", "pulse")}
    rivals = {"wide": model(2.0), "narrow": model(0.5)}
    ranks = None if comm is None else {"comm": comm, "gather": "all"}
    return psf.expected_information(rivals, designs, comm=ranks, **FEW)


def test_results_are_bitwise_equal_on_two_ranks():
    expected = shared(None)
    for found in on_ranks(2, shared):
        assert found.equals(expected)
        assert found.sentences == expected.sentences
