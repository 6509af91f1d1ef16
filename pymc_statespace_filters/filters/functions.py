"""Signatures of the functions that a plan computes; see the functions of `filters.protocol`."""

from pymc_statespace_filters.compiler.native.plan import Plan
from pymc_statespace_filters.compiler.native.planned_function import PlannedFunction

_RECORD = (("theta", 1), ("steps", 1), ("observed", 2), ("inputs", 2), ("t0", 0))
_SEED, _WANTED, _DRAW_SEED = ("seed", 0), ("wanted", 1), ("draw_seed", 0)
_TERMS, _HEALTH = ("terms", 1), ("health", 1)


def likelihood(plan: Plan) -> PlannedFunction:
    """A `LogLikelihoodFunction`."""
    return PlannedFunction(plan, (*_RECORD, ("noise", 0)), (_TERMS, _HEALTH))


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
