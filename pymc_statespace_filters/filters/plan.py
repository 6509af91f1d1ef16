"""The plan of a filter for one system: sizes, the system's functions by address, and settings.

`make_plan` packs it into words, `read_system` unpacks it. Both use the names of `PLAN`, so that no
code refers to a slot by its number.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import carray

from ..compiler.codegen.arguments import FollowArguments, LookBackArguments, MemberArguments
from ..compiler.native.cache_key import key_of
from ..compiler.native.entry_point import EntryPoint, call_address, pointer
from ..compiler.native.jit import inline_always, njit_internal
from ..compiler.native.plan import N_HEADER, Plan, version_of
from ..compiler.native.slots import known_when_compiled
from .outcomes import INITIAL_COV, NONE, OBSERVATION_NOISE, PROCESS_NOISE
from .protocol import System


@known_when_compiled
class PlanSlots(NamedTuple):
    """Places in a plan behind the header; the free states follow, then the settings."""

    n: int = N_HEADER + 0
    m: int = N_HEADER + 1
    p: int = N_HEADER + 2
    n_inputs: int = N_HEADER + 3
    n_theta: int = N_HEADER + 4
    n_constants: int = N_HEADER + 5
    n_free: int = N_HEADER + 6
    n_settings: int = N_HEADER + 7
    dt: int = N_HEADER + 8  # a real number
    is_time_invariant: int = N_HEADER + 9
    has_gaussian_observation: int = N_HEADER + 10
    observation_uses_inputs: int = N_HEADER + 11
    # functions of the system, 0 for those that the filter does not use
    prepare: int = N_HEADER + 12
    initialise: int = N_HEADER + 13
    propagate: int = N_HEADER + 14
    observe: int = N_HEADER + 15
    log_density: int = N_HEADER + 16
    step_moments: int = N_HEADER + 17
    propagate_guided: int = N_HEADER + 18
    observation_information: int = N_HEADER + 19
    follow: int = N_HEADER + 20
    look_back: int = N_HEADER + 21
    start_back: int = N_HEADER + 22
    # of filters with members
    n_members: int = N_HEADER + 23
    order: int = N_HEADER + 24  # the function that sorts members, 0 if none does
    evaluate: int = N_HEADER + 25  # the filter itself, for functions of states that run it
    observer: int = N_HEADER + 26
    # of states
    last_event: int = N_HEADER + 27
    updates: int = N_HEADER + 28
    lag: int = N_HEADER + 29
    state_size: int = N_HEADER + 30  # of the state of a filter between two rows, as a vector
    # of Gaussian filters, see `gaussian.machine`
    n_lanes: int = N_HEADER + 31  # records side by side; 1 is one after the other
    n_rows: int = N_HEADER + 32
    n_covariances: int = N_HEADER + 33
    n_noises: int = N_HEADER + 34
    initial_cov: int = N_HEADER + 35
    noise_cov: int = N_HEADER + 36
    leaves_tape: int = N_HEADER + 37
    start: int = N_HEADER + 38
    predict: int = N_HEADER + 39
    update: int = N_HEADER + 40
    prepare_back: int = N_HEADER + 41
    predict_back: int = N_HEADER + 42
    update_back: int = N_HEADER + 43
    finish_back: int = N_HEADER + 44
    smooth: int = N_HEADER + 45
    along: int = N_HEADER + 46  # in place of predict and update, for one record
    along_back: int = N_HEADER + 47
    extend: int = N_HEADER + 48
    extend_back: int = N_HEADER + 49
    # where in the constants the square root of each covariance begins, 0 if there is none
    root_of_start: int = N_HEADER + 50
    root_of_process_noise: int = N_HEADER + 51
    root_of_observation_noise: int = N_HEADER + 52
    follows_origins: int = N_HEADER + 53  # of particles that no noise tells apart
    is_linear: int = N_HEADER + 54  # of guided filters: one guide is right everywhere
    # of particles with Kalman filters, see `regimes.particles`
    condition: int = N_HEADER + 55
    move_to_observation: int = N_HEADER + 56
    moves: int = N_HEADER + 57  # of the parts of a mixture, see `regimes.moves`


PLAN = PlanSlots()
N_WORDS = N_HEADER + len(PLAN)
VERSION = version_of(PLAN)

NULL = np.int64(0)
"""An address that is not read."""


def make_plan(
    system: System,
    run: EntryPoint,
    functions: Sequence[str],
    settings: Sequence[float] = (),
    **others: int | EntryPoint,
) -> Plan:
    """Pack a system, those of its functions that a filter uses, and the filter's settings.

    The plan is for the function ``run``. The functions of the system have names as in `PLAN`, and
    `prepare` is there with any of them; the settings are read by `settings_of`, and ``others`` are
    values of further slots.
    """
    used = {n: system.entry_point(n) for n in (("prepare", *functions) if functions else ())}
    numbers = {name: value for name, value in others.items() if isinstance(value, int)}
    entries = {name: value for name, value in others.items() if isinstance(value, EntryPoint)}
    words = np.zeros(N_WORDS + system.free.size + len(settings), np.int64)
    sizes = {
        "n": system.n, "m": system.m, "p": system.p, "n_inputs": system.n_inputs,
        "n_theta": system.n_theta, "n_constants": system.n_constants, "n_free": system.free.size,
        "n_settings": len(settings), "has_gaussian_observation": system.gaussian_observation,
        "observation_uses_inputs": system.observation_uses_inputs,
        "is_time_invariant": "step_moments" in used and system.is_time_invariant,
        "root_of_start": system.square_roots.get("initial_cov", 0),
        "root_of_process_noise": system.square_roots.get("process_noise", 0),
        "root_of_observation_noise": system.square_roots.get("observation_noise", 0),
    }  # fmt: skip
    for name, number in (sizes | numbers).items():
        words[getattr(PLAN, name)] = number
    words.view(np.float64)[PLAN.dt] = system.dt
    words[N_WORDS : N_WORDS + system.free.size] = system.free
    words.view(np.float64)[N_WORDS + system.free.size :] = settings
    entries |= used
    names = sorted(entries)
    identity = repr((words.tolist(), names))
    key = key_of(__name__, identity, run.key, *(entries[name].key for name in names))
    return Plan(words, VERSION, run, {getattr(PLAN, name): entries[name] for name in names}, key)


class SystemPointers(NamedTuple):
    """One evaluation's system: ``c`` its constants, ``inputs`` a row for each step.

    ``failure`` says which covariance is none at these parameters, and is `outcomes.NONE` if all
    are. ``free`` are the states that an update may move. Functions are addresses.
    """

    failure: int

    n: int
    m: int
    p: int
    n_theta: int
    dt: float
    is_time_invariant: bool
    has_gaussian_observation: bool
    free: np.ndarray
    c: np.ndarray
    inputs: np.ndarray
    initialise: int
    propagate: int
    observe: int
    log_density: int
    step_moments: int
    propagate_guided: int
    observation_information: int
    follow: int
    look_back: int
    start_back: int


@njit_internal
def read_system(plan, theta, inputs):
    """Unpack a plan, and prepare the constants of one evaluation."""
    c = np.empty(plan[PLAN.n_constants])
    call_address(plan[PLAN.prepare], (theta, np.int64(theta.size), c))
    return SystemPointers(
        failure=_failure(plan, c),
        n=plan[PLAN.n], m=plan[PLAN.m], p=plan[PLAN.p], n_theta=plan[PLAN.n_theta],
        dt=reals_of(plan)[PLAN.dt], is_time_invariant=plan[PLAN.is_time_invariant] != 0,
        has_gaussian_observation=plan[PLAN.has_gaussian_observation] != 0,
        free=free_states(plan), c=c, inputs=inputs,
        initialise=plan[PLAN.initialise], propagate=plan[PLAN.propagate],
        observe=plan[PLAN.observe], log_density=plan[PLAN.log_density],
        step_moments=plan[PLAN.step_moments], propagate_guided=plan[PLAN.propagate_guided],
        observation_information=plan[PLAN.observation_information],
        follow=plan[PLAN.follow], look_back=plan[PLAN.look_back],
        start_back=plan[PLAN.start_back],
    )  # fmt: skip


@njit_internal
def _failure(plan, c):
    """Which covariance is none: the square root of such a one is NaN."""
    if _is_none(plan[PLAN.root_of_start], c):
        return INITIAL_COV
    if _is_none(plan[PLAN.root_of_process_noise], c):
        return PROCESS_NOISE
    return OBSERVATION_NOISE if _is_none(plan[PLAN.root_of_observation_noise], c) else NONE


@inline_always
def _is_none(root, c):
    return root != 0 and np.isnan(c[root])


@njit_internal
def free_states(plan):
    """The states that an update may move."""
    return plan[N_WORDS : N_WORDS + plan[PLAN.n_free]]


@njit_internal
def reals_of(plan):
    """The words of a plan as real numbers; ``plan.view`` takes ten times as long to compile."""
    return carray(pointer(plan.ctypes.data), (plan.size,), np.float64)


@njit_internal
def settings_of(plan):
    """The settings that a plan was made with."""
    return reals_of(plan)[N_WORDS + plan[PLAN.n_free] :]


@njit_internal
def call_members(address, system, k, t, z, width, X, out):
    """Call a function of a system for all members X at once."""
    arguments = MemberArguments(
        c=system.c, inputs=system.inputs, k=k, t=t, z=z, width=width, X=X, out=out,
        n_members=np.int64(X.shape[1]),
    )  # fmt: skip
    call_address(address, arguments)


@njit_internal
def initialise(system, z, width, X):
    """Draw every member's state at step 0 from normals at the address z."""
    call_members(system.initialise, system, NULL, 0.0, z, width, X, NULL)


@njit_internal
def propagate(system, k, t, z, width, X):
    """Move every member from step k to k + 1 with its own noise (Eqs. 4.22 and 4.40)."""
    call_members(system.propagate, system, k, t, z, width, X, NULL)


@njit_internal
def simulate(system, k, t, z, width, X, D):
    """Simulate an observation of every member (Eq. 4.15)."""
    call_members(system.observe, system, k, t, z, width, X, D)


@njit_internal
def log_density(system, k, t, d, X, log_p):
    """Write log p(d | x) of every member; components of d that are NaN are left out."""
    call_members(system.log_density, system, k, t, d, NULL, X, log_p)


@njit_internal
def propagate_guided(system, k, t, z, width, X, gains):
    """Move every member by noise that these gains shift; X is followed by a row of log ratios."""
    call_members(system.propagate_guided, system, k, t, z, width, X, gains)


@njit_internal
def follow(system, first, last, t0, path, gains, steps, cov):
    """Move a path by the mean noise of gains, and linearise its steps, see `guide_loops`."""
    arguments = FollowArguments(
        c=system.c, inputs=system.inputs, first=first, last=last, t0=t0, dt=system.dt, path=path,
        gains=gains, steps=steps, cov=cov,
    )  # fmt: skip
    call_address(system.follow, arguments)


@njit_internal
def look_back(address, first, last, path, steps, gains, psi, sums):
    """Move psi back, and condition the noise on it, see `guide_loops`."""
    arguments = LookBackArguments(
        first=first, last=last, path=path, steps=steps, gains=gains, psi=psi, sums=sums
    )
    call_address(address, arguments)


@njit_internal
def observation_information(system, k, t, d, x, out):
    """Write log p(d | x) at a point x (n, 1), its score and its information."""
    call_members(system.observation_information, system, k, t, d, NULL, x, out)


@njit_internal
def step_moments(system, k, t, X, M):
    """Write mean and variance of the next state, given each point X (1, N), to M (2, N)."""
    call_members(system.step_moments, system, k, t, NULL, NULL, X, M)
