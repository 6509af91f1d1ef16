"""Draws that lack a part of a posterior that is known, and draws that lack none."""

import numpy as np
import pytest

from pymc_statespace_filters.checks.coverage import check
from pymc_statespace_filters.checks.coverage.check import N_EVALUATIONS, missed_tails
from tests.evidence.hard_targets import Correlated, Funnel

ALL = 1e9  # evaluations
SOME = 0.4 * N_EVALUATIONS


def drawn(target, seed, cut=None, noise_sd=0.0, n=2500):
    """Exact draws (4, n, k); none of those with a first parameter below ``cut``."""
    posterior = target.posterior(
        (4, 3 * n), np.random.default_rng(seed), correlation=0.8, noise_sd=noise_sd
    )
    draws, log_density = posterior.draws, posterior.log_density
    kept = np.ones(log_density.shape, bool) if cut is None else draws[..., 0] > cut
    rows = [np.flatnonzero(one)[:n] for one in kept]
    return (
        np.stack([one[i] for one, i in zip(draws, rows, strict=True)]),
        np.stack([one[i] for one, i in zip(log_density, rows, strict=True)]),
        posterior.evaluate,
    )


@pytest.mark.parametrize("noise_sd", [0.0, 1.0])
def test_the_neck_of_a_funnel_that_no_chain_entered_is_found(noise_sd):
    """A fifth of the posterior is cut off: the draws have the first parameter above -2.5."""
    for seed in range(2):
        draws, log_density, evaluate = drawn(Funnel(5), seed, cut=-2.5, noise_sd=noise_sd)
        found = missed_tails(draws, log_density, evaluate, SOME, np.random.default_rng(seed))
        assert [(one.tail.parameter, one.tail.side) for one in found] == [(0, -1)]
        (missed,) = found
        assert missed.posterior > missed.draws + 0.05
        assert missed.furthest[0] == pytest.approx(draws[..., 0].min())
        assert missed.furthest[0] < missed.at_edge[0]


def test_a_cut_posterior_of_any_scale_is_found():
    draws, log_density, evaluate = drawn(Correlated(3), 1, cut=-0.8)
    found = missed_tails(
        1e-9 * draws,
        log_density,
        lambda x, rng: evaluate(1e9 * x, rng),
        ALL,
        np.random.default_rng(2),
    )
    assert found[0].tail[:2] == (0, -1)
    assert found[0].posterior > found[0].draws + 0.15  # 0.21 is cut off


@pytest.mark.parametrize("target", [Funnel(5), Correlated(3), Correlated(1)])
def test_draws_of_the_whole_posterior_raise_no_alarm(target):
    """Of 9 right sets of draws, each with an alarm of probability 0.02 at most, none has one."""
    for seed in range(3):
        draws, log_density, evaluate = drawn(target, 10 + seed)
        assert missed_tails(draws, log_density, evaluate, SOME, np.random.default_rng(seed)) == []


def test_the_number_of_evaluations_is_kept(monkeypatch):
    draws, log_density, evaluate = drawn(Correlated(3), 1, n=500)
    made = 0

    def counted(x, rng):
        nonlocal made
        made += len(x)
        return evaluate(x, rng)

    for allowed in (N_EVALUATIONS, 0.4 * N_EVALUATIONS):
        made = 0
        missed_tails(draws, log_density, counted, allowed, np.random.default_rng(1))
        assert 0.9 * allowed < made <= 1.05 * allowed
    made = 0
    assert missed_tails(draws, log_density, counted, 1000, np.random.default_rng(1)) == []
    monkeypatch.setattr(check, "MOST_PARAMETERS", 2)
    assert missed_tails(draws, log_density, counted, ALL, np.random.default_rng(1)) == []
    assert made == 0


def test_chains_that_stand_still_are_left_alone():
    """A tenth of the draws is one point, the last of a tail; or all of the tail is few points."""
    draws, log_density, evaluate = drawn(Correlated(2), 1, n=500)
    for still in (np.s_[0, :200], np.s_[:2, :450]):
        stuck = draws.copy()
        stuck[still] = [-5.0, -5.0]
        missed_tails(stuck, log_density, evaluate, ALL, np.random.default_rng(1))


def test_draws_that_do_not_vary_in_every_direction_are_left_alone():
    draws, log_density, evaluate = drawn(Correlated(3), 1, n=500)
    for wrong in (draws * [1.0, 1.0, 0.0], draws[..., [0, 1, 1]]):
        assert missed_tails(wrong, log_density, evaluate, ALL, np.random.default_rng(1)) == []


def test_the_share_of_the_posterior_in_a_tail_is_that_of_exact_draws():
    """Of a normal distribution, also in the widest tail, where Z is that of all draws."""
    rng = np.random.default_rng(5)
    draws = rng.standard_normal((4, 5000, 2))

    def log_density(x, rng=None):
        return -0.5 * (x**2).sum(axis=-1)

    log_evidence = check._bridged(draws, log_density(draws), log_density, 8000, rng)
    tail = check._tail(draws, 0, 1, 0.2)
    inside = draws[tail.distance(draws) > 0]
    points = check.weighted_points(tail, inside, log_density, 1.0, rng)
    found = check._compared(tail, draws, points, log_evidence)
    assert found.posterior == pytest.approx(0.2, abs=0.01)  # three standard errors
    assert abs(found.errors) < 3
