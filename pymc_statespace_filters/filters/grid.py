"""Point-mass filter: the density of one state itself, on a lattice (Bucy and Senne, 1971).

The two verbs are integrals, thesis Eqs. 3.13-3.16 read as the recursion

    p(x_{k+1} | d_1 .. d_j) = integral of N(x_{k+1}; g(x_k, 0), s(x_k)^2) p(x_k | d_1 .. d_j) dx_k,
    p(d_j | d_1 .. d_{j-1}) = integral of p(d_j | x) p(x | d_1 .. d_{j-1}) dx,

and both are trapezoidal sums, whose error for smooth integrands is below any power of the spacing.
What the lattice must hold is watched, not assumed: an evaluation that finds it too coarse or too
short starts again with a finer or a longer one.
"""

import math
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters._compile import compiled, pasted
from pymc_statespace_filters.filters._failures import (
    COVARIANCE_NOT_POSITIVE,
    NONE,
    ZERO_WEIGHTS,
)
from pymc_statespace_filters.filters._point_mass import (
    REFINEMENT,
    TOO_COARSE,
    TOO_SHORT,
    begin_of,
    forecast_of,
    no_table,
    see_of,
)
from pymc_statespace_filters.lowering import (
    Compiled,
    OneState,
    has_additive_process_noise,
    has_smooth_transition,
    key_of,
    one_state,
)
from pymc_statespace_filters.model import StateSpaceModel

_LENGTHENING = 1.6
_SHORTEST_REACH, _LONGEST_REACH = 8.5, 35.0  # deviations: densities down to 2e-16, to 1e-265
_PER_STEP = 1e-5  # of the tolerance, what one step's error is planned for


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

    def compile(self, system: StateSpaceModel) -> Compiled:
        """The function (theta, steps, observed, inputs, t0, seed) -> (terms, health)."""
        functions = one_state(system)
        return Compiled(_evaluation(functions, self.tolerance), key_of(repr(self), functions.key))


def _evaluation(system: OneState, tolerance: float) -> Any:
    attempt, first_spacing = _attempt(system, tolerance), _first_spacing(system, tolerance)
    valid = system.valid

    @compiled
    def run(theta, steps, observed, inputs, t0, seed):
        terms, health = np.empty(steps.size), np.empty(3)
        health[0], health[1], health[2] = np.inf, NONE, -1.0
        code, j = np.int64(COVARIANCE_NOT_POSITIVE), np.int64(0)
        spacing, reach = np.inf, _SHORTEST_REACH
        is_valid = valid(theta)
        if is_valid and steps.size:
            spacing = first_spacing(theta, inputs, t0, steps[-1])
        while is_valid:
            code, j = attempt(theta, steps, observed, inputs, t0, spacing, reach, terms)
            if code == TOO_COARSE:
                spacing *= REFINEMENT
            elif code == TOO_SHORT and reach * _LENGTHENING < _LONGEST_REACH:
                reach *= _LENGTHENING
            else:
                break
        if code != NONE:
            for failed in range(j, steps.size):
                terms[failed] = -np.inf
            health[1], health[2] = code if code > NONE else ZERO_WEIGHTS, j
        return terms, health

    return run


def _first_spacing(system: OneState, tolerance: float) -> Any:
    step, start = system.move, system.start

    @pasted
    def first_spacing(theta, inputs, t0, n_steps):
        """The spacing that the first step asks for around the start; see `_lattice.aliasing`."""
        spacing = np.inf
        if n_steps == 0:
            return spacing
        mean, variance = start(theta)
        sd = math.sqrt(variance)
        X, M = np.empty((1, 3)), np.empty((2, 3))
        for i in range(3):
            X[0, i] = mean + (i - 1) * sd
        step(theta, inputs, 0, t0, X, M)
        slope = (M[0, 2] - M[0, 0]) / (2.0 * sd) if sd > 0.0 else 1.0
        for i in range(3):
            width = math.sqrt(M[1, i] / (1.0 + slope * slope))
            if width > 0.0:
                spacing = min(spacing, width)
        return spacing * math.pi * math.sqrt(-2.0 / math.log(_PER_STEP * tolerance))

    return first_spacing


@pasted
def nothing_seen(d):
    """Whether every component is missing."""
    for value in d:
        if not np.isnan(value):
            return False
    return True


def _attempt(system: OneState, tolerance: float) -> Any:
    """One pass over the record: its terms, and (NONE, J) or (why it stopped, where)."""
    begin, forecast, dt = begin_of(system), forecast_of(system), system.dt
    see = see_of(system, tolerance)

    @pasted
    def attempt(theta, steps, observed, inputs, t0, spacing, reach, terms):
        k = np.int64(0)
        code, grid, source = begin(theta, spacing, reach)
        table = no_table()
        error = 0.0
        for j in range(steps.size):
            while k < steps[j] and code == NONE:
                code, grid, source, table, lost = forecast(
                    theta, inputs, k, t0 + k * dt, spacing, reach, grid, table
                )
                error += lost
                if code == NONE and error > tolerance:
                    code = TOO_COARSE
                k += 1
            if code != NONE:
                return code, j
            if nothing_seen(observed[j]):
                terms[j] = 0.0
                continue
            code, grid, terms[j] = see(
                theta, inputs, k, t0 + k * dt, observed[j], reach, grid, source, error
            )
            if code != NONE:
                return code, j
            error = 0.0
        return code, steps.size

    return attempt
