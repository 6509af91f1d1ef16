"""Which systems filters of regimes take, and with which Gaussian filters inside."""

from typing import Any

from ...compiler.lowering.compiled_system import compile_system
from ...errors import ModelError
from ..ekf import EKF
from ..iplf import IPLF
from ..protocol import System
from ..ukf import UKF
from .hybrid import Hybrid, hybrid_of

MOST_BRANCHES = 64
"""Steps of a Kalman filter that are written out for one step of the filter."""


def check_inner(inner: Any) -> None:
    """Raise unless this is a Gaussian filter of the states given the regimes."""
    if not isinstance(inner, EKF | UKF | IPLF):
        raise ModelError(f"inner must be psf.EKF(), psf.UKF() or psf.IPLF(), got {inner!r}")


def check_hybrid(name: str, system: System, inner: EKF | UKF | IPLF) -> Hybrid:
    """The parts of a system; raise unless it has regimes beside states with normal noise."""
    equations = system.written.equations
    if equations.finite_step is None:
        raise ModelError(
            f"{name} needs a regime, drawn in process_dist by pm.Bernoulli, pm.Categorical, "
            "pm.DiscreteUniform or pm.Binomial; this system has none"
        )
    if not equations.others_are_gaussian:
        raise ModelError(
            f"{name} needs normal noise beside what takes finitely many values, got another "
            "distribution in process_dist or initial_dist"
        )
    if equations.initial_draw is not None and equations.finite_start is None:
        raise ModelError(
            f"{name} needs a start that is normal given the regime, got another distribution in "
            "initial_dist"
        )
    hybrid = hybrid_of(system.written)
    _check_moves(name, hybrid)
    inner.check(compile_system(hybrid.given))
    return hybrid


def _check_moves(name: str, hybrid: Hybrid) -> None:
    found = hybrid.found
    if not hybrid.n:
        raise ModelError(
            f"{name} needs continuous states beside the regime, got {list(hybrid.system.states)}, "
            "which all take finitely many values"
        )
    if found.unbounded:
        raise ModelError(
            f"{name} needs variables of process_dist whose values are known beforehand, got a "
            "binomial one whose number of trials depends on parameters, inputs or states"
        )
    n_branches = len(found.step.origin)
    if n_branches > MOST_BRANCHES:
        raise ModelError(
            f"{name} takes at most {MOST_BRANCHES} transitions between regimes, this system has "
            f"{n_branches} for {len(hybrid.regimes)} regimes"
        )
