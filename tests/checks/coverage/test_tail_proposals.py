"""Importance sampling in a tail: its mean is the mass of the tail, which is known here."""

import numpy as np
import pytest
from scipy.stats import norm

from pymc_statespace_filters.checks.coverage.tail_proposals import (
    Straightened,
    Tail,
    weighted_points,
)
from pymc_statespace_filters.statistics.importance import log_mean_of_independent
from tests.evidence.hard_targets import Correlated, Funnel
from tests.evidence.targets import autoregressive


@pytest.mark.parametrize(
    ("target", "tail", "log_mass"),
    [
        (Correlated(1), Tail(0, 1, 1.0), norm.logsf(1.0)),
        (Correlated(4), Tail(2, 1, 1.0), norm.logsf(1.0)),
        (Correlated(4), Tail(0, -1, 0.5), norm.logsf(0.5)),
        (Funnel(5), Tail(0, -1, 2.0), norm.logsf(2.0 / 3.0)),
    ],
)
def test_the_mean_weight_is_the_mass_of_the_tail(target, tail, log_mass):
    rng = np.random.default_rng(1)
    draws = target.transport(autoregressive((1, 4000, target.n_normals), 0.0, rng))[0]
    with np.errstate(over="ignore"):  # points far out
        points = weighted_points(
            tail,
            draws[tail.distance(draws) > 0],
            lambda x, rng: target.log_posterior(x),
            0.3,
            rng,
        )
    assert (tail.distance(points.x) > 0).all()
    found = log_mean_of_independent(points.log_weights)
    assert found.error < 0.06
    assert found.value == pytest.approx(log_mass, abs=4 * found.error)


@pytest.mark.parametrize("target", [Funnel(4), Correlated(1)])
def test_coordinates_are_inverse_and_their_jacobian_is_that_of_differences(target):
    rng = np.random.default_rng(2)
    draws = target.transport(rng.standard_normal((2000, target.n_normals)))
    for side in (1, -1):
        tail = Tail(0, side, 0.3)
        inside = draws[tail.distance(draws) > 0]
        coordinates = Straightened(tail, inside)
        x = inside[:3] + [
            [side * 30.0 * (i == 2)] + [0.0] * (inside.shape[1] - 1) for i in range(3)
        ]
        y, log_det = coordinates.of(x)
        np.testing.assert_allclose(coordinates.at(y), x)
        step = 1e-6 * np.eye(inside.shape[1])
        for at, expected in zip(x, log_det, strict=True):
            slopes = (coordinates.of(at + step)[0] - coordinates.of(at - step)[0]) / 2e-6
            assert np.linalg.slogdet(slopes)[1] == pytest.approx(expected, abs=1e-4)


def test_a_funnel_is_straight_in_them():
    """The standard deviations of a funnel are exp(half its first parameter)."""
    rng = np.random.default_rng(3)
    draws = Funnel(4).transport(rng.standard_normal((20_000, 4)))
    tail = Tail(0, -1, 1.0)
    inside = draws[tail.distance(draws) > 0]
    y = Straightened(tail, inside).of(inside)[0]
    halves = (y[:, 0] > np.median(y[:, 0]), y[:, 0] <= np.median(y[:, 0]))
    far, near = (y[half, 1:].std(axis=0) for half in halves)
    np.testing.assert_allclose(far, near, rtol=0.25)  # of x itself: a factor of three
