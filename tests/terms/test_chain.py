"""The chain over sub-models, with heights of known probabilities."""

from types import SimpleNamespace

import numpy as np
import pytest

from pymc_statespace_filters.terms import chain
from pymc_statespace_filters.terms.inclusion import InclusionPrior

LOG_POSTERIOR = np.log([[0.2, 0.05], [0.3, 0.45]])  # by the presence of two terms
INCLUSION = [0.75, 0.5]


class NoisyHeights:
    """Estimates of a mean whose logarithm has a standard deviation."""

    def __init__(self, sd, rng):
        self.sd, self.rng = sd, rng
        self.best = np.zeros(2, dtype=bool)
        self.points = {"": SimpleNamespace(proposal=SimpleNamespace(present=self.best))}

    def heights(self, sets):
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
    visits = chain.run_chains(prior, guide, None, None, rng, lambda task, total: None)
    assert (visits.error < 0.01).all()
    np.testing.assert_array_less(abs(visits.frequency - INCLUSION), 4 * visits.error)
