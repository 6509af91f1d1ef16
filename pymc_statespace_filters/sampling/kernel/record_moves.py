"""Iterations of a chain on a panel in machine code: every record, shared parameters, population.

The posterior of own parameters x_1 .. x_G, shared ones s and those of the population m is, up to a
constant::

    pi(m, s) prod_g p(x_g | m, s) L_g(x_g, s)

Given m and s the records are independent. An iteration is therefore made of moves each of which
keeps this distribution:

* All records propose at once, each by its own random walk, and one evaluation gives new estimates
  of all L_g. Record g accepts with probability min(1, p(z_g) L_g(z_g) / (p(x_g) L_g(x_g))) and then
  keeps its new estimate, whatever the others do. The noise of one record alone thus decides on its
  acceptance, however many there are.
* The shared block is proposed, all L_g are estimated with fresh noise, and their product decides.
* The population makes several moves, accepted by the densities of the own parameters alone. No
  likelihood depends on it.

Where the likelihoods depend on c_g = a + b x_g, with a and b functions of m and s, these moves are
those of c_g, whose density has the factor 1 / |b|; draws are recorded as x_g. They mix well if the
data of each record say more about c_g than the population does. If they say less, x_g is nearly
independent of a and b, and c_g is not. So there is a fourth move, of the same posterior: what a and
b are made of is proposed at the same x_g, which changes all L_g, as the shared block does. Chains
that move in the one and the other coordinates in turn mix about as well as in the better ones. The
fourth move is made, too, where c_g is a variable of the model and a and b are the location and the
scale of its prior; draws are then recorded as c_g.

Every estimate belongs to the point at which it was made, and is kept until its record moves or the
shared block does. The noise of the records is independent, so that each move is one of Andrieu and
Roberts on a part of the state, and exact for the expected likelihoods. There is no delayed
rejection: a second proposal of the few records that have rejected costs an evaluation of all.

References
----------
C. Andrieu and G. O. Roberts (2009). The pseudo-marginal approach for efficient Monte Carlo
computations. Annals of Statistics 37, 697-725.
Y. Yu and X.-L. Meng (2011). To center or not to center: that is not the question - an
ancillarity-sufficiency interweaving strategy (ASIS) for boosting MCMC efficiency. Journal of
Computational and Graphical Statistics 20, 531-570.
"""

import numpy as np

from ...compiler.native.entry_point import njit_cached
from ...compiler.native.jit import copy_into, linked
from ...filters.outcomes import RAISED
from .adaptation import learn
from .adaptation_state import packed_size, unpack
from .delayed_rejection import log_ratio_to_one
from .record_arrays import (
    FIRST_ACCEPTED,
    FIRST_ESTIMATE,
    centre,
    evaluate_likelihoods,
    evaluate_priors,
    write_standard,
)
from .state import (
    ACCEPTANCE,
    FAILURE,
    LOG_DENSITY,
    N_DONE,
    N_EFFECTIVE,
    N_EVALUATIONS,
    N_FAILED,
    PAUSE_REQUESTED,
    SCALING,
    STAGE,
)

_internal = linked()


@_internal
def accept_records(estimates, priors, new_estimates, new_priors, log_uniforms, accepted):
    """Accept the proposals of single records, each by its own terms, which are changed in place.

    The log-densities (G + 1,) by record are those at the current point, as estimated when it was
    accepted, and at the proposed ones; there are as many ``log_uniforms`` as records, or more.
    ``accepted`` (G,) is set to 1 where a proposal is, else to 0. Returns the mean acceptance
    probability.
    """
    n_records, total = accepted.size, 0.0
    for g in range(n_records):
        log_alpha = log_ratio_to_one(new_estimates[g] + new_priors[g], estimates[g] + priors[g])
        total += np.exp(log_alpha)
        accepted[g] = 1 if log_uniforms[g] < log_alpha else 0
        if accepted[g]:
            estimates[g], priors[g] = new_estimates[g], new_priors[g]
    return total / n_records


@_internal
def accept_all(estimates, priors, new_estimates, new_priors, log_uniform):
    """Accept a proposal that changes the terms of all records, by their sum; change them in place.

    Arguments as of `accept_records`; returns whether it was accepted.
    """
    here, there = _total(estimates, priors), _total(new_estimates, new_priors)
    if log_uniform < log_ratio_to_one(there, here):
        copy_into(estimates, new_estimates)
        copy_into(priors, new_priors)
        return True
    return False


@_internal
def _total(estimates, priors):
    total = 0.0
    for i in range(estimates.size):
        total += estimates[i] + priors[i]
    return total


@_internal
def _propose(state, density, block, chol, normals):
    """Propose new values of a block, by the random walk with this factor."""
    for i in range(block.size):
        moved = state.position[block[i]]
        for j in range(i + 1):
            moved += chol[i, j] * normals[j]
        density.position[block[i]] = moved


@_internal
def _take_block(target, source, block):
    for i in range(block.size):
        target[block[i]] = source[block[i]]


@_internal
def _learn(settings, adaptation, state, block, accepted):
    """Adapt the proposals of a block to its values after a move."""
    values = np.empty(block.size)
    for i in range(block.size):
        values[i] = state.position[block[i]]
    learn(settings.adapt_every, settings.continuous, adaptation, values, accepted, False)


@_internal
def _count(counts, found, n_evaluated):
    counts[N_EVALUATIONS] += n_evaluated
    counts[N_FAILED] += found.n_failed
    if found.failure != 0:
        counts[FAILURE] = found.failure


@_internal
def _move_records(settings, density, layout, state, random, k, terms, counts):
    """All records propose and accept, each for itself; the mean acceptance probability."""
    estimates, priors, new_estimates, new_priors = terms
    n_records, size = layout.own.shape
    length = packed_size(size)
    for g in range(n_records):
        adaptation = unpack(state.adaptation[g * length : (g + 1) * length], size)
        _propose(state, density, layout.own[g], adaptation.chol, random.own[k, g])
    copy_into(density.seeds, random.seeds[k, 0])
    found = evaluate_likelihoods(density, new_estimates)
    _count(counts, found, n_records)
    if found.failure == RAISED or not evaluate_priors(density, new_priors):
        counts[FAILURE] = RAISED
        return 0.0
    accepted = counts[FIRST_ACCEPTED : FIRST_ACCEPTED + n_records]
    acceptance = accept_records(
        estimates, priors, new_estimates, new_priors, random.log_uniforms[k], accepted
    )
    for g in range(n_records):
        if accepted[g]:
            _take_block(state.position, density.position, layout.own[g])
            for i in range(layout.seeds.shape[1]):
                place = layout.seeds[g, i]
                state.seeds[place] = density.seeds[layout.columns[place]]
            counts[STAGE] = 1
        else:
            _take_block(density.position, state.position, layout.own[g])
        if settings.adapts:
            adaptation = unpack(state.adaptation[g * length : (g + 1) * length], size)
            _learn(settings, adaptation, state, layout.own[g], accepted[g])
    return acceptance


@_internal
def _move_shared(settings, density, layout, state, random, k, terms, counts):
    """The shared parameters are accepted by the likelihoods of all records."""
    estimates, priors, new_estimates, new_priors = terms
    n_records, own_size = layout.own.shape
    block = layout.shared
    first = n_records * packed_size(own_size)
    adaptation = unpack(state.adaptation[first : first + packed_size(block.size)], block.size)
    _propose(state, density, block, adaptation.chol, random.shared[k])
    copy_into(density.seeds, random.seeds[k, 1])
    found = evaluate_likelihoods(density, new_estimates)
    _count(counts, found, n_records)
    if found.failure == RAISED or not evaluate_priors(density, new_priors):
        counts[FAILURE] = RAISED
        return
    log_uniform = random.log_uniforms[k, n_records]
    if accept_all(estimates, priors, new_estimates, new_priors, log_uniform):
        _take_block(state.position, density.position, block)
        for place in range(state.seeds.size):
            state.seeds[place] = density.seeds[layout.columns[place]]
        counts[STAGE] = counts[FIRST_ACCEPTED + n_records] = 1
    else:
        _take_block(density.position, state.position, block)
    if settings.adapts:
        _learn(settings, adaptation, state, block, counts[FIRST_ACCEPTED + n_records])


@_internal
def _move_interwoven(settings, density, layout, state, random, k, terms, counts):
    """What locations and scales are made of moves at the same standard values."""
    estimates, priors, new_estimates, new_priors = terms
    n_records, block = layout.own.shape[0], layout.interwoven
    first = state.adaptation.size - packed_size(block.size)
    adaptation = unpack(state.adaptation[first:], block.size)
    standard = np.empty(state.position.size)
    n_standard = layout.centred.size
    jacobian = write_standard(density, layout, state, standard, n_standard)
    _propose(state, density, block, adaptation.chol, random.interwoven[k])
    _take_block(density.position, standard, layout.centred)
    new_jacobian = centre(density, layout, n_standard)
    copy_into(density.seeds, random.seeds[k, -1])
    found = evaluate_likelihoods(density, new_estimates)
    _count(counts, found, n_records)
    if found.failure == RAISED or not evaluate_priors(density, new_priors):
        counts[FAILURE] = RAISED
        return
    here = _total(estimates, priors) - jacobian
    there = _total(new_estimates, new_priors) - new_jacobian
    is_possible = there > -np.inf  # not NaN, as of a scale beyond all numbers
    accepted = is_possible and random.log_uniforms[k, -1] < log_ratio_to_one(there, here)
    if accepted:
        copy_into(estimates, new_estimates)
        copy_into(priors, new_priors)
        copy_into(state.position, density.position)
        for place in range(state.seeds.size):
            state.seeds[place] = density.seeds[layout.columns[place]]
        counts[STAGE] = 1
    else:
        copy_into(density.position, state.position)
    if settings.adapts:
        _learn(settings, adaptation, state, block, 1 if accepted else 0)


@_internal
def _move_population(settings, density, layout, state, random, k, terms, counts):
    """Several moves of the population, which evaluate no likelihood."""
    estimates, priors, _, new_priors = terms
    n_records, own_size = layout.own.shape
    block = layout.population
    first = n_records * packed_size(own_size) + packed_size(layout.shared.size)
    adaptation = unpack(state.adaptation[first : first + packed_size(block.size)], block.size)
    for move in range(random.population.shape[1]):
        _propose(state, density, block, adaptation.chol, random.population[k, move])
        if not evaluate_priors(density, new_priors):
            counts[FAILURE] = RAISED
            return
        log_uniform = random.log_uniforms[k, n_records + 1 + move]
        accepted = accept_all(estimates, priors, estimates, new_priors, log_uniform)
        if accepted:
            _take_block(state.position, density.position, block)
            counts[STAGE] = 1
            counts[FIRST_ACCEPTED + n_records + 1] += 1
        else:
            _take_block(density.position, state.position, block)
        if settings.adapts:
            _learn(settings, adaptation, state, block, 1 if accepted else 0)


@_internal
def _scaling(layout, state):
    """Geometric mean of the standard deviations along the axes of the records' proposals."""
    n_records, size = layout.own.shape
    length, total = packed_size(size), 0.0
    for g in range(n_records):
        chol = unpack(state.adaptation[g * length : (g + 1) * length], size).chol
        for i in range(size):
            total += np.log(chol[i, i])
    return np.exp(total / (n_records * size))


@njit_cached
def advance_records(settings, density, layout, state, random, first, draws, row, n, control):
    """Make up to n iterations, with random numbers from row ``first``, recorded from ``row``.

    Returns the number of iterations made: fewer than n if a pause was requested or the model
    raised. The state is that after the last of them.
    """
    estimates = state.numbers[FIRST_ESTIMATE:]
    priors = np.empty(estimates.size)
    terms = (estimates, priors, np.empty(estimates.size), np.empty(estimates.size))
    scaling = _scaling(layout, state)
    done = 0
    while done < n and control[PAUSE_REQUESTED] == 0:
        at, k = row + done, first + done
        counts, numbers = draws.counts[at], draws.numbers[at]
        for i in range(counts.size):
            counts[i] = 0
        # Computed anew, so that an iteration depends on the state alone.
        copy_into(density.position, state.position)
        if not evaluate_priors(density, priors):
            break
        acceptance = _move_records(settings, density, layout, state, random, k, terms, counts)
        if counts[FAILURE] != RAISED and layout.shared.size > 0:
            _move_shared(settings, density, layout, state, random, k, terms, counts)
        if counts[FAILURE] != RAISED and layout.interwoven.size > 0:
            _move_interwoven(settings, density, layout, state, random, k, terms, counts)
        if counts[FAILURE] != RAISED and layout.population.size > 0:
            _move_population(settings, density, layout, state, random, k, terms, counts)
        if counts[FAILURE] == RAISED:
            break
        log_jacobian = write_standard(
            density, layout, state, draws.positions[at], layout.n_standard
        )
        state.numbers[LOG_DENSITY] = _total(estimates, priors) - log_jacobian
        copy_into(draws.seeds[at], state.seeds)
        numbers[LOG_DENSITY] = state.numbers[LOG_DENSITY]
        numbers[N_EFFECTIVE] = state.numbers[N_EFFECTIVE]
        numbers[ACCEPTANCE], numbers[SCALING] = acceptance, scaling
        if settings.adapts:
            scaling = _scaling(layout, state)
        done += 1
        control[N_DONE] += 1
    return done
