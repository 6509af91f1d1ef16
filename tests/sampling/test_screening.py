"""Screened, pseudo-marginal and correlated moves on finite state spaces: matrices, no sampling.

The compiled rules that the chains call are given every path of a chain on a handful of states.
Detailed balance holds to rounding; wrong rules, put through the same check, do not come near.
"""

from itertools import product

import numpy as np
import pytest

from pymc_statespace_filters.sampling.kernel.delayed_rejection import log_acceptance
from pymc_statespace_filters.sampling.kernel.transition import log_surrogate_acceptance
from tests.compiled import from_python
from tests.sampling.test_delayed_rejection import (
    FULL,
    N_STATES,
    WITH_IMPOSSIBLE,
    imbalance,
    path_table,
    random_proposals,
    transition_matrix,
)

log_acceptance, log_surrogate_acceptance = map(
    from_python, (log_acceptance, log_surrogate_acceptance)
)

# Up to 400 times too much or too little against the target FULL.
FAR_OFF = np.array([0.002, 0.6, 0.001, 0.395, 0.002])


def log(probabilities):
    with np.errstate(divide="ignore"):
        return np.log(probabilities)


def screened_matrix(pi, c, proposals, accept=log_surrogate_acceptance):
    """P[y, z]: delayed rejection on c moves, the outer rule accepts or goes back."""
    inner = transition_matrix(c, proposals, log_acceptance)
    log_pi, log_c = log(pi), log(c)
    matrix = np.zeros_like(inner)
    for y, z in product(range(N_STATES), repeat=2):
        if y != z and inner[y, z] > 0.0:
            log_alpha = accept(log_pi[y], log_pi[z], log_c[y], log_c[z])
            assert log_alpha <= 0.0
            matrix[y, z] = inner[y, z] * np.exp(log_alpha)
    return matrix + np.diag(1.0 - matrix.sum(axis=1))


@pytest.mark.parametrize("pi", [FULL, WITH_IMPOSSIBLE], ids=["full", "impossible"])
@pytest.mark.parametrize("c", [FAR_OFF, FAR_OFF**0.25, FULL], ids=["far", "tempered", "exact"])
@pytest.mark.parametrize("n_stages", [1, 2, 3])
def test_screened_detailed_balance_is_exact(n_stages, c, pi):
    matrix = screened_matrix(pi, c, random_proposals(n_stages, seed=n_stages))

    assert np.all(matrix >= 0.0)
    assert imbalance(pi, matrix) < 1e-14
    np.testing.assert_allclose(pi @ matrix, pi, atol=1e-14)
    # The law is the only stationary one: the chain goes everywhere.
    eigenvalues = np.sort(np.abs(np.linalg.eigvals(matrix)))
    assert eigenvalues[-2] < 0.9999


def test_a_perfect_screen_is_never_overruled():
    proposals = random_proposals(2, seed=1)
    inner = transition_matrix(FULL, proposals, log_acceptance)
    np.testing.assert_allclose(screened_matrix(FULL, FULL, proposals), inner, atol=1e-15)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda pi_y, pi_z, c_y, c_z: min(0.0, pi_z - pi_y),  # blind to the screen
        lambda pi_y, pi_z, c_y, c_z: min(0.0, pi_z + c_z - pi_y - c_y),  # its ratio upside down
        lambda pi_y, pi_z, c_y, c_z: min(0.0, pi_y + c_z - pi_z - c_y),  # all upside down
        lambda pi_y, pi_z, c_y, c_z: 0.0,  # the screen alone
    ],
    ids=["blind", "screen_inverted", "inverted", "always"],
)
def test_the_check_finds_wrong_outer_rules(wrong):
    matrix = screened_matrix(FULL, FAR_OFF, random_proposals(2, seed=2), wrong)
    assert imbalance(FULL, matrix) > 1e-3


def test_a_screen_without_mass_cuts_the_target_off():
    """Nothing arrives where c is zero, and what is there stays: the reason for the warning."""
    c = FAR_OFF.copy()
    c[2] = 0.0
    matrix = screened_matrix(FULL, c, random_proposals(2, seed=3))
    assert np.all(matrix[[0, 1, 3, 4], 2] == 0.0)
    assert matrix[2, 2] == 1.0


def test_zero_probabilities_give_no_nan():
    for logs in product([-1.5, 0.5, -np.inf], repeat=4):
        value = log_surrogate_acceptance(*logs)
        assert value <= 0.0
        pi_here, pi_there, c_here, c_there = logs
        if np.isfinite(logs).all():
            assert value == min(0.0, pi_there - pi_here + c_here - c_there)
        elif pi_there == -np.inf or c_here == -np.inf:
            assert value == -np.inf
        else:
            assert value == 0.0


# A likelihood that is only estimated: the state is a point and its noise, out of two values.
NOISES = range(2)
NOISE_LAW = np.array([0.3, 0.7])
PRIOR = np.array([0.1, 0.3, 0.2, 0.15, 0.25])
ESTIMATES = np.array([[0.2, 3.0], [1.0, 1.1], [5.0, 0.1], [0.7, 0.02], [0.4, 2.0]])
STATES = list(product(range(N_STATES), NOISES))
# Prior times estimate times the law of the noise, and what it is over points.
JOINT = (PRIOR[:, None] * ESTIMATES * NOISE_LAW).ravel()
JOINT /= JOINT.sum()
EXPECTED = PRIOR * (ESTIMATES @ NOISE_LAW)
EXPECTED /= EXPECTED.sum()
# Reversible for the law of the noise.
KERNEL = 0.6 * np.eye(2) + 0.4 * NOISE_LAW


def fresh(noises):
    return NOISE_LAW


def moved(noises):
    """Every stage moves the noise of the current point."""
    return KERNEL[noises[0]]


def of_the_stage_before(noises):
    """The first stage draws afresh; the second one moves that noise."""
    return NOISE_LAW if len(noises) == 1 else KERNEL[noises[-1]]


def pseudo_marginal_matrix(n_stages, noise_of_stage, seed=4):
    """P over (point, noise) by walking every path, with the rule that knows of points alone."""
    proposals = random_proposals(n_stages, seed=seed)
    log_target = np.log(PRIOR[:, None] * ESTIMATES)
    matrix = np.zeros((len(STATES), len(STATES)))

    def walk(path, probability):
        stage = len(path)
        begin = STATES.index(path[0])
        if stage > n_stages:
            matrix[begin, begin] += probability
            return
        noise_law = noise_of_stage([noise for _, noise in path])
        for point in range(N_STATES):
            points = (*(point for point, _ in path), point)
            table = path_table(points, proposals)
            for noise in NOISES:
                longer = (*path, (point, noise))
                reached = probability * proposals[stage - 1][points] * noise_law[noise]
                log_pi = np.array([log_target[state] for state in longer])
                alpha = np.exp(log_acceptance(log_pi, table, stage))
                matrix[begin, STATES.index((point, noise))] += reached * alpha
                walk(longer, reached * (1.0 - alpha))

    for state in STATES:
        walk((state,), 1.0)
    return matrix


def stationary_points(matrix):
    """The stationary law of a chain over (point, noise), and of it what falls to each point."""
    law = np.linalg.matrix_power(matrix, 2**20)[0]
    return (law / law.sum()).reshape(N_STATES, 2).sum(axis=1)


@pytest.mark.parametrize("n_stages", [1, 2, 3])
def test_fresh_noise_gives_prior_times_expected_likelihood(n_stages):
    matrix = pseudo_marginal_matrix(n_stages, fresh)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-13)
    assert imbalance(JOINT, matrix) < 1e-14
    np.testing.assert_allclose(stationary_points(matrix), EXPECTED, atol=1e-9)


def test_moved_noise_is_exact_with_one_stage():
    matrix = pseudo_marginal_matrix(1, moved)
    assert imbalance(JOINT, matrix) < 1e-14
    np.testing.assert_allclose(stationary_points(matrix), EXPECTED, atol=1e-9)


@pytest.mark.parametrize("noise_of_stage", [moved, of_the_stage_before])
def test_noise_that_depends_on_other_stages_is_wrong(noise_of_stage):
    """Why a correlation is refused with a second stage."""
    matrix = pseudo_marginal_matrix(2, noise_of_stage)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-13)
    assert imbalance(JOINT, matrix) > 3e-4
    assert np.abs(stationary_points(matrix) - EXPECTED).max() > 1e-3


@pytest.mark.parametrize("noise_of_stage", [fresh, moved])
def test_screened_noisy_target_is_exact(noise_of_stage):
    """The screen sees points, the target one noise for the move's end; moved noise goes too."""
    inner = transition_matrix(FAR_OFF, random_proposals(3, seed=5), log_acceptance)
    log_target, log_c = np.log(PRIOR[:, None] * ESTIMATES), np.log(FAR_OFF)
    matrix = np.zeros((len(STATES), len(STATES)))
    for (i, (y, u)), (j, (z, v)) in product(enumerate(STATES), repeat=2):
        if y != z:
            log_alpha = log_surrogate_acceptance(
                log_target[y, u], log_target[z, v], log_c[y], log_c[z]
            )
            matrix[i, j] = inner[y, z] * noise_of_stage([u])[v] * np.exp(log_alpha)
    matrix += np.diag(1.0 - matrix.sum(axis=1))
    assert imbalance(JOINT, matrix) < 1e-14
    np.testing.assert_allclose(stationary_points(matrix), EXPECTED, atol=1e-9)
