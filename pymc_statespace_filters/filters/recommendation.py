"""Which filters take a system, and what to do instead of one that does not or that collapses.

Messages recommend filters through this module alone. The filters' own checks decide.
"""

from collections.abc import Iterable, Sequence
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

from ..compiler.lowering.compiled_system import compile_system
from ..errors import ModelError
from ..system.record import check_system
from .bootstrap import BootstrapPF
from .ekf import EKF
from .enkf import EnKF
from .finite_state import FiniteStateFilter
from .gaussian.base import GaussianFilterBase
from .grid import GridFilter
from .guided_pf import GuidedPF
from .imm import IMM
from .iplf import IPLF
from .pf_enkf import PFEnKF
from .protocol import EnsembleFilter, Filter, System, check_filter
from .rbpf import RBPF
from .ukf import UKF

# In the order in which messages name them, with a first number of particles.
FILTERS: tuple[Filter, ...] = (
    EKF(), FiniteStateFilter(), GridFilter(), IPLF(), UKF(), IMM(), RBPF(100), GuidedPF(100),
    BootstrapPF(1000), PFEnKF(1000), EnKF(1000),
)  # fmt: skip

_OF_REGIMES = (IMM, RBPF)

# Particles that take as long as what does not depend on their number: a guide, or the calls of a
# filter without one. Measured on a double well and a Duffing oscillator, 200 observations.
_GUIDE, _REST = 500, 100
_FEWEST = 10

# Up to this ratio of variances rounding errors were below 0.02 nats: 0.006 at 4e12, 0.12 at 4e14.
_NO_DIGITS = 1e13


def short_form(filter: Any) -> str:
    """A filter as a user would write it: ``GuidedPF(100)``, without settings at their defaults."""
    if not is_dataclass(filter) or isinstance(filter, type):
        return str(filter)
    arguments = []
    for field in fields(filter):
        value = getattr(filter, field.name)
        if field.default is MISSING and not field.kw_only:
            arguments.append(repr(value))
        elif value != field.default:
            arguments.append(f"{field.name}={value!r}")
    return f"{type(filter).__name__}({', '.join(arguments)})"


def listed(filters: Iterable[Filter]) -> str:
    """The short forms of filters, with commas."""
    return ", ".join(map(short_form, filters))


def _either(filters: Sequence[Filter]) -> str:
    """The short forms of filters, the last after "or"."""
    *others, last = map(short_form, filters)
    return f"{', '.join(others)} or {last}" if others else last


def filters_for(system: System, *, without: Any = None) -> list[Filter]:
    """The filters of the package that take a system, but not the kind of filter ``without``.

    Of a deterministic system the others would repeat what the EKF computes. Where a system switches
    between regimes, filters with a single Gaussian are far off.
    """
    found = [f for f in ((EKF(),) if system.is_deterministic else FILTERS) if takes(f, system)]
    if any(isinstance(f, _OF_REGIMES) for f in found):
        found = [f for f in found if not isinstance(f, EKF | UKF | IPLF)]
    return [f for f in found if type(f) is not type(without)]


def takes(filter: Filter, system: System) -> bool:
    """Whether a filter can treat a system."""
    try:
        filter.check(system)
    except ModelError:
        return False
    return True


def exact_filter(system: System, *, without: Any = None) -> Filter | None:
    """A filter that computes the likelihood of a system without noise; None if there is none."""
    filters = filters_for(system, without=without)
    return next((f for f in filters if not f.noisy and f.is_exact_for(system)), None)


def quiet_filter(system: System, filter: Any) -> Filter | None:
    """A filter of the same likelihood with little noise or none, in place of a noisy one."""
    exact = exact_filter(system, without=filter)
    if exact is not None or isinstance(filter, GuidedPF):
        return exact
    followers = [f for f in _followers(system, filter) if f.is_exact_for(system)]
    return next((f for f in followers if isinstance(f, GuidedPF)), None)


def alternatives(system: System, filter: Any) -> str:
    """Say which other filters take a system, and which of them are exact."""
    filters = filters_for(system, without=filter)
    exact = [f for f in filters if f.is_exact_for(system)]
    others = [f for f in filters if f not in exact]
    kinds = (("exact", exact), ("approximate", others))
    texts = [f"{listed(of_kind)} ({name})" for name, of_kind in kinds if of_kind]
    return f"this system can be treated by {' and by '.join(texts)}"


def repetition_problem(system: System, filter: Any) -> str | None:
    """Say that all members of a noisy filter are the same; None if they are not."""
    if not (filter.noisy and system.is_deterministic):
        return None
    return (
        f"{short_form(filter)}: this system has a known start and no process noise, so that all "
        f"members are the same. Use {short_form(EKF())}: one run of the equations, the same "
        f"log-likelihood, and its gradient."
    )


def jump_problem(system: System, filter: Any) -> str | None:
    """Say that an equation jumps in the state where a filter linearises it; None if none does.

    A drift that jumps moves the state by little in a step, and sigma points follow that.
    """
    linearises = isinstance(filter, GaussianFilterBase | RBPF) and not system.is_deterministic
    jumping = filter.linearised(system).jumping_equations if linearises else ()
    if not isinstance(filter, EKF) and system.model.integrator is not None:
        jumping = tuple(name for name in jumping if name != "transition")
    if not jumping:
        return None
    followers = _followers(system, filter)
    of_regimes = [f for f in followers if isinstance(f, _OF_REGIMES)]
    exact = [f for f in followers if f not in of_regimes and f.is_exact_for(system)]
    verb = "jump" if len(jumping) > 1 else "jumps"
    reason = (
        f"the {' and the '.join(jumping)} of this system {verb} where the state crosses a threshold"
    )
    if of_regimes and not isinstance(filter, _OF_REGIMES):
        reason = "this system switches between regimes"
    better = of_regimes + exact
    remedy = f"; use {_either(better)}" if better else ""
    return (
        f"{short_form(filter)}: {reason}, which no linearisation follows, and the log-likelihood "
        f"may be far off{remedy}."
    )


def rounding_problem(system: System, filter: Any) -> str | None:
    """Say that a covariance from the start on has no digits for what is observed; else None."""
    if not isinstance(filter, GaussianFilterBase) or system.start_over_noise < _NO_DIGITS:
        return None
    return (
        f"{short_form(filter)}: initial_cov is so large that the variance of an observation is "
        f"{system.start_over_noise:.0e} times that of its noise, and a covariance of 16 digits "
        "loses tenths of a nat and more. Give variances 1e8 times those of observation_noise, which"
        " say as little."
    )


def check_system_and_filter(system: Any, filter: Any) -> None:
    """Raise unless these are a system and a filter that can treat it."""
    check_system(system)
    check_filter(filter)
    compiled = compile_system(system)
    try:
        filter.check(compiled)
    except ModelError as refusal:
        raise ModelError(f"{refusal}; {alternatives(compiled, filter)}") from None


def check_unbiased(system: Any, filter: Any) -> bool:
    """Raise unless a filter can treat a system without bias, and say whether it is exact.

    It is not if the density of an observation is itself an approximation.
    """
    check_system_and_filter(system, filter)
    compiled = compile_system(system)
    if not _is_unbiased(compiled, filter):
        others = listed(f for f in filters_for(compiled) if _is_unbiased(compiled, f))
        raise ModelError(
            f"filter must be exact or unbiased for this system, got {short_form(filter)}, whose "
            f"likelihood has a bias; {others or 'no filter of the package'} has none"
        )
    return bool(filter.is_exact_for(compiled))


def _is_unbiased(system: System, filter: Any) -> bool:
    return getattr(filter, "unbiased", False) or filter.is_exact_for(system)


def speed_up(filters: Iterable[EnsembleFilter], factor: float) -> tuple[float, float]:
    """How many times fewer particles, ``factor`` at most, are worth asking for, and what they save.

    At least ten are left. The second number is the ratio of the times of an evaluation.
    """
    sizes = [filter.size() for filter in filters]
    fixed = [_GUIDE if isinstance(filter, GuidedPF) else _REST for filter in filters]
    factor = min([factor, *(size / _FEWEST for size in sizes)])
    return factor, sum(sizes + fixed) / (sum(sizes) / factor + sum(fixed))


def _followers(system: System, filter: Any) -> list[Filter]:
    """The other filters that take a system, without the guided one where an equation jumps.

    Beside a jump its guide misleads the particles: 7 to 104 nats were missing with 100 of them.
    """
    found = filters_for(system, without=filter)
    return [f for f in found if not (system.jumping_equations and isinstance(f, GuidedPF))]


def elsewhere(system: System, filter: Any) -> str:
    """Say which filter has its particles in other places, where all of one are in wrong ones.

    A guide may lead all of them there, however many they are.
    """
    if isinstance(filter, GuidedPF) and exact_filter(system, without=filter) is None:
        free = next(f for f in filters_for(system) if isinstance(f, BootstrapPF))
        return f"Use {short_form(free)}, whose particles do not follow a linearised system."
    return collapse_remedy(system, filter)


def collapse_remedy(system: System, filter: Any) -> str:
    """Say what to do about a filter whose particles collapse on a system."""
    exact = exact_filter(system, without=filter)
    if exact is not None:
        return f"Use {short_form(exact)}, which computes this likelihood without particles."
    filters = _followers(system, filter)
    on_grid = any(isinstance(f, GridFilter) for f in filters)
    if on_grid and system.has_exact_observation_density and not system.jumping_equations:
        # The error of a grid falls so slowly beside a kink that a finer tolerance needs too many
        # points; beside a jump any does.
        return (
            f"Use {short_form(GridFilter(tolerance=1e-4))}, which has no particles; that is the "
            f"accuracy of a term where the transition has kinks."
        )
    if isinstance(filter, GuidedPF) and system.jumping_equations:
        return (
            f"Use {listed(f for f in filters if isinstance(f, BootstrapPF))}, which does not "
            f"linearise: this system jumps where the state crosses a threshold."
        )
    if isinstance(filter, GuidedPF):
        return (
            "Use more particles; psf.suggest_particles finds how many. If several states explain "
            "the data equally well (a sensor of abs(x)), use BootstrapPF with many more."
        )
    guided = next((f for f in filters if isinstance(f, GuidedPF)), None)
    if system.undriven_states:
        known = (
            f"a known start of {', '.join(system.undriven_states)}, with variances of zero and "
            f"with parameters for the values."
        )
        if guided is None:
            return f"Use {known}"
        return f"Use {short_form(guided)}, which draws the start given the data, or {known}"
    more = "more particles; psf.suggest_particles finds how many."
    if guided is None:
        return f"Use {more}"
    return f"Use {short_form(guided)}, which moves particles to the data, or {more}"
