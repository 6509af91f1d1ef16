"""Point-mass filter: the density of one state itself, on a grid (Bucy and Senne, 1971).

Prediction and update are integrals, thesis Eqs. 3.13-3.16 written as the recursion

    p(x_{k+1} | d_1 .. d_j) = integral of N(x_{k+1}; g(x_k, 0), s(x_k)^2) p(x_k | d_1 .. d_j) dx_k,
    p(d_j | d_1 .. d_{j-1}) = integral of p(d_j | x) p(x | d_1 .. d_{j-1}) dx,

and both are trapezoidal sums, whose error for smooth integrands is below any power of the spacing.
Spacing and length of the grid are checked during an evaluation: if the grid is too coarse or too
short, the evaluation starts again with a finer or a longer one. Where no uniform grid will do, it
starts again on segments, see `point_mass.segments`.
"""

from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

import numpy as np
from numba import carray, types

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.compiler.native.cache_key import digest, key_of
from pymc_statespace_filters.compiler.native.entry_point import (
    F64_PTR,
    I64_PTR,
    EntryPoint,
    arguments_class,
)
from pymc_statespace_filters.compiler.native.jit import keep_alive, njit_callable, njit_internal
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.outcomes import (
    COVARIANCE_NOT_POSITIVE,
    NONE,
    OUT_OF_MEMORY,
    TOO_FAR,
)
from pymc_statespace_filters.filters.point_mass.forward_pass import (
    END,
    ON_GRID,
    ON_SEGMENTS,
    attempt,
    discard,
    first_grid,
    next_attempt,
)
from pymc_statespace_filters.filters.point_mass.predictions import predictions_function
from pymc_statespace_filters.filters.point_mass.recursion import has_valid_covariances
from pymc_statespace_filters.filters.point_mass.segment_pass import (
    discard_segments,
    pass_on_segments,
)
from pymc_statespace_filters.filters.point_mass.states import run_function, states_function
from pymc_statespace_filters.filters.protocol import (
    LogLikelihoodFunction,
    PredictionsFunction,
    RunFunction,
    StatesFunction,
    System,
)
from pymc_statespace_filters.filters.system_table import (
    SYSTEM_ARGUMENTS,
    read_system,
    system_table,
)

POINT_MASS_ARGUMENTS = SYSTEM_ARGUMENTS | {
    "tolerance": types.float64,
    "steps": I64_PTR, "n_observations": types.intp, "observed": F64_PTR, "t0": types.float64,
    "terms": F64_PTR, "health": F64_PTR,
}  # fmt: skip

# Beside a kink the error falls with the square of the spacing: 8192 points reach about 1e-6.
_WITH_KINKS = 1e-5

PointMassArguments = arguments_class("PointMassArguments", POINT_MASS_ARGUMENTS, __name__)


@dataclass(frozen=True)
class GridFilter:
    """Point-mass filter: the exact likelihood of a system with one state, deterministic.

    The density of the state is represented on a grid that moves with it and is refined as needed:
    there is no range and no spacing to choose. For smooth equations the result is the likelihood of
    the discretised system, to the tolerance, whatever the shape of the density. `BootstrapPF`
    estimates the same number with noise.

    Parameters
    ----------
    tolerance : float
        Largest error allowed in a term log p(d_j | d_1 .. d_{j-1}), by the filter's own error
        estimate; between 1e-12 and 1e-2. A larger one saves time: 1e-3 takes between a sixth and
        four fifths of the time of 1e-8. A sensor with a kink, such as ``|x|``, gets at least 1e-5.

    Raises
    ------
    ModelError
        If ``tolerance`` is outside its range.

    Notes
    -----
    The process noise must be additive given the state, ``g(x, q) = g(x, 0) + G(x) q``. A transition
    with kinks (`freeplay`, an absolute value) is integrated with an error of second order in the
    spacing, which the error estimate does not include: `is_exact_for` is then False. Beside the
    kink of a sensor the error is of second order, too, and is estimated: 1e-8 would need some 10^5
    points there. Masses below the rounding error of the largest are dropped, until an observation
    falls so far out that they matter. A point from which a step is not finite (it diverges, or the
    logarithm of the state ends there) is left out, as such a particle would be.

    A density with an edge, one that is narrow here and very broad there, or noise that vanishes at
    a point needs segments in place of the grid, and some eight times as long. Parameters that would
    need more than 8192 points, and observations where the density of the state is below 1e-265, get
    the log-likelihood minus infinity, with that reason.

    Time grows in proportion to the record: 1 to 3 microseconds for a step without an observation
    where some hundred points suffice, 3 to 50 for an observation, the more the finer the sensor is.
    Per step it grows with the spread of the state in standard deviations of a step's noise.
    Smoothed states take two to four times as long as the likelihood.

    R. S. Bucy and K. D. Senne, "Digital synthesis of non-linear filters", Automatica 7 (1971).

    Examples
    --------
    >>> import pymc_statespace_filters as psf
    >>> psf.GridFilter()
    GridFilter(tolerance=1e-08)
    """

    _: KW_ONLY
    tolerance: float = 1e-8

    noisy: ClassVar[bool] = False
    has_gradient: ClassVar[bool] = False

    def __post_init__(self) -> None:
        value = self.tolerance
        is_real = isinstance(value, float) and not isinstance(value, bool)
        if not is_real or not 1e-12 <= value <= 1e-2:
            raise ModelError(f"tolerance must be a number from 1e-12 to 1e-2, got {value!r}.")

    def check(self, system: System) -> None:
        """Raise if the system is not one that this filter can treat."""
        if system.n != 1:
            raise ModelError(
                f"GridFilter treats systems of one state, got {system.n} states "
                f"{list(system.states)}"
            )
        if system.carried:
            raise ModelError(
                f"GridFilter cannot treat the carried states {list(system.carried)}: a memory has "
                f"no density"
            )
        if system.gaussian is not system:
            raise ModelError(
                "GridFilter integrates over Gaussian noise and a Gaussian start, got other "
                "distributions in process_dist or initial_dist, or steps of Milstein"
            )
        if system.m == 0:
            raise ModelError(
                "GridFilter needs process noise, which makes the density smooth, and this system "
                "has none"
            )
        if not system.has_additive_process_noise:
            raise ModelError(
                "GridFilter needs a transition with additive noise, g(x, q) = g(x, 0) + G(x) q, so "
                "that a step is Gaussian given the state, and here dg/dq depends on q (or cannot "
                "be seen not to). Substeps of an integrator do that where the drift is not linear: "
                "a smaller dt does without them"
            )

    def _tolerance_for(self, system: System) -> float:
        return self.tolerance if system.has_smooth_sensor else max(self.tolerance, _WITH_KINKS)

    def is_exact_for(self, system: System) -> bool:
        """Whether the likelihood is that of the system, to the tolerance."""
        return system.has_exact_observation_density and system.has_smooth_transition

    def compile(self, system: System) -> CompiledFunction[LogLikelihoodFunction]:
        """Compile the log-likelihood."""
        POINT_MASS.compile()
        table = system_table(system, ("step_moments", "log_density"))
        evaluate, make_table, dt = POINT_MASS.external, table.make, system.dt
        tolerance = self._tolerance_for(system)

        @njit_callable
        def run(theta, steps, observed, inputs, t0, noise):
            terms, health = np.full(steps.size, -np.inf), np.empty(3)
            health[0], health[1], health[2] = np.inf, OUT_OF_MEMORY, 0.0
            table = make_table()
            arguments = PointMassArguments(
                table=table.ctypes.data, dt=dt, theta=theta.ctypes.data, n_theta=theta.size,
                inputs=inputs.ctypes.data, n_rows=inputs.shape[0], tolerance=tolerance,
                steps=steps.ctypes.data, n_observations=steps.size, observed=observed.ctypes.data,
                t0=t0, terms=terms.ctypes.data, health=health.ctypes.data,
            )  # fmt: skip
            evaluate(*arguments)
            keep_alive(table)
            return terms, health

        return CompiledFunction(run, key_of(repr(self), table.key, POINT_MASS.key))

    def compile_states(self, system: System, moment: str) -> CompiledFunction[StatesFunction]:
        """Compile "predicted", "filtered" or "smoothed" states.

        The draws of one ``draw_seed`` are independent; if smoothed, they are a path.
        """
        return states_function(system, self._tolerance_for(system), moment)

    def compile_predictions(self, system: System) -> CompiledFunction[PredictionsFunction]:
        """Compile the law of every observation given those before it."""
        return predictions_function(system, self._tolerance_for(system))

    def compile_run(self, system: System) -> CompiledFunction[RunFunction]:
        """Compile one run with all that it computes."""
        return run_function(system, self._tolerance_for(system))

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        return "point masses, forward and backward"


def _point_mass(
    table, dt, theta, n_theta, inputs, n_rows, tolerance, steps, n_observations, observed, t0,
    terms, health,
):  # fmt: skip
    """The filter as one function for all systems; it writes terms and health."""
    system = read_system(table, dt, theta, n_theta, inputs, n_rows)
    record = carray(observed, (n_observations, system.p))
    out, state = carray(terms, (n_observations,)), carray(health, (3,))
    code, j = _evaluate(system, carray(steps, (n_observations,)), record, t0, tolerance, out)
    for failed in range(j, n_observations):
        out[failed] = -np.inf
    failure = code if code >= NONE else TOO_FAR
    state[0], state[1], state[2] = np.inf, failure, j if code != NONE else -1


@njit_internal
def _evaluate(system, steps, observed, t0, tolerance, terms):
    """Write the terms: (NONE, J), or (a reason, the observation that failed)."""
    if not has_valid_covariances(system):
        return np.int64(COVARIANCE_NOT_POSITIVE), np.int64(0)
    place, settings = ON_GRID, first_grid(system, steps, t0, tolerance)
    while place != END:
        if place == ON_SEGMENTS:
            code, j = pass_on_segments(
                system, steps, observed, t0, tolerance, terms, discard_segments, None
            )
        else:
            code, j = attempt(
                system, steps, observed, t0, settings, tolerance, terms, discard, None
            )
        place, settings = next_attempt(place, code, settings)
    return code, j


POINT_MASS = EntryPoint(_point_mass, POINT_MASS_ARGUMENTS, "point_mass", digest("point_mass"))
