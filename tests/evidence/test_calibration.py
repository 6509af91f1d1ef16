"""The errors that estimators of the evidence report are those that they make.

What the slow tests measure is kept in ``docs/reference/evidence-calibration.md``. For 200
independent normal scores the mean square is within [0.7, 1.4] and the mean within 0.25 of zero
but for one time in a thousand, and for fewer the limits are as wide; seeds are fixed.
"""

import pytest

from pymc_statespace_filters.evidence.estimators.protocol import Estimate
from tests.evidence.calibration import (
    CALIBRATED,
    CASES,
    LONG_CHAINS,
    Drawn,
    applies,
    calibrate,
)
from tests.evidence.targets import half_normally_distributed


def pairs(cases):
    """Estimators that report an error, with the targets that they are for."""
    return [
        (target, name)
        for target, case in cases.items()
        for name in CALIBRATED
        if applies(name, case)
    ]


class Guess:
    """The truth with a normal error, and what it says of that error."""

    def __init__(self, truth, sd, *, bias=0.0, reported=1.0):
        self._truth, self._sd, self._bias, self._reported = truth, sd, bias, reported

    def estimate(self, posterior, *, rng):
        posterior.evaluate(posterior.draws[0, :7], rng)
        error = self._sd * (self._bias + rng.standard_normal())
        return Estimate(self._truth + error, self._reported * self._sd)


@pytest.mark.parametrize(
    ("wrong", "is_right"),
    [({}, True), ({"reported": 0.8}, False), ({"reported": 1.3}, False), ({"bias": 0.5}, False)],
)
def test_the_verdict_finds_wrong_errors(wrong, is_right):
    source = Drawn(half_normally_distributed(), 10)
    result = calibrate(Guess(source.log_evidence, 0.05, **wrong), source, 200)
    assert result.is_right == is_right
    assert result.n_evaluations == 7
    assert result.actual == pytest.approx(0.05, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("target", "name"), pairs(CASES))
def test_errors(target, name):
    case = CASES[target]
    result = calibrate(CALIBRATED[name], case.source, case.n_runs)
    # An estimator that is out of its depth may be wrong if it says so.
    assert result.is_right or result.doubted > 0.5, result


@pytest.mark.slow
@pytest.mark.parametrize(("target", "name"), pairs(LONG_CHAINS))
def test_long_chains_give_small_errors(target, name):
    case = LONG_CHAINS[target]
    result = calibrate(CALIBRATED[name], case.source, case.n_runs)
    assert result.is_right
    assert result.reported < (0.02 if case.n_parameters == 4 else 0.1)
