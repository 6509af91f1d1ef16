"""Chains of every kind are calibrated, and the same comparisons find chains that are not.

All comparisons of a right sampler together fail for one set of seeds in a thousand. What they gave
is kept in ``docs/reference/calibration.md``, which ``python -m tests.sampling.calibration_report``
writes.
"""

import numpy as np
import pytest

import pymc_statespace_filters as psf
from tests.sampling.calibration import (
    CONTROLS,
    LENGTHS,
    SETTINGS,
    TUNE,
    Replications,
    calibrate,
    p_values,
)

# By two statistics, for every quantity in every setting.
THRESHOLD = 0.001 / sum(2 * len(s.problem.quantities) for s in SETTINGS.values())

FOUND = 0.001  # of a sampler that is wrong, by the most telling of all its tests


@pytest.mark.slow
@pytest.mark.parametrize("name", SETTINGS)
def test_ranks_are_uniform(name):
    found = calibrate(SETTINGS[name])
    assert p_values(found.ranks).min() > THRESHOLD
    assert found.lags.mean(axis=0).max() < 0.1  # so that the law of the ranks is the uniform one


@pytest.mark.slow
@pytest.mark.parametrize("name", CONTROLS)
def test_the_same_comparisons_find(name):
    assert p_values(calibrate(CONTROLS[name]).ranks).min() < FOUND


QUICK, *OTHERS = SETTINGS  # that the calibration runs at all is also tested without it


@pytest.mark.parametrize(
    "name", [QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in OTHERS)]
)
def test_replications_are_what_sample_dram_draws(name):
    replications = Replications(SETTINGS[name])
    for index in range(2 if name == QUICK else 5):
        draws = replications.chain(index, LENGTHS[0])
        replications.record.set_value(replications.truth_and_record(index)[1])
        tree = psf.sample_dram(
            LENGTHS[0],
            tune=TUNE,
            chains=1,
            model=replications.model,
            random_seed=index,
            progressbar=False,
            kernel=replications.kernel,
            compute_convergence_checks=False,
        )
        for variable, values in draws.items():
            np.testing.assert_array_equal(tree["posterior"][variable][0], values)
