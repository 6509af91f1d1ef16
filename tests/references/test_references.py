"""The references themselves: converged, and exact where an exact answer exists."""

import numpy as np
import pytensor.tensor as pt
import pytest

from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references import records, scan_oracle
from tests.references.grid import PointMassFilter


@pytest.mark.parametrize(
    ("system", "record"),
    [
        (records.DOUBLE_WELL, records.double_well()),
        (records.PRECISE_DOUBLE_WELL, records.double_well_with_surprises()),
    ],
    ids=["double_well", "surprises"],
)
def test_point_mass_filter_is_converged(system, record):
    coarse, fine = (system.point_mass_filter(n).run(*record).terms for n in (276, 551))
    np.testing.assert_allclose(coarse, fine, atol=1e-8)
    assert coarse.sum() == pytest.approx(fine.sum(), abs=1e-8)


def test_point_mass_filter_is_exact_for_a_linear_drift():
    system = records.DOUBLE_WELL
    steps, observed = records.double_well()
    observed = observed.copy()
    observed[7] = np.nan
    grid = PointMassFilter(
        lambda x: -1.5 * x,
        sigma=system.sigma,
        dt=system.dt,
        noise_var=system.noise_var,
        initial_mean=system.initial_mean,
        initial_var=system.initial_var,
    )
    exact = kalman_log_likelihood(
        [[1.0 - 1.5 * system.dt]],
        [[system.sigma**2 * system.dt]],
        [[1.0]],
        [[system.noise_var]],
        [system.initial_mean],
        [[system.initial_var]],
        steps=steps,
        observed=observed,
    )
    np.testing.assert_allclose(grid.run(steps, observed).terms, exact, atol=1e-10)


def test_surprises_are_as_large_as_they_say():
    steps, observed = records.double_well_with_surprises()
    assert len(steps) == 1000
    answer = records.PRECISE_DOUBLE_WELL.point_mass_filter().run(steps, observed)
    off = (observed - answer.predicted_mean) / answer.predicted_sd
    for j, n_deviations in records.SURPRISES.items():
        assert off[j] == pytest.approx(n_deviations, abs=1e-6)
    assert np.sort(np.abs(off))[-4] < 4.5  # no other observation is a surprise


def test_scan_oracle_is_exact_for_a_linear_system():
    system, (steps, observed) = records.OSCILLATOR, records.oscillator_with_gaps()
    scale = pt.dscalar("scale")

    def exact(scale):
        A, Q, C, R, m0, P0 = system.kalman_arguments()
        return kalman_log_likelihood(
            A, scale * Q, C, R, m0, P0, steps=steps, observed=observed
        ).sum()

    log_likelihood = scan_oracle.ekf_log_likelihood(
        lambda x: pt.as_tensor(system.A) @ x,
        lambda x: pt.as_tensor(system.C) @ x,
        process_cov=scale * pt.as_tensor(system.B @ system.B.T),
        observation_cov=pt.as_tensor(system.R),
        initial_mean=pt.as_tensor(system.mean),
        initial_cov=pt.as_tensor(system.cov),
        steps=steps,
        observed=observed,
    )
    value, gradient = scan_oracle.value_and_gradient(log_likelihood, {scale: 0.8})
    assert value == pytest.approx(exact(0.8), rel=1e-11)
    slope = (exact(0.8 + 1e-4) - exact(0.8 - 1e-4)) / 2e-4
    assert gradient == pytest.approx([slope], rel=1e-6)
