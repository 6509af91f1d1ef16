"""What a plan says of a deterministic filter, and calls of its functions."""

from typing import NamedTuple

import numpy as np

from ...compiler.codegen.arguments import LANES_AT_ONCE, LaneArguments
from ...compiler.native.entry_point import call_address
from ...compiler.native.jit import inline_always, njit_internal
from ..plan import PLAN, reals_of

STRETCH = 32  # steps; the states of all lanes fit into the processor's cache


class Rows(NamedTuple):
    """The first row of each vector in ``W``, and the first free row.

    ``cov`` are covariances, ``seen`` is 1 in the lanes that observe, else 0, and ``term`` holds the
    term of an update or, on the way back, its cotangent.
    """

    theta: int
    cov: int
    d: int
    seen: int
    term: int
    s_bar: int
    c_bar: int
    x: int
    moments: int
    free: int


@njit_internal
def rows_of_vectors(n_theta, n_cov, p, size, n):
    """Where vectors are, for so many parameters, elements of covariances, observables and states.

    ``x`` and ``moments`` are for states, see `states`.
    """
    d = n_theta + n_cov
    s_bar = d + p + 2
    c_bar = s_bar + size
    x = c_bar + n_theta
    return Rows(
        theta=0, cov=n_theta, d=d, seen=d + p, term=d + p + 1, s_bar=s_bar, c_bar=c_bar, x=x,
        moments=x + n, free=x + 4 * n,
    )  # fmt: skip


class Machine(NamedTuple):
    """What a plan says: sizes, where vectors are, and the functions by address.

    ``width`` is the number of lanes, of which a record alone has one.
    """

    n: int
    size: int
    n_theta: int
    n_inputs: int
    n_noises: int
    p: int
    width: int
    n_rows: int
    dt: float
    has_gaussian_observation: bool
    rows: Rows
    start: int
    along: int
    along_back: int
    predict: int
    update: int
    prepare_back: int
    predict_back: int
    update_back: int
    finish_back: int
    smooth: int


@njit_internal
def read_machine(plan):
    """Unpack a plan."""
    n_theta, size, n, p = plan[PLAN.n_theta], plan[PLAN.state_size], plan[PLAN.n], plan[PLAN.p]
    width = plan[PLAN.n_lanes]
    return Machine(
        n=n, size=size, n_theta=n_theta, n_inputs=plan[PLAN.n_inputs],
        n_noises=plan[PLAN.n_noises], p=p, width=width, n_rows=plan[PLAN.n_rows],
        dt=reals_of(plan)[PLAN.dt],
        has_gaussian_observation=plan[PLAN.has_gaussian_observation] != 0,
        rows=rows_of_vectors(n_theta, plan[PLAN.n_covariances], p, size, n),
        start=plan[PLAN.start], along=plan[PLAN.along], along_back=plan[PLAN.along_back],
        predict=plan[PLAN.predict], update=plan[PLAN.update],
        prepare_back=plan[PLAN.prepare_back], predict_back=plan[PLAN.predict_back],
        update_back=plan[PLAN.update_back], finish_back=plan[PLAN.finish_back],
        smooth=plan[PLAN.smooth],
    )  # fmt: skip


class Work(NamedTuple):
    """Memory of a pass: rows of vectors, states of a stretch and of an update at its end, inputs.

    They begin at a multiple of 64 bytes, which a vector instruction reads at once.
    """

    W: np.ndarray
    states: np.ndarray
    forces: np.ndarray


@njit_internal
def workspace(machine):
    """The memory of a pass, zeros."""
    m, n_forces = machine, machine.n_inputs + machine.n_noises
    n_steps = STRETCH if m.width > 1 else 0
    n_numbers = m.n_rows + (n_steps + 2) * m.size + (n_steps + 1) * n_forces
    whole = np.zeros(n_numbers * m.width + 8)
    first = (-whole.ctypes.data % 64) // 8
    second = first + m.n_rows * m.width
    third = second + (n_steps + 2) * m.size * m.width
    return Work(whole[first:second], whole[second:third], whole[third:])


@inline_always
def rows_at(machine, W, first, n):
    """Some rows of lanes, without a copy."""
    return W[first * machine.width : (first + n) * machine.width]


@njit_internal
def call(function, machine, n_lanes, work, states, forces, t0, k, n_steps):
    """Call a function from step k on, with states and inputs that begin there."""
    arguments = LaneArguments(
        W=work.W, n_lanes=n_lanes, states=states, forces=forces, t0=t0, dt=machine.dt, k=k,
        n_steps=n_steps,
    )  # fmt: skip
    call_address(function, arguments)


@njit_internal
def n_lanes_of(machine, records):
    """The number of lanes that the records of a group take."""
    return min(-(-records.shape[0] // LANES_AT_ONCE) * LANES_AT_ONCE, machine.width)
