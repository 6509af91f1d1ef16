"""How many points go to which sub-model."""

import numpy as np

from pymc_statespace_filters.terms import enumeration
from pymc_statespace_filters.terms.probabilities import Probabilities


def test_more_points_are_never_more_than_are_left():
    present = np.array([[False, False], [False, True], [True, False], [True, True]])
    # Errors of a proposal that is poor: every sub-model lacks more than there are.
    known = Probabilities(present, np.zeros(4), np.zeros(4), np.full(4, 2.0))
    counts = [1000] * 4
    for left in (0, 1, 7, 1001, 10**6):
        more = enumeration._missing(known, counts, 0.005, left)
        assert (more >= 0).all()
        assert more.sum() <= min(left, sum(counts))
        assert more.sum() > min(left, sum(counts)) - len(counts)
