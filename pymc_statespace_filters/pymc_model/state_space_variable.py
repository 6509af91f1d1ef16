"""The StateSpace variables of a model, as what evaluates their filters at draws sees them."""

from typing import NamedTuple

import pymc as pm
from pytensor.tensor.variable import TensorVariable

from ..compiler.lowering.compiled_system import compile_system
from ..filters.checks import check_system_and_filter
from ..filters.protocol import (
    DifferentiableFilter,
    Filter,
    PredictionFilter,
)
from ..ops.at_points import FilterAtPoints
from ..ops.likelihood import LogLikelihood, TapedLogLikelihood
from ..ops.states import Predictions, States, TermHealth
from ..system.clock import Clock
from ..system.events import Events
from ..system.model import StateSpaceModel
from ..system.timed_inputs import TimedInputs
from .inspection import state_space_nodes
from .random_variable import inputs_as_seen


class StateSpaceVariable(NamedTuple):
    """One variable of a model: its system, its filter, and the symbols of its record.

    ``dims`` names time and observables; theta and inputs may depend on the free variables. Terms of
    the rows before ``score_from`` do not count. The variable of a panel has theta (G, k) and rows
    (J, 3), see `system.record`, as steps. ``timed`` are the inputs of each record that have
    times, and ``events`` the events of each.
    """

    name: str
    system: StateSpaceModel
    filter: Filter
    dims: tuple[str, str]
    theta: TensorVariable
    steps: TensorVariable
    inputs: TensorVariable
    t0: TensorVariable
    seed: TensorVariable
    observed: TensorVariable
    score_from: int
    clock: Clock
    timed: tuple[TimedInputs, ...] = ()
    events: tuple[Events, ...] = ()

    @property
    def is_panel(self) -> bool:
        """Whether the variable holds several records."""
        return self.steps.type.ndim == 2


def observed_variables(model: pm.Model) -> list[StateSpaceVariable]:
    """The StateSpace variables that have data."""
    found = []
    for name, node in state_space_nodes(model).items():
        rv = node.outputs[1]
        if rv in model.observed_RVs:
            theta, steps, inputs, t0, seed = node.inputs[-5:]
            dims = model.named_vars_to_dims[name]
            op, value = node.op, model.rvs_to_values[rv]
            record = (theta, steps, inputs_as_seen(op, inputs, steps, value), t0, seed, value)
            found.append(
                StateSpaceVariable(
                    name,
                    op.system,
                    op.filter,
                    dims,
                    *record,
                    op.score_from,
                    op.clock,
                    op.timed,
                    op.events,
                )
            )
    return found


def smoothing_method(variable: StateSpaceVariable) -> str:
    """The name of the method by which the variable's filter smooths."""
    return variable.filter.smoothing_method(compile_system(variable.system))


def with_other_filter(variable: StateSpaceVariable, filter: Filter) -> StateSpaceVariable:
    """The same variable with another filter."""
    check_system_and_filter(variable.system, filter)
    return variable._replace(filter=filter)


def states_of(variable: StateSpaceVariable, moment: str) -> FilterAtPoints:
    """Mean, sd and a draw of the state at ``wanted`` steps, effective sample size and health."""
    results = ("mean", "sd", "drawn", "n_effective_wanted", "health")
    operation = States(variable.system, variable.filter, moment)
    return FilterAtPoints(operation, results)


def terms_of(variable: StateSpaceVariable) -> FilterAtPoints:
    """The terms of a likelihood estimate."""
    return FilterAtPoints(LogLikelihood(variable.system, variable.filter), ("terms",))


def term_health_of(variable: StateSpaceVariable) -> FilterAtPoints:
    """The effective number behind every term of a likelihood estimate, and health."""
    return FilterAtPoints(TermHealth(variable.system, variable.filter), ("n_effective", "health"))


def tape_of(variable: StateSpaceVariable) -> FilterAtPoints | None:
    """Terms, and a tape of the moments of the state; None if the filter has no such tape."""
    filter = variable.filter
    has_tape = isinstance(filter, DifferentiableFilter) and filter.has_gradient
    if not has_tape or isinstance(filter, PredictionFilter):
        return None
    return FilterAtPoints(TapedLogLikelihood(variable.system, filter), ("terms", "tape"))


def predictions_of(variable: StateSpaceVariable) -> FilterAtPoints | None:
    """The law of every observation before it is seen, see `PREDICTIONS`; None if unknown."""
    if not (isinstance(variable.filter, PredictionFilter) and variable.system.additive_noise):
        return None
    operation = Predictions(variable.system, variable.filter)
    return FilterAtPoints(operation, ("predicted", "predicted_cov", "log_below", "log_above"))
