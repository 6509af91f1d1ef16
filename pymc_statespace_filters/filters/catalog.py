"""The filters of the package, and which of them take a system.

The filters' own checks decide. Only rooms that look for a filter in place of a user's import this.
"""

from typing import Any

from .bootstrap import BootstrapPF
from .checks import takes
from .ekf import EKF
from .enkf import EnKF
from .finite_state import FiniteStateFilter
from .grid import GridFilter
from .guided_pf import GuidedPF
from .imm import IMM
from .iplf import IPLF
from .pf_enkf import PFEnKF
from .protocol import Filter, System
from .rbpf import RBPF
from .ukf import UKF

# In the order in which messages name them, with a first number of particles.
FILTERS: tuple[Filter, ...] = (
    EKF(), FiniteStateFilter(), GridFilter(), IPLF(), UKF(), IMM(), RBPF(100), GuidedPF(100),
    BootstrapPF(1000), PFEnKF(1000), EnKF(1000),
)  # fmt: skip

OF_REGIMES = (IMM, RBPF)


def filters_for(system: System, *, without: Any = None) -> list[Filter]:
    """The filters of the package that take a system, but not the kind of filter ``without``.

    Of a deterministic system the others would repeat what the EKF computes. Where a system switches
    between regimes, filters with a single Gaussian are far off.
    """
    found = [f for f in ((EKF(),) if system.is_deterministic else FILTERS) if takes(f, system)]
    if any(isinstance(f, OF_REGIMES) for f in found):
        found = [f for f in found if not isinstance(f, EKF | UKF | IPLF)]
    return [f for f in found if type(f) is not type(without)]


def exact_filter(system: System, *, without: Any = None) -> Filter | None:
    """A filter that computes the likelihood of a system without noise; None if there is none."""
    filters = filters_for(system, without=without)
    return next((f for f in filters if not f.noisy and f.is_exact_for(system)), None)


def quiet_filter(system: System, filter: Any) -> Filter | None:
    """A filter of the same likelihood with little noise or none, in place of a noisy one."""
    exact = exact_filter(system, without=filter)
    if exact is not None or isinstance(filter, GuidedPF):
        return exact
    others = [f for f in followers(system, filter) if f.is_exact_for(system)]
    return next((f for f in others if isinstance(f, GuidedPF)), None)


def followers(system: System, filter: Any) -> list[Filter]:
    """The other filters that take a system, without the guided one where an equation jumps.

    Beside a jump its guide misleads the particles: 7 to 104 nats were missing with 100 of them.
    """
    found = filters_for(system, without=filter)
    return [f for f in found if not (system.jumping_equations and isinstance(f, GuidedPF))]
