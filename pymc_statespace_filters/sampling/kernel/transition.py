"""The iterations of a chain in machine code: propose, evaluate, accept, adapt, record.

PyMC's step method calls it for one iteration at a time, ``sample_dram`` for many. An iteration
proposes by a random walk with delayed rejection, or from a mixture (see `independence`).

With a noisy likelihood every proposal of every stage has its own noise, and the estimate at the
current point is kept. The densities of the noise then cancel in Eq. 3.32, so that the chain is
exact for prior times expected likelihood, with any number of stages.

With a screen the whole move runs on a cheap density, and the expensive one is
evaluated only at its end point, once, with fresh noise, see `log_surrogate_acceptance`.

References
----------
C. Andrieu and G. O. Roberts (2009). The pseudo-marginal approach for efficient Monte Carlo
computations. Annals of Statistics 37, 697-725.
"""

from typing import NamedTuple

import numpy as np

from ...compiler.native.entry_point import njit_cached
from ...compiler.native.jit import copy_into, linked
from ...compiler.native.pytensor_function import make_call
from ...filters.outcomes import NOT_A_NUMBER, RAISED
from .adaptation import learn
from .adaptation_state import unpack
from .delayed_rejection import gaussian_log_acceptance, walk_size
from .independence import (
    SHARE,
    ProposalMixture,
    draw_from_mixture,
    log_mixture_density,
    unpack_mixture,
)
from .state import (
    ACCEPTANCE,
    FAILURE,
    HEALTH_SIZE,
    INDEPENDENT,
    LOG_DENSITY,
    LOG_SCREEN,
    N_ACCEPTED,
    N_DONE,
    N_EFFECTIVE,
    N_EVALUATIONS,
    N_FAILED,
    N_SCREEN_FAILED,
    N_SCREENED,
    PAUSE_REQUESTED,
    SCALING,
    STAGE,
    Evaluation,
)


@linked()
def log_surrogate_acceptance(
    log_pi_here: float, log_pi_there: float, log_c_here: float, log_c_there: float
) -> float:
    """Log-probability of accepting a move of a kernel reversible for c, a surrogate of the target.

    Let K be any such kernel, here delayed rejection on a screen. From y it moves to z, and the
    chain goes there with probability (Liu 2001, section 9.4.3)::

        min(1, pi(z) c(y) / (pi(y) c(z)))

    For z other than y, pi(y) K(y, z) times this is K(y, z) c(y) min(pi(y) / c(y), pi(z) / c(z)),
    which is symmetric in y and z: the chain is reversible for pi, for any c. But points where c is
    zero and pi is not are never reached.

    Parameters
    ----------
    log_pi_here, log_pi_there : float
        Log-density of the target at y and z, up to one constant. May be minus infinity, but not NaN
        or plus infinity.
    log_c_here, log_c_there : float
        Log-density of the surrogate there, likewise.

    Returns
    -------
    float
        In [-inf, 0]; 0/0 counts as zero.

    References
    ----------
    J. S. Liu (2001). Monte Carlo Strategies in Scientific Computing. Springer.

    Examples
    --------
    The surrogate has already accounted for the change of density:

    >>> log_surrogate_acceptance.py_func(0.0, -1.5, 0.0, -1.5)
    0.0
    >>> log_surrogate_acceptance.py_func(0.0, -1.5, 0.0, -1.0)
    -0.5
    """
    if log_pi_there == -np.inf or log_c_here == -np.inf:
        return -np.inf
    return min(0.0, (log_pi_there - log_c_there) - (log_pi_here - log_c_here))


class _Move(NamedTuple):
    """Result of a proposal or several; an accepted point is in the arrays of the density."""

    stage: int
    value: Evaluation
    acceptance: float
    n_evaluations: int
    n_failed: int
    failure: int


class _Laws(NamedTuple):
    """What proposals are drawn from."""

    chol: np.ndarray  # (d, d), of the random walk's first stage
    mixture: ProposalMixture


_internal = linked()


@njit_cached
def evaluate(density):
    """Evaluate a `NativeLogDensity` at the position and seeds in its arrays.

    The log-density is never NaN or plus infinity: a failed evaluation gives minus infinity and a
    failure code.
    """
    if not make_call(density.call):
        return Evaluation(-np.inf, RAISED, 0.0)
    out, n_effective = density.call.out, np.inf
    for i in range(density.n_healths):
        at = 3 + HEALTH_SIZE * i  # behind the log-densities of posterior and prior
        n_effective = min(n_effective, out[at])
        if out[at + 1] != 0.0:
            return Evaluation(-np.inf, int(out[at + 1]), n_effective)
    if not out[1] < np.inf:
        return Evaluation(-np.inf, NOT_A_NUMBER, n_effective)
    return Evaluation(out[1], 0, n_effective)


@_internal
def _delayed_rejection(density, log_density, position, chol, size, settings, random, k):
    """Propose stage by stage until a proposal is accepted (thesis, Eqs. 3.30-3.32)."""
    dim = position.size
    log_pi = np.empty(settings.n_stages + 1)
    log_pi[0] = log_density
    offsets = np.zeros((settings.n_stages + 1, dim))
    acceptance, scale, n_failed, failure = 0.0, 1.0, 0, 0
    value = Evaluation(log_density, 0, np.inf)
    for stage in range(1, settings.n_stages + 1):
        for i in range(dim):
            offsets[stage, i] = random.normals[k, stage - 1, i] * scale
        for i in range(dim):
            moved = position[i]
            for j in range(i + 1):
                moved += size * chol[i, j] * offsets[stage, j]
            density.position[i] = moved
        copy_into(density.seeds, random.seeds[k, stage - 1])
        value = evaluate(density)
        if value.failure != 0:
            n_failed, failure = n_failed + 1, value.failure
            if failure == RAISED:
                break
        log_pi[stage] = value.log_density
        log_alpha = gaussian_log_acceptance(log_pi, offsets, settings.stage_scale, stage)
        if stage == 1:
            acceptance = np.exp(log_alpha)
        if random.log_uniforms[k, stage - 1] < log_alpha:
            return _Move(stage, value, acceptance, stage, n_failed, failure)
        scale *= settings.stage_scale
    return _Move(0, value, acceptance, settings.n_stages, n_failed, failure)


@_internal
def _independence(density, log_density, position, mixture, random, k):
    """Propose a point of the mixture, wherever the chain is."""
    normals, spread = random.normals[k, 0], random.spreads[k]
    draw_from_mixture(mixture, normals, spread, random.choices[k, 1], density.position)
    copy_into(density.seeds, random.seeds[k, 0])
    value = evaluate(density)
    # The mixture takes the place of a surrogate's density.
    log_alpha = log_surrogate_acceptance(
        log_density,
        value.log_density,
        log_mixture_density(mixture, position),
        log_mixture_density(mixture, density.position),
    )
    failed = 1 if value.failure != 0 else 0
    stage = 1 if random.log_uniforms[k, 0] < log_alpha else 0
    return _Move(stage, value, np.exp(log_alpha), 1, failed, value.failure)


@_internal
def _propose(density, log_density, state, settings, laws, random, k, is_free):
    """Make the proposals of an iteration on a density."""
    if is_free:
        return _independence(density, log_density, state.position, laws.mixture, random, k)
    size = walk_size(random.choices[k, 1])
    return _delayed_rejection(
        density, log_density, state.position, laws.chol, size, settings, random, k
    )


@_internal
def _set_current(state, density, value, log_screen):
    """Take the point just evaluated, and its estimate, as the current state."""
    copy_into(state.position, density.position)
    copy_into(state.seeds, density.seeds)
    state.numbers[LOG_DENSITY] = value.log_density
    state.numbers[N_EFFECTIVE] = value.n_effective
    state.numbers[LOG_SCREEN] = log_screen
    first = density.call.out.size - state.carried.size
    copy_into(state.carried, density.call.out[first:])


@_internal
def _move(settings, target, state, laws, random, k, is_free, counts):
    """One iteration without a screen; the acceptance probability of its first proposal."""
    log_density = state.numbers[LOG_DENSITY]
    move = _propose(target, log_density, state, settings, laws, random, k, is_free)
    if move.stage > 0:
        _set_current(state, target, move.value, 0.0)
    counts[STAGE], counts[N_EVALUATIONS] = move.stage, move.n_evaluations
    counts[N_FAILED], counts[FAILURE] = move.n_failed, move.failure
    counts[N_SCREENED], counts[N_SCREEN_FAILED] = 0, 0
    return move.acceptance


@_internal
def _screened_move(settings, target, screen, state, laws, random, k, is_free, counts):
    """One iteration on a screen; the probability of accepting its end point."""
    log_screen = state.numbers[LOG_SCREEN]
    move = _propose(screen, log_screen, state, settings, laws, random, k, is_free)
    counts[STAGE], counts[N_EVALUATIONS] = 0, 0
    counts[N_FAILED], counts[FAILURE] = 0, RAISED if move.failure == RAISED else 0
    counts[N_SCREENED], counts[N_SCREEN_FAILED] = move.n_evaluations, move.n_failed
    if move.stage == 0:
        return 0.0
    copy_into(target.position, screen.position)
    copy_into(target.seeds, random.seeds[k, 0])
    value = evaluate(target)
    counts[N_EVALUATIONS], counts[FAILURE] = 1, value.failure
    if value.failure != 0:
        counts[N_FAILED] = 1
        return 0.0
    log_alpha = log_surrogate_acceptance(
        state.numbers[LOG_DENSITY], value.log_density, log_screen, move.value.log_density
    )
    if random.log_uniforms[k, settings.n_stages] < log_alpha:
        _set_current(state, target, value, move.value.log_density)
        counts[STAGE] = move.stage
    return np.exp(log_alpha)


@_internal
def _scaling(chol):
    """Geometric mean of the standard deviations along the axes of the proposal."""
    total = 0.0
    for i in range(chol.shape[0]):
        total += np.log(chol[i, i])
    return np.exp(total / chol.shape[0])


@njit_cached
def advance(settings, target, screen, state, random, first, draws, row, n, control):
    """Make up to n iterations, with random numbers from row ``first``, recorded from ``row``.

    Returns the number of iterations made: fewer than n if a pause was requested or the model
    raised. The state is that after the last of them.
    """
    adapted = unpack(state.adaptation, state.position.size)
    mixture = unpack_mixture(state.mixture, state.position.size)
    laws = _Laws(adapted.chol, mixture)
    scaling = _scaling(adapted.chol)
    done = 0
    while done < n and control[PAUSE_REQUESTED] == 0:
        at, k = row + done, first + done
        counts, numbers = draws.counts[at], draws.numbers[at]
        is_free = random.choices[k, 0] < mixture.numbers[SHARE]
        if settings.screened:
            acceptance = _screened_move(
                settings, target, screen, state, laws, random, k, is_free, counts
            )
        else:
            acceptance = _move(settings, target, state, laws, random, k, is_free, counts)
        if counts[FAILURE] == RAISED:
            break
        counts[INDEPENDENT] = is_free
        counts[N_ACCEPTED] = 1 if counts[STAGE] > 0 else 0
        copy_into(draws.positions[at], state.position)
        copy_into(draws.seeds[at], state.seeds)
        numbers[LOG_DENSITY] = state.numbers[LOG_DENSITY]
        numbers[N_EFFECTIVE] = state.numbers[N_EFFECTIVE]
        numbers[ACCEPTANCE], numbers[SCALING] = acceptance, scaling
        if at < draws.covs.shape[0]:
            for i in range(state.position.size):
                copy_into(draws.covs[at, i], adapted.cov[i])
        if settings.adapts:
            # A small walk is accepted whatever the covariance, and says nothing about it.
            is_small = not is_free and walk_size(random.choices[k, 1]) < 1.0
            learn(
                settings.adapt_every,
                settings.continuous,
                adapted,
                state.position,
                0 if is_small else counts[STAGE],
                is_free or is_small,
            )
            scaling = _scaling(adapted.chol)
        done += 1
        control[N_DONE] += 1
    return done
