"""Importance sampling in a tail: its mean is the mass of the tail, which is known here."""

import numpy as np
import pytest
from scipy.stats import norm

from pymc_statespace_filters.importance import log_mean_of_independent
from pymc_statespace_filters.unvisited.tail_proposals import Tail, weighted_points
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


def test_coordinates_are_inverse():
    rng = np.random.default_rng(2)
    for tail in (Tail(1, 1, 0.3), Tail(1, -1, 0.3)):
        x = rng.standard_normal((20, 3))
        x = x[tail.distance(x) > 0]
        np.testing.assert_allclose(tail.from_log(tail.to_log(x)), x)
