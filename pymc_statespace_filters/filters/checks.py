"""Whether a filter suits a system: an error if it cannot treat it, a fact if it does so badly."""

from dataclasses import dataclass
from typing import Any

from ..compiler.lowering.compiled_system import compile_system
from ..compiler.native.compilation import without_traces
from ..errors import ModelError
from ..facts import Fact, in_words, tell
from ..system.record import check_system
from .protocol import Filter, System, check_filter, properties
from .written import short_form

# Up to this ratio of variances rounding errors were below 0.02 nats: 0.006 at 4e12, 0.12 at 4e14.
NO_DIGITS = 1e13


@dataclass(frozen=True)
class _OfFilter(Fact):
    system: System
    filter: Any


class Refusal(_OfFilter):
    """A filter cannot treat a system; in words, which others can."""


class Choice(_OfFilter):
    """A filter linearises what jumps, repeats a run without noise, or has no digits."""


class Bias(_OfFilter):
    """A filter has a bias where none is allowed; in words, which others have none."""


def takes(filter: Filter, system: System) -> bool:
    """Whether a filter can treat a system."""
    try:
        filter.check(system)
    except ModelError:
        return False
    return True


@without_traces()
def check_system_and_filter(system: Any, filter: Any) -> System:
    """Raise unless these are a system and a filter that can treat it; the compiled system."""
    check_system(system)
    check_filter(filter)
    compiled = compile_system(system)
    if system.is_censored and not compiled.has_independent_sensors:
        raise ModelError(
            "censored needs observables that are independent given the state, got an "
            "observation_noise that is not diagonal: leave out censored, or give the observables "
            "independent noise"
        )
    try:
        filter.check(compiled)
    except ModelError as refusal:
        raise ModelError(f"{refusal}; {in_words(Refusal(compiled, filter))}") from None
    return compiled


def check_unbiased(system: Any, filter: Any) -> bool:
    """Raise unless a filter can treat a system without bias, and say whether it is exact.

    It is not if the density of an observation is itself an approximation.
    """
    compiled = check_system_and_filter(system, filter)
    if not is_unbiased(compiled, filter):
        raise ModelError(
            f"filter must be exact or unbiased for this system, got {short_form(filter)}, whose "
            f"likelihood has a bias; {in_words(Bias(compiled, filter))}"
        )
    return bool(filter.is_exact_for(compiled))


def is_unbiased(system: System, filter: Any) -> bool:
    """Whether a filter, or the mean of its estimates, has the likelihood of a system."""
    return properties(filter).unbiased or filter.is_exact_for(system)


@without_traces()
def check_choice(system: Any, filter: Any) -> None:
    """Raise unless a filter can treat a system, and warn if it does so badly."""
    compiled = check_system_and_filter(system, filter)
    repeats = filter.noisy and compiled.is_deterministic
    if compiled.jumping_equations or repeats or compiled.start_over_noise >= NO_DIGITS:
        tell(Choice(compiled, filter))
