"""Adaptation: what a covariance learns from a chain, on exact Gaussian targets."""

from functools import partial
from threading import Event

import numpy as np
import pymc as pm
import pytest
from numba import njit

from pymc_statespace_filters.sampling.kernel.adaptation import STALLED, learn
from pymc_statespace_filters.sampling.kernel.adaptation_state import (
    pack,
    packed_size,
    start_adaptation,
    unpack,
)
from pymc_statespace_filters.sampling.kernel.independence import no_mixture
from pymc_statespace_filters.sampling.run.chain_task import ChainTask
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from pymc_statespace_filters.sampling.target.target import Target


@njit
def learn_from(adapt_every, continuous, state, position, stage):
    learn(adapt_every, continuous, state, position, stage, False)


def adapted(continuous, adapt_every, state, position, stage):
    """What is learnt from an iteration, by a state of its own."""
    dim = len(state.cov)
    packed = np.empty(packed_size(dim))
    pack(state, packed)
    learn_from(adapt_every, continuous, unpack(packed, dim), np.asarray(position), stage)
    return unpack(packed, dim)


adapt_by_blocks = partial(adapted, False)
adapt_continuously = partial(adapted, True)
BOTH = pytest.mark.parametrize(
    "adapt", [adapt_by_blocks, adapt_continuously], ids=["chain", "continuous"]
)
ADAPT_EVERY = 100


def feed(adapt, state, positions, stages):
    for position, stage in zip(positions, stages, strict=True):
        state = adapt(ADAPT_EVERY, state, position, int(stage))
    return state


def warm_up(adapt, cov, start, first_cov, n, *, seed, stages=2):
    """What a chain on N(0, cov) has learnt after n iterations of warm-up."""
    with pm.Model() as model:
        x = pm.Flat("x", shape=len(start))
        # Data, so that all targets are one function. A sum of products: PyTensor takes half a
        # minute to compile products of matrices.
        precision = pm.Data("precision", np.linalg.inv(cov))
        pm.Potential("log_density", -0.5 * (x[:, None] * precision * x).sum())
    scheme = "chain" if adapt is adapt_by_blocks else "continuous"
    settings = RandomWalkSettings(stages=stages, adaptation=scheme)
    target = Target(model, None, settings, first_cov)
    target.prepare()
    task = ChainTask(
        target,
        n,
        n,
        lambda rng: [start],
        np.random.SeedSequence(seed),
        n_rows=n,
        mixture=no_mixture(len(start)),
    )
    task.run(Event())
    return unpack(task.chain.state.adaptation, len(start))


def correlated_target(dim, *, smallest_sd, largest_sd, correlation, seed):
    rng = np.random.default_rng(seed)
    sd = np.geomspace(smallest_sd, largest_sd, dim) * rng.choice([-1, 1], dim)
    return (np.eye(dim) * (1 - correlation) + correlation) * np.outer(sd, sd)


@BOTH
@pytest.mark.parametrize(
    ("every", "first_counts"),
    [(1, 3**2), (13, 0.2 * 3)],
    ids=["its proposals are accepted", "too wide"],
)
def test_covariance_is_that_of_the_draws(adapt, every, first_counts):
    """Once a block moves, C = 2.38^2 / d COV, up to the blend with the first covariance.

    In whatever units: their ratios are 1e14.
    """
    rng = np.random.default_rng(0)
    dim, n, units = 3, 100, np.array([1e-7, 1.0, 1e7])
    positions = rng.normal(size=(n, dim)) @ np.tril(rng.normal(size=(dim, dim)))
    accepted = np.arange(n) % every == 0
    state = feed(adapt, start_adaptation(np.diag(units**2)), positions * units, accepted)

    weight = accepted.sum() / (accepted.sum() + first_counts)
    learnt = 2.38**2 / dim * np.cov(positions.T, bias=True)
    cov = state.cov / np.outer(units, units)
    np.testing.assert_allclose(cov, weight * learnt + (1 - weight) * np.eye(dim), rtol=1e-4)
    np.testing.assert_allclose(state.chol @ state.chol.T, state.cov, rtol=1e-12)


@pytest.mark.parametrize(
    ("n_blocks", "first_used"), [(1, 0), (2, 1), (3, 1), (4, 2), (6, 2), (8, 4), (11, 4)]
)
def test_blocks_use_the_later_part(n_blocks, first_used):
    """The block before at first, then the latest half to three quarters of all blocks."""
    rng = np.random.default_rng(1)
    positions = rng.normal(size=(100 * n_blocks, 2)) + np.linspace(0, 9, 100 * n_blocks)[:, None]
    state = feed(adapt_by_blocks, start_adaptation(np.eye(2)), positions, np.ones(100 * n_blocks))

    used = positions[100 * first_used :]
    learnt = 2.38**2 / 2 * np.cov(used.T, bias=True)
    # The covariance in use before weighs at most 4 / 104.
    np.testing.assert_allclose(state.cov, learnt, rtol=0.05)
    assert state.older.n + state.recent.n == len(used)


def test_blocks_change_nothing_between_their_ends():
    rng = np.random.default_rng(2)
    positions = rng.normal(size=(250, 2))
    state = start_adaptation(np.eye(2))
    changes = []
    for k, position in enumerate(positions, start=1):
        after = adapt_by_blocks(ADAPT_EVERY, state, position, 1)
        if not np.array_equal(after.cov, state.cov):
            changes.append(k)
        state = after
    assert changes == [100, 200]


@BOTH
def test_a_block_that_accepts_next_to_nothing_shrinks_the_scale(adapt):
    rng = np.random.default_rng(3)
    state = feed(adapt, start_adaptation(np.eye(2)), rng.normal(size=(100, 2)), np.ones(100))
    moved_once = np.zeros(100)
    moved_once[50] = 1
    after = feed(adapt, state, np.ones((100, 2)), moved_once)

    shrinkage = np.linalg.det(after.cov) / np.linalg.det(state.cov)
    assert shrinkage < 1.01 * STALLED**4


@BOTH
def test_a_start_that_never_moves_shrinks_every_quarter_block(adapt):
    state = feed(adapt, start_adaptation(np.eye(2)), np.zeros((100, 2)), np.zeros(100))
    np.testing.assert_allclose(state.cov, np.eye(2) * STALLED**8, rtol=1e-12)


def test_low_acceptance_halves_the_scale_and_fair_acceptance_restores_it():
    rng = np.random.default_rng(4)
    few = np.zeros(100)
    few[::33] = 1
    state = feed(adapt_by_blocks, start_adaptation(np.eye(2)), rng.normal(size=(100, 2)), few)
    assert state.scale == 0.5
    state = feed(adapt_by_blocks, state, rng.normal(size=(100, 2)), np.ones(100))
    assert state.scale == 1.0


@BOTH
def test_the_state_handed_in_is_not_touched(adapt):
    rng = np.random.default_rng(5)
    state = feed(adapt, start_adaptation(np.eye(2)), rng.normal(size=(99, 2)), np.ones(99))
    copies = [a.copy() for a in (state.cov, state.chol, state.block.mean, state.block.scatter)]
    adapt(ADAPT_EVERY, state, rng.normal(size=2), 1)
    for kept, copy in zip(
        (state.cov, state.chol, state.block.mean, state.block.scatter), copies, strict=True
    ):
        np.testing.assert_array_equal(kept, copy)


@BOTH
def test_overflow_keeps_the_covariance(adapt):
    positions = np.full((100, 2), 1e200) * np.random.default_rng(6).normal(size=(100, 2))
    state = feed(adapt, start_adaptation(np.eye(2)), positions, np.ones(100))
    np.testing.assert_array_equal(state.cov, np.eye(2))


@BOTH
@pytest.mark.parametrize("too_wide", [10.0, 100.0])
def test_warm_up_of_2000_learns_a_hard_target_from_a_bad_start(adapt, too_wide):
    """Standard deviations from 0.05 to 30, correlations of 0.97, a start many of them away.

    Every axis of the proposal is within a factor of two of 2.38 / sqrt(d) times the target's. Over
    seeds 0 to 3 the ratios lie between 0.7 and 1.3; a proposal that missed the correlation would
    be off by a factor of eleven.
    """
    dim = 4
    for seed in range(2):
        cov = correlated_target(dim, smallest_sd=0.05, largest_sd=30, correlation=0.97, seed=seed)
        sd = too_wide * np.sqrt(np.diag(cov))
        start = np.random.default_rng(seed + 50).normal(size=dim) * sd
        state = warm_up(adapt, cov, start, np.diag(sd**2) * 2.38**2 / dim, 2000, seed=seed)
        ratio = np.linalg.eigvals(np.linalg.solve(cov, state.cov * dim / 2.38**2)).real
        assert 0.5 < np.sqrt(ratio.min())
        assert np.sqrt(ratio.max()) < 2.0


def test_a_packed_state_is_the_same_state():
    rng = np.random.default_rng(3)
    state = feed(adapt_by_blocks, start_adaptation(np.eye(3)), rng.normal(size=(750, 3)), [1] * 750)
    packed = np.full(packed_size(3), np.nan)
    pack(state, packed)
    again = unpack(packed, 3)
    for mine, theirs in zip(_flat(state), _flat(again), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert len({float(np.sum(part)) for part in _flat(state)}) > 10  # parts that can be told apart


def _flat(state):
    return [part for value in state for part in (value if isinstance(value, tuple) else [value])]
