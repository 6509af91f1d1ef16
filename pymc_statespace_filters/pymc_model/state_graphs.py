"""Graphs of the states of StateSpace variables, as functions of a model's variables."""

from collections.abc import Sequence
from typing import NamedTuple

import pymc as pm
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from ..compiler.lowering.compiled_system import compile_system
from ..filters.protocol import Filter, StatesFilter, check_states_filter
from ..filters.recommendation import check_system_and_filter
from ..ops.likelihood import LogLikelihood
from ..ops.states import States, TermHealth
from ..system.model import StateSpaceModel
from .inspection import state_space_nodes


class StateSpaceVariable(NamedTuple):
    """One variable of a model: its system, its filter, and the symbols of its record.

    ``dims`` names time and observables; theta and inputs may depend on the free variables. Terms of
    the rows before ``score_from`` do not count. The variable of a panel has theta (G, k) and rows
    (J, 3), see `system.panel`, as steps.
    """

    name: str
    system: StateSpaceModel
    filter: StatesFilter
    dims: tuple[str, str]
    theta: TensorVariable
    steps: TensorVariable
    inputs: TensorVariable
    t0: TensorVariable
    seed: TensorVariable
    observed: TensorVariable
    score_from: int

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
            record = (theta, steps, inputs, t0, seed, model.rvs_to_values[rv])
            op = node.op
            found.append(
                StateSpaceVariable(name, op.system, op.filter, dims, *record, op.score_from)
            )
    return found


def smoothing_method(variable: StateSpaceVariable) -> str:
    """The name of the method by which the variable's filter smooths."""
    return variable.filter.smoothing_method(compile_system(variable.system))


def with_other_filter(variable: StateSpaceVariable, filter: Filter) -> StateSpaceVariable:
    """The same variable with another filter."""
    check_system_and_filter(variable.system, filter)
    return variable._replace(filter=check_states_filter(filter))


def states_of(
    variable: StateSpaceVariable, moment: str, rows: Variable, draw_seed: Variable
) -> Sequence[TensorVariable]:
    """Mean, sd and a draw of the state at steps `rows`, effective sample size and health."""
    check_states_filter(variable.filter)
    record = (variable.steps, variable.observed, variable.inputs, variable.t0, variable.seed)
    operation = States(variable.system, variable.filter, moment)
    return operation(variable.theta, *record, rows, draw_seed, return_list=True)


def terms_of(variable: StateSpaceVariable) -> TensorVariable:
    """The terms of a likelihood estimate."""
    record = (variable.steps, variable.observed, variable.inputs, variable.t0, variable.seed)
    return LogLikelihood(variable.system, variable.filter)(variable.theta, *record)[0]


def term_health_of(variable: StateSpaceVariable) -> Sequence[TensorVariable]:
    """The effective number behind every term of a likelihood estimate, and health."""
    record = (variable.steps, variable.observed, variable.inputs, variable.t0, variable.seed)
    operation = TermHealth(variable.system, variable.filter)
    return operation(variable.theta, *record, return_list=True)[1:]
