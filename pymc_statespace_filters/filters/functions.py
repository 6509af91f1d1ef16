"""Signatures of the functions that a plan computes; see the functions of `filters.protocol`."""

from ..compiler.native.plan import Plan
from ..compiler.native.planned_function import PlannedFunction

_DATA = (("observed", 2), ("inputs", 2), ("t0", 0))
_RECORD = (("theta", 1), ("steps", 1), *_DATA)
_POINTS = (("theta", 2), ("steps", 1), *_DATA)
_PANEL = (("theta", 2), ("steps", 2), *_DATA)
_SEED, _WANTED, _DRAW_SEED = ("seed", 0), ("wanted", 1), ("draw_seed", 0)
_TERMS, _HEALTH, _TAPE = ("terms", 1), ("health", 1), ("tape", 2)
_TERMS_BAR = ("terms_bar", 1)


def likelihood(plan: Plan) -> PlannedFunction:
    """A `LogLikelihoodFunction`."""
    return PlannedFunction(plan, (*_RECORD, ("noise", 0)), (_TERMS, _HEALTH))


def of_points(plan: Plan) -> PlannedFunction:
    """The log-likelihood at many points: theta (B, k) -> terms (B, J), health (B, 3)."""
    return PlannedFunction(plan, (*_POINTS, _SEED), (("terms", 2), ("health", 2)))


def of_panel(plan: Plan) -> PlannedFunction:
    """The log-likelihood of a panel: theta (G, k), rows (J, 3) -> terms (J,), health (3,)."""
    return PlannedFunction(plan, (*_PANEL, _SEED), (_TERMS, _HEALTH))


def taped(plan: Plan, *, of_panel: bool = False) -> PlannedFunction:
    """The log-likelihood with a third result, the tape."""
    record = _PANEL if of_panel else _RECORD
    return PlannedFunction(plan, (*record, _SEED), (_TERMS, _HEALTH, _TAPE))


def pullback(plan: Plan, *, of_panel: bool = False) -> PlannedFunction:
    """The cotangent of theta from a tape and that of the terms."""
    record, theta_bar = (_PANEL, ("theta_bar", 2)) if of_panel else (_RECORD, ("theta_bar", 1))
    return PlannedFunction(plan, (*record, _SEED, _TAPE, _TERMS_BAR), (theta_bar,))


def gradient(plan: Plan, *, of_panel: bool = False) -> PlannedFunction:
    """A `GradientFunction`, or that of a panel."""
    record, theta_bar = (_PANEL, ("theta_bar", 2)) if of_panel else (_RECORD, ("theta_bar", 1))
    return PlannedFunction(plan, (*record, _SEED, _TERMS_BAR), (theta_bar,))


def term_health(plan: Plan) -> PlannedFunction:
    """A `HealthFunction`."""
    results = (_TERMS, ("n_effective", 1), _HEALTH)
    return PlannedFunction(plan, (*_RECORD, _SEED), results)


def states(plan: Plan) -> PlannedFunction:
    """A `StatesFunction`."""
    results = (("mean", 2), ("sd", 2), ("drawn", 2), ("n_effective_wanted", 1), _HEALTH)
    return PlannedFunction(plan, (*_RECORD, _SEED, _WANTED, _DRAW_SEED), results)


def run(plan: Plan) -> PlannedFunction:
    """A `RunFunction`."""
    results = (_TERMS, _HEALTH, ("mean", 2), ("cov", 3), ("members", 3), ("weights", 2))
    return PlannedFunction(plan, (*_RECORD, _SEED, _WANTED), results)


def predictions(plan: Plan) -> PlannedFunction:
    """A `PredictionsFunction`."""
    results = (("predicted", 2), ("predicted_cov", 3), ("log_below", 2), ("log_above", 2))
    return PlannedFunction(plan, (*_RECORD, _SEED), results)
