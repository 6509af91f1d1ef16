"""Delayed rejection on a finite state space: the whole transition matrix, no sampling.

The compiled function that the samplers call is given every path of a chain on a handful of states,
with random proposals that are neither symmetric nor blind to the path. Detailed balance then holds
to rounding; three classic slips, put through the same check, do not come near.
"""

from itertools import product

import numpy as np
import pytest

from pymc_statespace_filters.sampling.kernel.delayed_rejection import (
    gaussian_log_acceptance,
    gaussian_log_proposals,
    log_acceptance,
)
from tests.compiled import from_python

gaussian_log_acceptance, gaussian_log_proposals, log_acceptance = map(
    from_python, (gaussian_log_acceptance, gaussian_log_proposals, log_acceptance)
)

N_STATES = 5
FULL = np.array([0.3, 0.1, 0.25, 0.05, 0.3])
WITH_IMPOSSIBLE = np.array([0.4, 0.1, 0.0, 0.2, 0.3])


def random_proposals(n_stages, *, seed, with_zeros=False):
    """One table per stage: q_k[y, z_1, .., z_k], summing to one over z_k."""
    rng = np.random.default_rng(seed)
    tables = []
    for stage in range(1, n_stages + 1):
        table = rng.exponential(size=(N_STATES,) * (stage + 1))
        if with_zeros:
            table[rng.random(table.shape) < 0.3] = 0.0
            table[..., 0] += 0.05
        tables.append(table / table.sum(axis=-1, keepdims=True))
    return tables


def path_table(path, proposals):
    """log_q[s, e] of one path: the part from s to e, backwards where e < s."""
    n_points = len(path)
    log_q = np.zeros((n_points, n_points))
    with np.errstate(divide="ignore"):
        for s, e in product(range(n_points), repeat=2):
            if s != e:
                part = path[s : e + 1] if s < e else path[e : s + 1][::-1]
                log_q[s, e] = np.log(proposals[abs(e - s) - 1][tuple(part)])
    return log_q


def transition_matrix(pi, proposals, accept, believed=None):
    """P[y, z] by walking every path; what no stage accepts stays at y.

    ``believed`` are the proposals of the acceptance probability, if they are others.
    """
    believed = believed or proposals
    with np.errstate(divide="ignore"):
        log_pi = np.log(pi)
    matrix = np.zeros((N_STATES, N_STATES))

    def walk(path, probability):
        stage = len(path)
        if probability == 0.0:
            return
        if stage > len(proposals):
            matrix[path[0], path[0]] += probability
            return
        for z in range(N_STATES):
            longer = (*path, z)
            reached = probability * proposals[stage - 1][longer]
            if reached == 0.0:
                continue
            alpha = np.exp(accept(log_pi[list(longer)], path_table(longer, believed), stage))
            assert 0.0 <= alpha <= 1.0
            matrix[path[0], z] += reached * alpha
            walk(longer, reached * (1.0 - alpha))

    for y in range(N_STATES):
        walk((y,), 1.0)
    return matrix


def imbalance(pi, matrix):
    flow = pi[:, None] * matrix
    return np.abs(flow - flow.T).max()


@pytest.mark.parametrize("pi", [FULL, WITH_IMPOSSIBLE], ids=["full", "impossible"])
@pytest.mark.parametrize("with_zeros", [False, True])
@pytest.mark.parametrize("n_stages", [1, 2, 3])
def test_detailed_balance_is_exact(n_stages, pi, with_zeros):
    proposals = random_proposals(n_stages, seed=n_stages, with_zeros=with_zeros)
    matrix = transition_matrix(pi, proposals, log_acceptance)

    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-14)
    assert imbalance(pi, matrix) < 1e-14
    np.testing.assert_allclose(pi @ matrix, pi, atol=1e-14)


@pytest.mark.parametrize("n_stages", [1, 2, 3])
def test_more_stages_move_more_often(n_stages):
    """Peskun: each further stage can only take probability off staying put."""
    proposals = random_proposals(3, seed=1)
    fewer = transition_matrix(FULL, proposals[: n_stages - 1], log_acceptance)
    more = transition_matrix(FULL, proposals[:n_stages], log_acceptance)

    off_diagonal = ~np.eye(N_STATES, dtype=bool)
    assert np.all(more[off_diagonal] >= fewer[off_diagonal])
    assert more[off_diagonal].sum() > fewer[off_diagonal].sum() + 0.01


def alpha_one(log_pi, log_q, s, e):
    return min(1.0, np.exp(log_pi[e] + log_q[e, s] - log_pi[s] - log_q[s, e]))


def second_stage(log_pi, log_q, *, one_back, one_there, rejected_back):
    rejected_there = 1.0 - alpha_one(log_pi, log_q, 0, 1)
    there = log_pi[0] + one_there + log_q[0, 2] + np.log(rejected_there)
    back = log_pi[2] + one_back + log_q[2, 0] + np.log(rejected_back)
    return min(0.0, back - there)


def without_reverse_rejection(log_pi, log_q, stage):
    """Drops [1 - alpha_1(z_2, z_1)]."""
    if stage == 1:
        return log_acceptance(log_pi, log_q, 1)
    return second_stage(
        log_pi, log_q, one_back=log_q[2, 1], one_there=log_q[0, 1], rejected_back=1.0
    )


def cancelled_first_stage(log_pi, log_q, stage):
    """Cancels q_1(z_2, z_1) against q_1(y, z_1)."""
    if stage == 1:
        return log_acceptance(log_pi, log_q, 1)
    rejected_back = 1.0 - alpha_one(log_pi, log_q, 2, 1)
    return second_stage(log_pi, log_q, one_back=0.0, one_there=0.0, rejected_back=rejected_back)


def same_rejection_twice(log_pi, log_q, stage):
    """Takes alpha_1(y, z_1) for alpha_1(z_2, z_1)."""
    if stage == 1:
        return log_acceptance(log_pi, log_q, 1)
    rejected_back = 1.0 - alpha_one(log_pi, log_q, 0, 1)
    return second_stage(
        log_pi, log_q, one_back=log_q[2, 1], one_there=log_q[0, 1], rejected_back=rejected_back
    )


@pytest.mark.parametrize(
    "wrong", [without_reverse_rejection, cancelled_first_stage, same_rejection_twice]
)
@pytest.mark.filterwarnings("ignore:divide by zero:RuntimeWarning")
def test_the_check_finds_wrong_formulas(wrong):
    matrix = transition_matrix(FULL, random_proposals(2, seed=2), wrong)
    assert imbalance(FULL, matrix) > 1e-4


def test_one_size_for_all_stages_is_balanced_and_one_for_each_is_not():
    """A kernel for each of two sizes, chosen before the first stage; or anew before the second."""
    small, large = (random_proposals(2, seed=seed) for seed in (2, 3))
    matrices = [transition_matrix(FULL, size, log_acceptance) for size in (small, large)]
    assert imbalance(FULL, 0.1 * matrices[0] + 0.9 * matrices[1]) < 1e-14

    mixed = [small[0], 0.1 * small[1] + 0.9 * large[1]]
    assert imbalance(FULL, transition_matrix(FULL, mixed, log_acceptance, small)) > 1e-4


def test_zero_probabilities_give_no_nan():
    """Every pattern of minus infinities in the target: a log-probability each time, never NaN."""
    rng = np.random.default_rng(0)
    for pattern in product([0.0, -np.inf], repeat=4):
        log_pi = rng.normal(size=4) + np.array(pattern)
        value = log_acceptance(log_pi, rng.normal(size=(4, 4)), 3)
        assert value <= 0.0
        if pattern[3] == -np.inf:
            assert value == -np.inf


def test_gaussian_stages_are_their_densities():
    """In whitened coordinates: densities of N(y, g^(2(k-1)) C), up to a constant per stage."""
    rng = np.random.default_rng(3)
    stage_scale, dim = 0.3, 3
    chol = np.tril(rng.normal(size=(dim, dim))) + 2 * np.eye(dim)
    offsets = np.vstack([np.zeros(dim), rng.normal(size=(3, dim))])
    points = rng.normal(size=dim) + offsets @ chol.T

    log_q = gaussian_log_proposals(offsets, stage_scale, 3)
    for s, e in product(range(4), repeat=2):
        if s != e:
            cov = stage_scale ** (2 * (abs(e - s) - 1)) * chol @ chol.T
            step = points[e] - points[s]
            expected = -0.5 * step @ np.linalg.solve(cov, step)
            np.testing.assert_allclose(log_q[s, e], expected, rtol=1e-10)

    log_pi = rng.normal(size=4)
    assert gaussian_log_acceptance(log_pi, offsets, stage_scale, 3) == log_acceptance(
        log_pi, log_q, 3
    )
