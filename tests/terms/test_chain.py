"""The chain over sub-models, with heights of known probabilities."""

from types import SimpleNamespace

import numpy as np
import pytest

from pymc_statespace_filters.terms import chain
from pymc_statespace_filters.terms.estimates import Visits
from pymc_statespace_filters.terms.inclusion import InclusionPrior
from pymc_statespace_filters.terms.probabilities import Probabilities

LOG_POSTERIOR = np.log([[0.2, 0.05], [0.3, 0.45]])  # by the presence of two terms
INCLUSION = [0.75, 0.5]


class NoisyHeights:
    """Estimates of a mean whose logarithm has a standard deviation."""

    def __init__(self, sd, rng):
        self.sd, self.rng = sd, rng
        self.best = np.zeros(2, dtype=bool)
        self.points = {"": SimpleNamespace(proposal=SimpleNamespace(present=self.best))}

    def heights(self, sets, before):
        exact = LOG_POSTERIOR[tuple(sets.astype(int).T)]
        return exact + self.sd * self.rng.standard_normal(len(sets)) - self.sd**2 / 2

    def lost(self, sets):
        return np.zeros(len(sets), dtype=bool)


@pytest.mark.parametrize("sd", [0.0, 0.7])
def test_visits_are_as_frequent_as_probable(sd, monkeypatch):
    """Whatever the noise of the estimates. Fails by chance once in 4000."""
    rng = np.random.default_rng(3)
    monkeypatch.setattr(chain, "_Met", lambda *args: NoisyHeights(sd, rng))
    monkeypatch.setattr(chain, "N_STEPS", 8000)
    prior = InclusionPrior(None, np.zeros((2, 2), dtype=bool))
    guide = SimpleNamespace(distances=np.array([1.5, 2.5]))
    visits = chain.run_chains(prior, guide, None, rng, lambda task, total: None)
    assert (visits.error < 0.01).all()
    np.testing.assert_array_less(abs(visits.frequency - INCLUSION), 4 * visits.error)
    assert not visits.alone.any()
    np.testing.assert_array_equal(visits.missed(visits.frequency), 0.0)


class Independent:
    """Exact heights of terms that are present independently of each other."""

    def __init__(self, log_odds):
        self.log_odds, self.points = log_odds, {}
        self.best = np.zeros(len(log_odds), dtype=bool)

    def heights(self, sets, before):
        for one in sets.copy():
            self.points[one.tobytes()] = SimpleNamespace(proposal=SimpleNamespace(present=one))
        return sets @ self.log_odds

    def lost(self, sets):
        return np.zeros(len(sets), dtype=bool)


@pytest.mark.parametrize(
    ("frequency", "error", "most"),
    [
        (0.8, 0.5, np.sqrt((0.06**2 + 0.12**2) / 2)),  # by what each chain has visited alone
        (0.35, 0.03, np.hypot(0.05, 0.03)),  # by frequencies, which are more certain
    ],
)
def test_how_far_an_inclusion_may_move(frequency, error, most):
    visits = Visits(
        sets=np.array([[True]]),
        points=[],
        frequency=np.array([frequency]),
        error=np.array([error]),
        alone=np.array([0.1, 0.3]),
        frequency_alone=np.array([[0.1], [0.0]]),
    )
    np.testing.assert_allclose(visits.missed(np.array([0.4])), most)


def test_what_was_not_met_is_part_of_the_error(monkeypatch):
    """Of 2^16 sub-models, a few hundred: by evidences without error, of 12 runs."""
    inclusion = np.concatenate([np.full(8, 0.05), np.full(8, 0.2)])
    log_odds = np.log(inclusion / (1 - inclusion))
    monkeypatch.setattr(chain, "N_STEPS", 400)
    prior = InclusionPrior(None, np.zeros((16, 16), dtype=bool))
    guide = SimpleNamespace(distances=np.linspace(0, 3, 16))
    z, shares = [], []
    for seed in range(12):
        met = Independent(log_odds)
        monkeypatch.setattr(chain, "_Met", lambda *args, met=met: met)
        rng = np.random.default_rng(seed)
        visits = chain.run_chains(prior, guide, None, rng, lambda task, total: None)
        found = Probabilities(
            visits.sets, visits.sets @ log_odds, *np.zeros((2, len(visits.sets)))
        ).inclusion
        shares.append(visits.alone.mean())
        z.append((found - inclusion) / visits.missed(found))
    assert 0.1 < np.median(shares) < 0.3
    assert 0.5 < np.mean(np.square(z)) < 4.0
