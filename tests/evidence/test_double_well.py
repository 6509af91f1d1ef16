"""A double well: evidence of pseudo-marginal chains against quadrature over the grid filter."""

import pytest

from tests.evidence import double_well

N_PARTICLES = 50


def test_the_quadrature_has_converged():
    coarse = double_well.log_evidence(19)
    fine = double_well.log_evidence(25)
    assert fine == pytest.approx(double_well.LOG_EVIDENCE, abs=2e-6)
    assert abs(coarse - fine) < 2e-4
