"""Point-mass filter: the density of one state itself, on a grid (Bucy and Senne, 1971).

Prediction and update are integrals, thesis Eqs. 3.13-3.16 written as the recursion

    p(x_{k+1} | d_1 .. d_j) = integral of N(x_{k+1}; g(x_k, 0), s(x_k)^2) p(x_k | d_1 .. d_j) dx_k,
    p(d_j | d_1 .. d_{j-1}) = integral of p(d_j | x) p(x | d_1 .. d_{j-1}) dx,

and both are trapezoidal sums, whose error for smooth integrands is below any power of the spacing.
Spacing and length of the grid are checked during an evaluation: if the grid is too coarse or too
short, the evaluation starts again with a finer or a longer one. Where no uniform grid will do, it
starts again on segments, see `point_mass.segments`.
"""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

import numpy as np

from ..compiler.native.entry_point import EntryPoint
from ..compiler.native.jit import njit_internal
from ..compiler.native.plan import Plan
from ..errors import ModelError
from .calls import OK, likelihood_entry, state_given
from .plan import make_plan, read_system, settings_of
from .point_mass.forward_pass import write_outcome
from .point_mass.law import STATE_SIZE, law_before, law_of_states, new_tape
from .point_mass.moments import FILTERED, MOMENTS
from .point_mass.predictions import GRID_PREDICTIONS
from .point_mass.segment_pass import along_record, finished
from .point_mass.states import GRID_STATES
from .protocol import System, check_sensor_has_noise
from .state_law import StateLaw

# Beside a kink the error falls with the square of the spacing: 8192 points reach about 1e-6.
_WITH_KINKS = 1e-5
_COARSE = 1e-3  # of a term: a nat for a thousand observations, if all errors had one sign


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

    A run that goes on begins with the density that was left, down to 1e-40 of its largest value on
    a grid: terms are those of one run to the tolerance, unless an observation is a greater surprise
    than that.

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
            moving = [one.name for one in system.model.drifting]
            drift = f", of which {moving} are drifting parameters" if moving else ""
            raise ModelError(
                f"GridFilter treats systems of one state, got {system.n} states "
                f"{list(system.states)}{drift}"
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
        check_sensor_has_noise(type(self).__name__, system)
        if system.m == 0:
            raise ModelError(
                "GridFilter needs process noise, which makes the density smooth, and this system "
                "has none"
            )
        if system.model.has_instant_steps:
            raise ModelError(
                "GridFilter needs process noise in every step, and that between an event and an "
                "observation at the same time has no length (before is 1 in the events)"
            )
        if not system.has_additive_process_noise:
            remedy = "where noise multiplies a positive x, as in x * exp(q), make log(x) the state"
            if getattr(system.model.integrator, "substeps", 1) > 1:
                remedy = "substeps do that: a smaller dt does without them"
            raise ModelError(
                "GridFilter needs a transition with additive noise, g(x, q) = g(x, 0) + G(x) q, so "
                "that a step is Gaussian given the state, and here dg/dq depends on q (or cannot "
                f"be seen not to); {remedy}"
            )

    def _tolerance_for(self, system: System) -> float:
        return self.tolerance if system.has_smooth_sensor else max(self.tolerance, _WITH_KINKS)

    def is_exact_for(self, system: System) -> bool:
        """Whether the likelihood is that of the system, to the tolerance."""
        return system.has_exact_observation_density and system.has_smooth_transition

    def coarse(self) -> "GridFilter":
        """Return this filter with the largest tolerance that still tells where a posterior lies."""
        return GridFilter(tolerance=max(self.tolerance, _COARSE))

    def plan_of_likelihood(self, system: System) -> Plan:
        """Plan the log-likelihood."""
        return self._plan(system, POINT_MASS)

    def plan_of_states(self, system: System, moment: str) -> Plan:
        """Plan "predicted", "filtered" or "smoothed" states.

        The draws of one ``draw_seed`` are independent; if smoothed, they are a path.
        """
        return self._plan(system, GRID_STATES, MOMENTS[moment])

    def plan_of_predictions(self, system: System) -> Plan:
        """Plan the law of every observation given those before it."""
        return self._plan(system, GRID_PREDICTIONS, others=("observe",))

    def plan_of_run(self, system: System) -> Plan:
        """Plan one run with all that it computes."""
        return self._plan(system, GRID_STATES, FILTERED)

    def _plan(
        self, system: System, run: EntryPoint, *settings: int, others: Sequence[str] = ()
    ) -> Plan:
        functions = ("step_moments", "log_density", *others)
        tolerance = self._tolerance_for(system)
        return make_plan(system, run, functions, (tolerance, *settings), state_size=STATE_SIZE)

    def law_of_state(self, system: System, states: np.ndarray) -> StateLaw:
        """Return the law of the state, from what the filter leaves (m, S) at m points."""
        return law_of_states(states)

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        return "point masses, forward and backward"


@njit_internal
def _point_mass(plan, record, request, seed, to):
    """Write terms and health of one record."""
    system, tolerance = read_system(plan, record.theta, record.inputs), settings_of(plan)[0]
    law, tape = law_before(system, state_given(request)), new_tape(np.empty(0, np.int64), True)
    code, j = along_record(system, record, law, False, tolerance, to.terms, tape, finished, None)
    write_outcome(code, j, to.terms, to.health)
    return OK


POINT_MASS = likelihood_entry("point_mass", _point_mass)
