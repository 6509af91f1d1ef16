"""The references themselves: converged, and exact where an exact answer exists."""

import numpy as np
import pytest

from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references import records
from tests.references.grid import PointMassFilter
from tests.references.grid_states import GridStates
from tests.references.linear_states import linear_states


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


STEPS = np.array([3, 4, 20, 31, 60])
ROWS = np.array([0, 2, 3, 4, 11, 20, 31, 45, 60, 70])
DATA = np.array([0.9, 0.2, np.nan, -0.3, 0.1])


def linear_law(moment):
    """States of the double well's system without its cubic force: (R, 1), (R, 1, R, 1)."""
    system = records.DOUBLE_WELL
    return linear_states(
        1.0 - 1.5 * system.dt,
        system.sigma**2 * system.dt,
        1.0,
        system.noise_var,
        system.initial_mean,
        system.initial_var,
        steps=STEPS,
        observed=DATA,
        rows=ROWS,
        moment=moment,
    )


def test_laws_of_the_states_are_exact_for_a_linear_drift():
    system = records.DOUBLE_WELL
    grid = PointMassFilter(
        lambda x: -1.5 * x,
        sigma=system.sigma,
        dt=system.dt,
        noise_var=system.noise_var,
        initial_mean=system.initial_mean,
        initial_var=system.initial_var,
    )
    states = GridStates(grid, STEPS, DATA, ROWS)
    for moment in ("predicted", "filtered", "smoothed"):
        law, exact = getattr(states, moment)(), linear_law(moment)
        np.testing.assert_allclose(law.mean, exact.mean[:, 0], atol=1e-8)
        np.testing.assert_allclose(law.sd, exact.sd[:, 0], atol=1e-8)
        np.testing.assert_allclose(grid.spacing * law.density.sum(axis=1), 1.0, atol=1e-12)
    cov = linear_law("smoothed").cov[:, 0, :, 0]
    for i, j in [(0, 1), (1, 2), (2, 3), (0, 9), (4, 6), (5, 5)]:
        assert states.smoothed_covariance(i, j) == pytest.approx(cov[i, j], abs=1e-8)


def test_linear_states_are_those_of_kalman():
    """The last filtered mean is Kalman's, and a step's predictive density gives its term."""
    system, (steps, observed) = records.OSCILLATOR, records.oscillator_with_gaps()
    arguments = system.kalman_arguments()
    A, Q, C, R, m0, P0 = arguments
    exact = kalman_log_likelihood(*arguments, steps=steps, observed=observed)
    settings = {"steps": steps, "observed": observed, "rows": steps}
    states = linear_states(A, Q, C, R, m0, P0, **settings, moment="predicted")
    for j in (0, 1, 5, 11):  # complete rows
        off = observed[j] - C @ states.mean[j]
        S = C @ states.cov[j, :, j] @ C.T + R
        term = -0.5 * (off @ np.linalg.solve(S, off) + np.linalg.slogdet(2.0 * np.pi * S)[1])
        assert term == pytest.approx(exact[j], rel=1e-10)


def test_surprises_are_as_large_as_they_say():
    steps, observed = records.double_well_with_surprises()
    assert len(steps) == 1000
    answer = records.PRECISE_DOUBLE_WELL.point_mass_filter().run(steps, observed)
    off = (observed - answer.predicted_mean) / answer.predicted_sd
    for j, n_deviations in records.SURPRISES.items():
        assert off[j] == pytest.approx(n_deviations, abs=1e-6)
    assert np.sort(np.abs(off))[-4] < 4.5  # no other observation is a surprise
