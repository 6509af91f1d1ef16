"""A filter that takes a system badly: it linearises a jump, repeats a run, or has no digits."""

from typing import Any

from ..filters.catalog import OF_REGIMES, followers
from ..filters.checks import NO_DIGITS, Choice
from ..filters.ekf import EKF
from ..filters.gaussian.base import GaussianFilterBase
from ..filters.protocol import System
from ..filters.rbpf import RBPF
from ..filters.written import short_form
from ..tables import joined
from .words import sentences


@sentences.register
def _(fact: Choice) -> list[str]:
    problems = (jump_problem, repetition_problem, rounding_problem)
    found = (problem_of(fact.system, fact.filter) for problem_of in problems)
    return [text for text in found if text is not None]


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
    others = followers(system, filter)
    of_regimes = [f for f in others if isinstance(f, OF_REGIMES)]
    exact = [f for f in others if f not in of_regimes and f.is_exact_for(system)]
    verb = "jump" if len(jumping) > 1 else "jumps"
    reason = (
        f"the {' and the '.join(jumping)} of this system {verb} where the state crosses a threshold"
    )
    if of_regimes and not isinstance(filter, OF_REGIMES):
        reason = "this system switches between regimes"
    better = of_regimes + exact
    remedy = f"; use {joined(map(short_form, better), 'or')}" if better else ""
    return (
        f"{short_form(filter)}: {reason}, which no linearisation follows, and the log-likelihood "
        f"may be far off{remedy}."
    )


def repetition_problem(system: System, filter: Any) -> str | None:
    """Say that all members of a noisy filter are the same; None if they are not."""
    if not (filter.noisy and system.is_deterministic):
        return None
    return (
        f"{short_form(filter)}: this system has a known start and no process noise, so that all "
        f"members are the same. Use {short_form(EKF())}: one run of the equations, the same "
        f"log-likelihood, and its gradient."
    )


def rounding_problem(system: System, filter: Any) -> str | None:
    """Say that a covariance from the start on has no digits for what is observed; else None."""
    if not isinstance(filter, GaussianFilterBase) or system.start_over_noise < NO_DIGITS:
        return None
    return (
        f"{short_form(filter)}: initial_cov is so large that the variance of an observation is "
        f"{system.start_over_noise:.0e} times that of its noise, and a covariance of 16 digits "
        "loses tenths of a nat and more. Give variances 1e8 times those of observation_noise, which"
        " say as little."
    )
