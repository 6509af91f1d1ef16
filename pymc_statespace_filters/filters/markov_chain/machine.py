"""The tables of a finite system as the settings of a plan, and read from them again."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...compiler.codegen.arguments import MemberArguments
from ...compiler.native.entry_point import call_address
from ...compiler.native.jit import inline_always, njit_internal
from ..outcomes import INVALID_PROBABILITY, NONE
from ..plan import NULL, PLAN, read_system, reals_of, settings_of

# Observations whose densities are computed at once have about so many numbers in all.
_AT_ONCE = 256

# What the settings begin with: the numbers of states, moves, starts, different moves and states, of
# values drawn in a step and at the start, of derivatives of each function, and two flags.
N_SIZES = 12


def sizes_and_tables(
    *,
    table: np.ndarray,
    origin: np.ndarray,
    successor: np.ndarray,
    move_states: np.ndarray,
    move_values: np.ndarray,
    move_number: np.ndarray,
    start_values: np.ndarray,
    start_state: np.ndarray,
    emission_states: np.ndarray,
    emission_number: np.ndarray,
    start_rows: Sequence[int],
    move_rows: Sequence[int],
    emission_rows: Sequence[int],
    is_invariant: bool,
    one_by_one: bool,
) -> tuple[float, ...]:
    """The settings of a plan, in the order in which `read_chain` reads them."""
    sizes = (
        len(table), len(origin), len(start_state), len(move_states), len(emission_states),
        move_values.shape[1], start_values.shape[1], len(start_rows), len(move_rows),
        len(emission_rows), is_invariant, one_by_one,
    )  # fmt: skip
    tables = (
        table.T, origin, successor, move_states.T, move_values.T, move_number, start_values.T,
        start_state, emission_states.T, emission_number, start_rows, move_rows, emission_rows,
    )  # fmt: skip
    parts = [np.asarray(part, dtype="float64").ravel() for part in (sizes, *tables)]
    return tuple(np.concatenate(parts).tolist())


class Chain(NamedTuple):
    """One evaluation: the tables, the functions by address, and the constants ``c``.

    Of ``n_states`` states, X has the columns. The moves to state i are those from ``first_move[i]``
    to ``first_move[i + 1]``, exclusive. Moves go from ``origin`` to ``successor``, with the
    probability number ``move_number``, a function of the columns of ``move_X`` and ``move_V``; the
    log-density of an observation in a state is number ``emission_number`` of those at
    ``emission_X``. ``..._rows`` are the elements of theta in the rows of derivatives.
    """

    failure: int
    n_states: int
    p: int
    dt: float
    is_invariant: bool
    n_at_once: int
    X: np.ndarray
    origin: np.ndarray
    successor: np.ndarray
    first_move: np.ndarray
    move_X: np.ndarray
    move_V: np.ndarray
    move_number: np.ndarray
    start_V: np.ndarray
    start_state: np.ndarray
    emission_X: np.ndarray
    emission_number: np.ndarray
    start_rows: np.ndarray
    move_rows: np.ndarray
    emission_rows: np.ndarray
    c: np.ndarray
    start: int
    move: int
    emission: int
    start_back: int
    move_back: int
    emission_back: int


@njit_internal
def _whole(values, size):
    """The first elements as integers."""
    out = np.empty(size, np.int64)
    for i in range(size):
        out[i] = int(values[i])
    return out


@inline_always
def n_states_of(plan):
    """The number of states; the state of the filter is a step, and their probabilities."""
    return plan[PLAN.state_size] - 1


@njit_internal
def read_chain(plan, theta, inputs):
    """Unpack a plan, and prepare the constants of one evaluation."""
    system, settings = read_system(plan, theta, inputs), settings_of(plan)
    size = _whole(settings, N_SIZES)
    K, M, S, U, D = size[0], size[1], size[2], size[3], size[4]
    n, n_v, n_start = plan[PLAN.n], size[5], size[6]
    lengths = (
        n * K, M, M, n * U, n_v * U, M, n_start * S, S, n * D, K, size[7], size[8], size[9]
    )  # fmt: skip
    at = np.empty(len(lengths) + 1, np.int64)
    at[0] = N_SIZES
    for i in range(len(lengths)):
        at[i + 1] = at[i] + lengths[i]
    n_at_once = 1 if size[11] != 0 else max(_AT_ONCE // D, 1)
    successor, first_move = _whole(settings[at[2] :], M), np.zeros(K + 1, np.int64)
    for m in range(M):
        first_move[successor[m] + 1] = m + 1
    for i in range(K):  # to a state without moves lead none
        first_move[i + 1] = max(first_move[i + 1], first_move[i])
    return Chain(
        failure=system.failure, n_states=K, p=plan[PLAN.p],
        dt=reals_of(plan)[PLAN.dt], is_invariant=size[10] != 0,
        n_at_once=n_at_once,
        X=settings[at[0] : at[1]].reshape((n, K)),
        origin=_whole(settings[at[1] :], M), successor=successor, first_move=first_move,
        move_X=settings[at[3] : at[4]].reshape((n, U)),
        move_V=settings[at[4] : at[5]].reshape((n_v, U)),
        move_number=_whole(settings[at[5] :], M),
        start_V=settings[at[6] : at[7]].reshape((n_start, S)),
        start_state=_whole(settings[at[7] :], S),
        emission_X=settings[at[8] : at[9]].reshape((n, D)),
        emission_number=_whole(settings[at[9] :], K),
        start_rows=_whole(settings[at[10] :], size[7]),
        move_rows=_whole(settings[at[11] :], size[8]),
        emission_rows=_whole(settings[at[12] :], size[9]),
        c=system.c, start=plan[PLAN.start], move=plan[PLAN.predict], emission=plan[PLAN.update],
        start_back=plan[PLAN.finish_back], move_back=plan[PLAN.predict_back],
        emission_back=plan[PLAN.update_back],
    )  # fmt: skip


@njit_internal
def call_members(function, c, inputs, k, t, Z, X, out):
    """Call a function of members, whose values are the columns of Z and X."""
    arguments = MemberArguments(
        c=c, inputs=inputs, k=k, t=t, z=Z, width=np.int64(X.shape[1]), X=X, out=out,
        n_members=np.int64(X.shape[1]),
    )  # fmt: skip
    call_address(function, arguments)


@njit_internal
def start_probabilities(chain, inputs, first):
    """Write the probabilities of all states at step 0; a failure if one of them is none."""
    S = chain.start_state.size
    given, X = np.empty((1, S)), np.zeros((chain.X.shape[0], S))
    call_members(chain.start, chain.c, inputs, NULL, 0.0, chain.start_V, X, given)
    first[:] = 0.0
    for i in range(S):
        first[chain.start_state[i]] += given[0, i]
    return np.int64(INVALID_PROBABILITY if np.isnan(first.sum()) else NONE)


@njit_internal
def move_probabilities(chain, inputs, k, t0, different, P):
    """Write the probabilities P (M,) of all moves from step k to k + 1, with room (1, U)."""
    t, total = t0 + k * chain.dt, 0.0
    call_members(chain.move, chain.c, inputs, k, t, chain.move_V, chain.move_X, different)
    for m in range(P.size):
        P[m] = different[0, chain.move_number[m]]
        total += P[m]
    return np.int64(INVALID_PROBABILITY if np.isnan(total) else NONE)


@njit_internal
def room_for_moves(chain):
    """Arrays for the probabilities of different moves, (1, U), and of all, (M,)."""
    return np.empty((1, chain.move_X.shape[1])), np.empty(chain.origin.size)
