"""Whether a force is missing, against the Bayes factor by regression and quadrature."""

import numpy as np
import pytest

from benchmarks.missing_force import one_record


@pytest.mark.parametrize("seed", [1, 2])
def test_the_bayes_factor_of_a_force_is_that_of_quadrature(seed):
    """Nothing is missing in one record and a force in the other; 4 standard errors."""
    found = one_record(seed)
    assert found.missing == (found.exact > 0)
    assert abs(found.reported - found.exact) < 4 * found.se < 0.5
    assert np.isnan(found.covered) or found.covered > 0.7
