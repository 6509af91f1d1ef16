"""Which sub-models are within reach, and how many points go to which."""

from typing import NamedTuple

import numpy as np
import pymc as pm
from scipy.stats import norm

from pymc_statespace_filters.statistics.importance import log_mean_of_independent
from pymc_statespace_filters.terms import enumeration, screening
from pymc_statespace_filters.terms.candidates import read_candidates
from pymc_statespace_filters.terms.probabilities import Probabilities
from pymc_statespace_filters.terms.submodel_evidence import Weighted


def test_more_points_are_never_more_than_are_left():
    present = np.array([[False, False], [False, True], [True, False], [True, True]])
    # Errors of a proposal that is poor: every sub-model lacks more than there are.
    known = Probabilities(present, np.zeros(4), np.zeros(4), np.full(4, 2.0))
    counts = [1000] * 4
    for left in (0, 1, 7, 1001, 10**6):
        more = enumeration._missing(known, counts, 0.005, left)
        assert (more >= 0).all()
        assert more.sum() <= min(left, sum(counts))
        assert more.sum() > min(left, sum(counts)) - len(counts)


def test_no_sub_model_is_out_of_reach_by_points_that_say_nothing():
    weights = [
        np.zeros(25),
        np.full(25, -12.0),  # certainly out of reach
        np.linspace(-300.0, -12.0, 25),  # one point decides, and a better one may be missing
        np.linspace(-20.0, -11.0, 25),  # five effective points, but on a slope
        np.linspace(-310.0, -300.0, 25),  # not that far
        np.full(25, -np.inf),
    ]
    found = [Weighted(None, np.empty((25, 0)), np.empty((25, 0), int), one) for one in weights]
    most = np.array([screening._at_most(one) for one in found])
    within = screening._within_reach(found, most, np.zeros(6), -np.inf)
    assert found[3].n_effective > screening.FEWEST_EFFECTIVE
    assert within.tolist() == [True, False, True, True, False, False]
    assert not screening._within_reach(found, most, np.zeros(6), 1000.0).any()
    # What earlier points may have missed is not forgotten.
    within = screening._within_reach(found[:2], np.array([0.0, 5.0]), np.zeros(2), -np.inf)
    assert within.tolist() == [True, True]


class Normal(NamedTuple):
    """A proposal of one coordinate, which returns what it is to be fitted to."""

    sd: float

    def log_density_of_drawn(self, x):
        return norm.logpdf(x[:, 0], scale=self.sd)

    def refitted(self, x, log_weights, rng):
        return x, log_weights


def test_points_of_several_proposals_are_weighted_as_of_their_mixture():
    """Their mean is the integral, 2, and few points of the narrow one have no large weights."""
    rng, found = np.random.default_rng(1), []
    for sd, n in ((0.2, 1000), (1.5, 4000)):
        x = sd * rng.standard_normal((n, 1))
        log_weights = np.log(2) + norm.logpdf(x[:, 0]) - norm.logpdf(x[:, 0], scale=sd)
        found.append(Weighted(Normal(sd), x, np.empty((n, 0), int), log_weights))
    x, log_weights = found[1].refitted(rng, found[:1])
    mean, error = log_mean_of_independent(log_weights)
    assert len(x) == 5000
    assert abs(mean - np.log(2)) < 4 * error < 0.04
    # At most what the wide one alone gives: its weight there, over its share of the points.
    assert log_weights.max() < np.log(2 * 1.5 / 0.8) < found[0].log_weights.max()


def test_errors_of_probabilities_are_those_of_uncertain_evidences():
    """Against the spread of probabilities over independent errors of all evidences."""
    rng, sets = np.random.default_rng(0), np.array([[0, 0], [1, 0], [0, 1], [1, 1]], dtype=bool)
    log_evidence, error = np.array([0.3, 0.0, -1.0, 0.5]), np.array([0.0, 0.004, 0.02, 0.01])
    found = Probabilities(sets, np.zeros(4), log_evidence, error)
    z = np.exp(log_evidence) * (1 + error * rng.standard_normal((20_000, 4)))
    p = z / z.sum(axis=1, keepdims=True)
    # Standard deviations of 20 000 draws are off by 3 % once in 10^9.
    np.testing.assert_allclose(found.inclusion_se, (p @ sets).std(axis=0), rtol=0.03)
    np.testing.assert_allclose(found.of_models_se, p.std(axis=0), rtol=0.03)


def test_a_candidate_is_named_by_its_own_label():
    """Which may be the position of another element."""
    with pm.Model(coords={"power": [1, 2]}) as model:
        pm.Normal("b", 0, 1, dims="power")
    candidates = read_candidates(model, {"b": 0.0})
    assert candidates.labels == ["b[1]", "b[2]"]
    assert candidates.numbers("b[1]", "inclusion") == [0]


def test_a_candidate_with_a_whole_vector_is_named_by_it():
    with pm.Model() as model:
        pm.HalfNormal("amplitude", 1)
        pm.Normal("z", 0, 1, shape=3)
        pm.Normal("b", 0, 1, shape=2)
    candidates = read_candidates(model, {("amplitude", "z", "b[1]"): (0.0, 0.0, 0.0)})
    assert candidates.labels == ["amplitude, z, b[1]"]


class Scripted:
    """A sampler whose points have given log weights, one list for each time they are drawn."""

    is_noisy = False

    def __init__(self, *times):
        self.times = iter(times)

    def draw(self, proposals, counts):
        return [weighted(weights) for weights in next(self.times)]


def weighted(log_weights):
    n = len(log_weights)
    return Weighted(Unchanged(), np.zeros((n, 1)), np.empty((n, 0), int), np.array(log_weights))


class Unchanged:
    """A proposal that no points improve."""

    def log_density_of_drawn(self, x):
        return np.zeros(len(x))

    def refitted(self, x, log_weights, rng):
        return self


def test_what_points_of_a_worse_proposal_say_does_not_put_a_sub_model_out_of_reach():
    """The first points reach high, but are few; those of the next proposal all lie low."""
    good, few, low = np.zeros(25), np.append(np.full(24, -300.0), -5.0), np.full(50, -50.0)
    sampler = Scripted([good, few], [low])
    found, within = screening.screened(
        [Unchanged()] * 2, np.zeros(2), sampler, np.random.default_rng(1)
    )
    assert found[1].mean.value == -50.0
    assert within.tolist() == [True, True]


def test_a_heavy_tail_is_looked_into_where_the_influence_looks_small(monkeypatch):
    """A sub-model may matter ten times as much as its points with a heavy tail say."""
    asked = []

    def improved(proposals, *rest):
        asked.extend(proposals)
        return [weighted(heavy)] * len(proposals)

    monkeypatch.setattr(enumeration, "improved", improved)
    sets, rng = np.array([[False], [True], [True], [True]]), np.random.default_rng(1)
    heavy = rng.pareto(0.8, 400)
    heavy = np.log(heavy / heavy.mean())
    assert not weighted(heavy).is_reliable
    of_models = [np.zeros(400), np.zeros(400), heavy - 5.5, heavy - 9.0]
    found = [weighted(one) for one in of_models]
    known = enumeration.probabilities(found, sets, np.zeros(4))
    assert enumeration.LARGE > known.influence()[2] > enumeration.HIDDEN * enumeration.LARGE
    assert known.influence()[3] < enumeration.HIDDEN * enumeration.LARGE
    sampler = Scripted([])
    enumeration.with_lighter_tails(found, sets, np.zeros(4), sampler, rng, lambda *args: None)
    assert asked == [found[2].proposal]
