"""Which sub-models are within reach, and how many points go to which."""

import numpy as np

from pymc_statespace_filters.terms import enumeration, screening
from pymc_statespace_filters.terms.estimates import Weighted
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


def test_no_sub_model_is_out_of_reach_by_points_that_say_nothing():
    weights = [
        np.zeros(25),
        np.full(25, -12.0),  # certainly out of reach
        np.linspace(-300.0, -12.0, 25),  # one point decides, and a better one may be missing
        np.linspace(-310.0, -300.0, 25),  # not that far
        np.full(25, -np.inf),
    ]
    found = [Weighted(None, np.empty((25, 0)), np.empty((25, 0), int), one) for one in weights]
    within = screening._within_reach(found, np.zeros(5), -np.inf)
    assert within.tolist() == [True, False, True, False, False]
    assert not screening._within_reach(found, np.zeros(5), 1000.0).any()
