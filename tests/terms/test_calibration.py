"""Standard errors of inclusions against closed forms: many records, so that it is slow."""

import warnings

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import EvidenceWarning
from tests.terms.regression import Regression

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("slab_unknown", [False, True])
def test_errors_are_those_of_eight_candidates(slab_unknown):
    squares = []
    for seed in range(50):
        regression = Regression(seed, slab_unknown=slab_unknown)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EvidenceWarning)
            terms = psf.select_terms(
                regression.model(),
                regression.absent,
                idata=regression.draws(seed + 1000),
                random_seed=seed,
                progressbar=False,
            )["terms"]
        truth = regression.inclusion()
        z = (terms["inclusion"].values - truth) / terms["inclusion_se"].values
        squares += list(z[(truth > 0.05) & (truth < 0.95)] ** 2)
    assert 0.7 < np.mean(squares) < 1.4
