"""What to do where particles collapse, and whether fewer of them would do."""

from collections.abc import Iterable
from typing import Any

import pymc as pm

from ..compiler.lowering.compiled_system import compile_system
from ..filters.bootstrap import BootstrapPF
from ..filters.catalog import exact_filter, filters_for, followers
from ..filters.grid import GridFilter
from ..filters.guided_pf import GuidedPF
from ..filters.protocol import EnsembleFilter, System
from ..filters.written import listed, short_form
from ..pymc_model.inspection import noisy_filters, state_space_nodes

# Particles that take as long as what does not depend on their number: a guide, or the calls of a
# filter without one. Measured on a double well and a Duffing oscillator, 200 observations.
_GUIDE, _REST = 500, 100
_FEWEST = 10


def collapse_remedy(system: System, filter: Any) -> str:
    """Say what to do about a filter whose particles collapse on a system."""
    exact = exact_filter(system, without=filter)
    if exact is not None:
        return f"Use {short_form(exact)}, which computes this likelihood without particles."
    filters = followers(system, filter)
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
    if system.gaussian_observation and not system.has_linear_sensor:
        # A guide leads particles to one of several states: of x0 * x1, 100 guided ones were 4 to 40
        # nats lower than 1000 plain ones.
        return (
            f"Use {more} {short_form(guided)} needs fewer, unless several states explain an "
            "observation equally well (a sensor of x0 * x1)."
        )
    return f"Use {short_form(guided)}, which moves particles to the data, or {more}"


def elsewhere(system: System, filter: Any) -> str:
    """Say which filter has its particles in other places, where all of one are in wrong ones.

    A guide may lead all of them there, however many they are.
    """
    if isinstance(filter, GuidedPF) and exact_filter(system, without=filter) is None:
        free = next(f for f in filters_for(system) if isinstance(f, BootstrapPF))
        return f"Use {short_form(free)}, whose particles do not follow a linearised system."
    return collapse_remedy(system, filter)


def speed_up(filters: Iterable[EnsembleFilter], factor: float) -> tuple[float, float]:
    """How many times fewer particles, ``factor`` at most, are worth asking for, and what they save.

    At least ten are left. The second number is the ratio of the times of an evaluation.
    """
    sizes = [filter.size() for filter in filters]
    fixed = [_GUIDE if isinstance(filter, GuidedPF) else _REST for filter in filters]
    factor = min([factor, *(size / _FEWEST for size in sizes)])
    return factor, sum(sizes + fixed) / (sum(sizes) / factor + sum(fixed))


def collapse_remedies(model: pm.Model) -> str:
    """What to do where particles collapse, for every noisy filter of the model."""
    nodes = {name: state_space_nodes(model)[name].op for name in noisy_filters(model)}
    remedies = {
        name: collapse_remedy(compile_system(op.system), op.filter) for name, op in nodes.items()
    }
    if len(set(remedies.values())) <= 1:
        return "".join(set(remedies.values()))
    return " ".join(f"For {name!r}: {remedy}" for name, remedy in remedies.items())
