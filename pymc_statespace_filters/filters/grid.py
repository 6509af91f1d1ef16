"""Point-mass filter: the density of one state itself, on a lattice (Bucy and Senne, 1971).

The two verbs are integrals, thesis Eqs. 3.13-3.16 read as the recursion

    p(x_{k+1} | d_1 .. d_j) = integral of N(x_{k+1}; g(x_k, 0), s(x_k)^2) p(x_k | d_1 .. d_j) dx_k,
    p(d_j | d_1 .. d_{j-1}) = integral of p(d_j | x) p(x | d_1 .. d_{j-1}) dx,

and both are trapezoidal sums, whose error for smooth integrands is below any power of the spacing.
What the lattice must hold is watched, not assumed: an evaluation that finds it too coarse or too
short starts again with a finer or a longer one.
"""

from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
from numba import carray, types

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.compiler.lowering.entry_points import one_state_entries
from pymc_statespace_filters.compiler.lowering.scalar_state import (
    OneState,
    has_additive_process_noise,
    has_smooth_transition,
    one_state,
)
from pymc_statespace_filters.compiler.native.cache_key import digest, key_of
from pymc_statespace_filters.compiler.native.entry_point import (
    F64_PTR,
    I64_PTR,
    EntryPoint,
    address_of,
)
from pymc_statespace_filters.compiler.native.jit import inline_always, njit_contract
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.outcomes import (
    COVARIANCE_NOT_POSITIVE,
    NONE,
    OUT_OF_MEMORY,
    ZERO_WEIGHTS,
)
from pymc_statespace_filters.filters.point_mass.forward_pass import (
    attempt,
    discard,
    first_grid,
    next_grid,
)
from pymc_statespace_filters.filters.point_mass.states import GRID_STATES, MOMENTS
from pymc_statespace_filters.filters.point_mass.system_table import read_one_state
from pymc_statespace_filters.system.model import StateSpaceModel

_ARGUMENTS = (
    types.intp, types.intp, types.intp,  # addresses of the system's functions
    types.intp, types.intp, types.intp, types.float64,  # p, inputs, same every step?, time step
    types.float64,  # tolerance
    F64_PTR, types.intp,  # theta
    I64_PTR, types.intp, F64_PTR,  # steps and record
    F64_PTR, types.intp,  # rows of inputs
    types.float64,  # t0
    F64_PTR, F64_PTR,  # terms, health
)  # fmt: skip


@dataclass(frozen=True)
class GridFilter:
    """Point-mass filter: the exact likelihood of a system with one state, deterministic.

    The state's density is kept on a grid that moves, and is refined, with it: there is no range and
    no spacing to choose. For smooth equations the result is that of the discretised system to the
    tolerance, whatever the shape of the density: what a `BootstrapPF` estimates, without noise.

    Parameters
    ----------
    tolerance : float
        Largest error that a term log p(d_j | d_1 .. d_{j-1}) is to have, by the grid's own
        estimate; between 1e-12 and 1e-2.

    Raises
    ------
    ModelError
        If ``tolerance`` is outside its range.

    Notes
    -----
    The process noise must be additive given the state, ``g(x, q) = g(x, 0) + G(x) q``, and nowhere
    zero. A transition with kinks (`freeplay`, an absolute value) is integrated with an error of the
    order of the squared spacing, which no estimate sees: `is_exact_for` is False then. Parameters
    that would need more than 8192 points have no likelihood here, with that reason. Masses below
    the rounding error of the largest are dropped, until an observation falls so far out that they
    matter. A point that explodes is left out, as are infinite particles.

    R. S. Bucy and K. D. Senne, "Digital synthesis of non-linear filters", Automatica 7 (1971).

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.GridFilter()
    GridFilter(tolerance=1e-08)
    """

    _: KW_ONLY
    tolerance: float = 1e-8

    noisy = False
    has_gradient = False

    def __post_init__(self) -> None:
        value = self.tolerance
        is_real = isinstance(value, float) and not isinstance(value, bool)
        if not is_real or not 1e-12 <= value <= 1e-2:
            raise ModelError(f"tolerance must be a number from 1e-12 to 1e-2, got {value!r}.")

    def check(self, system: StateSpaceModel) -> None:
        """Raise if the system is not one that this filter can treat."""
        if system.n != 1:
            raise ModelError(
                f"GridFilter treats systems of one state, got {system.n} states "
                f"{list(system.states)}; use BootstrapPF, or EKF where the state stays Gaussian"
            )
        if system.carried:
            raise ModelError(
                f"GridFilter cannot treat the carried states {list(system.carried)}: a memory has "
                f"no density; use BootstrapPF"
            )
        if system.m == 0:
            raise ModelError(
                "GridFilter needs process noise, which makes the density smooth; this system has "
                "none: use BootstrapPF or EKF"
            )
        if not has_additive_process_noise(system):
            raise ModelError(
                "GridFilter needs a transition with additive noise, g(x, q) = g(x, 0) + G(x) q, so "
                "that a step is Gaussian given the state, and here dg/dq depends on q (or cannot "
                "be seen not to). Substeps of an integrator do that where the drift is not linear: "
                "use a smaller dt instead. Otherwise use BootstrapPF"
            )

    def is_exact_for(self, system: StateSpaceModel) -> bool:
        """Whether the likelihood is that of the system, to the tolerance."""
        # Noise that is not additive enters the density through its linearisation.
        right_density = system.additive_noise or not system.gaussian_observation
        return right_density and has_smooth_transition(system)

    def compile(self, system: StateSpaceModel) -> CompiledFunction:
        """The function (theta, steps, observed, inputs, t0, noise) -> (terms, health)."""
        functions = one_state(system)
        return CompiledFunction(
            _bound(functions, self.tolerance), key_of(repr(self), functions.key)
        )

    def compile_states(self, system: StateSpaceModel, moment: str) -> CompiledFunction:
        """The function (theta, steps, observed, inputs, t0, seed, rows, draw_seed) -> states.

        States are (mean (R, 1), sd (R, 1), drawn (R, 1), n_effective (R,), health (3,)) of the law
        at the steps ``rows``; ``moment`` is "predicted", "filtered" or "smoothed". The draws of one
        ``draw_seed`` are independent, but a path if smoothed. See `_grid_states`.
        """
        functions = one_state(system)
        key = key_of(f"{self} {moment} states", functions.key)
        return CompiledFunction(_bound_states(functions, self.tolerance, MOMENTS[moment]), key)

    def compile_run(self, system: StateSpaceModel) -> CompiledFunction:
        """The function (theta, steps, observed, inputs, t0, seed, rows) -> a run.

        See `filters`, the room, for what it returns.
        """
        functions = one_state(system)
        return CompiledFunction(
            _bound_run(functions, self.tolerance), key_of(f"{self} run", functions.key)
        )

    def smoothing_method(self, system: StateSpaceModel) -> str:
        """How smoothed states are found, in words."""
        return "point masses, forwards and back"


def _bound(functions: OneState, tolerance: float) -> Any:
    """Bind the filter's entry to the functions of one system."""
    entries = one_state_entries(functions)
    for entry in (POINT_MASS, *entries):
        entry.compile()
    evaluate = POINT_MASS.external
    start, move, log_density = (entry.symbol for entry in entries)
    n_inputs, p, dt = functions.n_inputs, functions.p, functions.dt
    same_every_step = int(functions.same_every_step)

    @njit_contract
    def run(theta, steps, observed, inputs, t0, noise):
        terms, health = np.full(steps.size, -np.inf), np.empty(3)
        health[0], health[1], health[2] = np.inf, OUT_OF_MEMORY, 0.0
        evaluate(
            address_of(start), address_of(move), address_of(log_density),
            p, n_inputs, same_every_step, dt, tolerance,
            theta.ctypes.data, theta.size, steps.ctypes.data, steps.size, observed.ctypes.data,
            inputs.ctypes.data, inputs.shape[0], t0, terms.ctypes.data, health.ctypes.data,
        )  # fmt: skip
        return terms, health

    return run


def _bound_states(functions: OneState, tolerance: float, moment: int) -> Any:
    """What `GridFilter.compile_states` gives, for the functions of one system."""
    evaluate = _bound_laws(functions, tolerance, moment)

    @njit_contract
    def run(theta, steps, observed, inputs, t0, seed, rows, draw_seed):
        record = (theta, steps, observed, inputs, t0)
        mean, sd, drawn, _, health = evaluate(record, rows, draw_seed)
        n_effective = np.where(np.isnan(mean[:, 0]), np.nan, np.inf)
        return mean, sd, drawn, n_effective, health

    return run


def _bound_run(functions: OneState, tolerance: float) -> Any:
    """What `GridFilter.compile_run` gives, for the functions of one system."""
    evaluate = _bound_laws(functions, tolerance, MOMENTS["filtered"])

    @njit_contract
    def run(theta, steps, observed, inputs, t0, seed, rows):
        record = (theta, steps, observed, inputs, t0)
        mean, sd, _, terms, health = evaluate(record, rows, 0)
        cov = (sd * sd).reshape(rows.size, 1, 1)
        return terms, health, mean, cov, np.empty((rows.size, 0, 1)), np.empty((rows.size, 0))

    return run


def _bound_laws(functions: OneState, tolerance: float, moment: int) -> Any:
    """Bind the entry of the states: (record, rows, draw_seed) -> mean, sd, drawn, terms, health."""
    entries = one_state_entries(functions)
    for entry in (GRID_STATES, *entries):
        entry.compile()
    evaluate = GRID_STATES.external
    start, move, log_density = (entry.symbol for entry in entries)
    n_inputs, p, dt = functions.n_inputs, functions.p, functions.dt
    same_every_step = int(functions.same_every_step)

    @njit_contract
    def laws(record, rows, draw_seed):
        theta, steps, observed, inputs, t0 = record
        # One state: what is (R, 1) for the caller is a vector here.
        mean, sd = np.full((rows.size, 1), np.nan), np.full((rows.size, 1), np.nan)
        drawn, terms = np.full((rows.size, 1), np.nan), np.full(steps.size, -np.inf)
        health = np.empty(3)
        health[0], health[1], health[2] = np.inf, OUT_OF_MEMORY, 0.0
        evaluate(
            address_of(start), address_of(move), address_of(log_density),
            p, n_inputs, same_every_step, dt, tolerance, moment,
            theta.ctypes.data, theta.size, steps.ctypes.data, steps.size, observed.ctypes.data,
            inputs.ctypes.data, inputs.shape[0], t0, rows.ctypes.data, rows.size, draw_seed,
            mean.ctypes.data, sd.ctypes.data, drawn.ctypes.data,
            terms.ctypes.data, health.ctypes.data,
        )  # fmt: skip
        return mean, sd, drawn, terms, health

    return laws


def _point_mass(
    start, move, log_density, p, n_inputs, same_every_step, dt, tolerance, theta, n_theta,
    steps, n_observations, observed, inputs, n_rows, t0, terms, health,
):  # fmt: skip
    """The filter as one function for all systems; see `compile` for what it writes."""
    system = read_one_state(
        start, move, log_density, dt, same_every_step,
        carray(theta, (n_theta,)), carray(inputs, (n_rows, n_inputs)),
    )  # fmt: skip
    record = carray(observed, (n_observations, p))
    out, state = carray(terms, (n_observations,)), carray(health, (3,))
    code, j = _evaluate(system, carray(steps, (n_observations,)), record, t0, tolerance, out)
    for failed in range(j, n_observations):
        out[failed] = -np.inf
    failure = code if code >= NONE else ZERO_WEIGHTS
    state[0], state[1], state[2] = np.inf, failure, j if code != NONE else -1


@inline_always
def _evaluate(system, steps, observed, t0, tolerance, terms):
    """Write the terms: (NONE, J), or (a reason, the observation that failed)."""
    if not system.is_valid:
        return np.int64(COVARIANCE_NOT_POSITIVE), np.int64(0)
    spacing, reach = first_grid(system, steps, t0, tolerance)
    while True:
        code, j = attempt(
            system, steps, observed, t0, spacing, reach, tolerance, terms, discard, None
        )
        again, spacing, reach = next_grid(code, spacing, reach)
        if not again:
            return code, j


POINT_MASS = EntryPoint(_point_mass, _ARGUMENTS, "point_mass", digest("point_mass"))
