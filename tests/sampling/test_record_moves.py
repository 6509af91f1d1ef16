"""Moves of records and of what they share on a finite state space: whole transition matrices.

Two records have a parameter of two values each and a noise of three; all densities are powers of
two, so that a grid of uniform numbers gives every acceptance probability exactly. The compiled
rules that chains call then keep the target to rounding; two rules that are nearly right do not.
"""

from itertools import product

import numpy as np
import pytest
from numba import njit

from pymc_statespace_filters.sampling.kernel.record_moves import accept_all, accept_records

# Log2 of p(x | m) of both records, by the population's value, and of the estimates L(x, u).
PRIOR = np.array([[0.0, -1.0], [-2.0, 0.0]])
ESTIMATES = np.array([[[0.0, 1.0, -1.0], [1.0, -1.0, 0.0]], [[-1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]])
NOISE = np.array([0.25, 0.5, 0.25])
STAYS = 0.25  # of a proposal of x; symmetric
N_UNIFORMS = 32  # no ratio of two records' densities is smaller than 1 / 32
N_OF_ONE = 16  # and none of a record that moves alone than 1 / 16
STATES = np.array(list(product(range(2), range(3), range(2), range(3))))  # x, u of both records


@njit(error_model="numpy")
def each(estimates, priors, new_estimates, new_priors, log_uniforms, accepted):
    accept_records(estimates, priors, new_estimates, new_priors, log_uniforms, accepted)


@njit
def terms_of(state, population):
    """Estimates and priors of a state; the last term is that of other data, and of no record."""
    estimates, priors = np.zeros(3), np.zeros(3)
    for g in range(2):
        estimates[g] = ESTIMATES[g, state[2 * g], state[2 * g + 1]] * np.log(2.0)
        priors[g] = PRIOR[population, state[2 * g]] * np.log(2.0)
    return estimates, priors


@njit
def place(state):
    return ((state[0] * 3 + state[1]) * 2 + state[2]) * 3 + state[3]


@njit
def matrix_of_record_moves(rule, population, redraws):
    """P of one sweep by a rule; with ``redraws`` each current estimate is made anew before."""
    matrix, n = np.zeros((len(STATES), len(STATES))), N_OF_ONE
    log_grid = np.log((np.arange(n) + 0.5) / n)
    for here in range(36):
        for there in range(36):
            proposed = STATES[there]
            probability = 1.0
            for g in range(2):
                same = proposed[2 * g] == STATES[here, 2 * g]
                probability *= STAYS if same else 1.0 - STAYS
                probability *= NOISE[proposed[2 * g + 1]]
            for again in range(9 if redraws else 1):
                current, weight = STATES[here].copy(), probability / n**2
                if redraws:
                    current[1], current[3] = again // 3, again % 3
                    weight *= NOISE[current[1]] * NOISE[current[3]]
                for i in range(n):
                    for j in range(n):
                        log_uniforms = np.array([log_grid[i], log_grid[j]])
                        estimates, priors = terms_of(current, population)
                        new_estimates, new_priors = terms_of(proposed, population)
                        accepted = np.zeros(2, dtype=np.int64)
                        rule(estimates, priors, new_estimates, new_priors, log_uniforms, accepted)
                        after = current.copy()
                        for g in range(2):
                            if accepted[g]:
                                after[2 * g : 2 * g + 2] = proposed[2 * g : 2 * g + 2]
                        kept, kept_priors = terms_of(after, population)
                        if not (np.all(kept == estimates) and np.all(kept_priors == priors)):
                            raise ValueError("an estimate is not that of its record's point")
                        matrix[here, place(after)] += weight
    return matrix


def target(population):
    """Distribution of the states: prior, estimate and density of the noise."""
    weights = [
        np.exp(sum(part.sum() for part in terms_of(state, population)))
        * NOISE[state[1]]
        * NOISE[state[3]]
        for state in STATES
    ]
    return np.array(weights) / np.sum(weights)


def imbalance(pi, matrix):
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-12)
    flow = pi[:, None] * matrix
    return np.abs(flow - flow.T).max()


@pytest.mark.parametrize("population", [0, 1])
def test_records_that_accept_alone_are_in_detailed_balance(population):
    matrix = matrix_of_record_moves(each, population, False)
    assert imbalance(target(population), matrix) < 1e-14
    # One record moves while the other stays, and both move.
    assert matrix[place(np.array([0, 0, 0, 0])), place(np.array([1, 0, 0, 0]))] > 0.01
    assert matrix[place(np.array([0, 0, 0, 0])), place(np.array([1, 0, 1, 0]))] > 0.01


def test_records_that_redraw_their_estimates_are_not():
    pi = target(0)
    matrix = matrix_of_record_moves(each, 0, True)
    assert imbalance(pi, matrix) > 1e-3
    assert np.abs(pi @ matrix - pi).max() > 1e-3


@njit(error_model="numpy")
def each_by_the_sum(estimates, priors, new_estimates, new_priors, log_uniforms, accepted):
    """A wrong rule: every record accepts on its own, but by the terms of all."""
    here, there = (estimates + priors).sum(), (new_estimates + new_priors).sum()
    for g in range(2):
        accepted[g] = log_uniforms[g] < min(0.0, there - here)
        if accepted[g]:
            estimates[g], priors[g] = new_estimates[g], new_priors[g]


def test_records_that_accept_by_the_terms_of_all_are_not_in_balance():
    assert imbalance(target(0), matrix_of_record_moves(each_by_the_sum, 0, False)) > 1e-3


def test_the_population_is_in_detailed_balance_with_its_records():
    """Its move evaluates no likelihood: the estimates are those of the records, and stay."""
    accept = njit(lambda *arguments: accept_all(*arguments))
    states = [(m, state) for m in range(2) for state in STATES]
    pi = np.concatenate([target(0) * weight(0), target(1) * weight(1)])
    pi /= pi.sum()
    matrix = np.zeros((72, 72))
    for here, (m, state) in enumerate(states):
        for i in range(N_UNIFORMS):
            estimates, priors = terms_of(state, m)
            _, new_priors = terms_of(state, 1 - m)
            kept = estimates.copy()
            log_uniform = np.log((i + 0.5) / N_UNIFORMS)
            moved = accept(estimates, priors, estimates, new_priors, log_uniform)
            assert (estimates == kept).all()
            there = (here + 36) % 72 if moved else here
            matrix[here, there] += 1.0 / N_UNIFORMS
    assert imbalance(pi, matrix) < 1e-14


def weight(population):
    """Sum of the weights before `target` normalises them."""
    return sum(
        np.exp(sum(part.sum() for part in terms_of(state, population)))
        * NOISE[state[1]]
        * NOISE[state[3]]
        for state in STATES
    )


def test_shared_parameters_are_in_detailed_balance_with_fresh_noise_for_all():
    """Here the value m enters the likelihoods; all estimates are kept, or all are new."""
    accept = njit(lambda *arguments: accept_all(*arguments))
    noises = list(product(range(3), repeat=2))
    states = [(m, noise) for m in range(2) for noise in noises]

    def terms(m, noise):
        state = np.array([m, noise[0], m, noise[1]])
        return terms_of(state, 0)

    pi = np.array(
        [
            np.exp(sum(part.sum() for part in terms(m, noise))) * NOISE[list(noise)].prod()
            for m, noise in states
        ]
    )
    pi /= pi.sum()
    matrix = np.zeros((18, 18))
    n = 2 * N_UNIFORMS
    for (here, (m, noise)), new, i in product(enumerate(states), noises, range(n)):
        estimates, priors = terms(m, noise)
        proposed = terms(1 - m, new)
        moved = accept(estimates, priors, *proposed, np.log((i + 0.5) / n))
        there = states.index((1 - m, new)) if moved else here
        matrix[here, there] += NOISE[list(new)].prod() / n
    assert imbalance(pi, matrix) < 1e-14


def test_a_record_whose_density_is_zero_rejects_alone():
    accepted = np.zeros(2, dtype=np.int64)
    estimates, priors = np.zeros(3), np.zeros(3)
    new = np.array([-np.inf, 1.0, 0.0])
    each(estimates, priors, new, np.zeros(3), np.array([-9.0, -9.0]), accepted)
    assert accepted.tolist() == [0, 1]
    assert estimates.tolist() == [0.0, 1.0, 0.0]
