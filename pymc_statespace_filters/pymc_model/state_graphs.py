"""Graphs of the states of StateSpace variables, and of predictions of their observations."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pytensor.graph.basic import Variable
from pytensor.graph.replace import vectorize_graph
from pytensor.tensor.variable import TensorVariable

from ..compiler.lowering.compiled_system import compile_system
from ..compiler.lowering.symbols import jacobian_of, observation_moments, symbols_of
from ..filters.protocol import (
    DifferentiableFilter,
    Filter,
    PredictionFilter,
    StatesFilter,
    check_states_filter,
)
from ..filters.recommendation import check_system_and_filter
from ..ops.likelihood import LogLikelihood, TapedLogLikelihood
from ..ops.states import Predictions, States, TermHealth
from ..system.clock import Clock
from ..system.model import StateSpaceModel
from ..system.timed_inputs import TimedInputs
from .inspection import state_space_nodes


class StateSpaceVariable(NamedTuple):
    """One variable of a model: its system, its filter, and the symbols of its record.

    ``dims`` names time and observables; theta and inputs may depend on the free variables. Terms of
    the rows before ``score_from`` do not count. The variable of a panel has theta (G, k) and rows
    (J, 3), see `system.panel`, as steps. ``timed`` are the inputs of each record that have times.
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
    clock: Clock
    timed: tuple[TimedInputs, ...] = ()

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
                StateSpaceVariable(
                    name, op.system, op.filter, dims, *record, op.score_from, op.clock, op.timed
                )
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


type Graphs = list[TensorVariable]


def observations_given(variable: StateSpaceVariable, states: TensorVariable) -> Graphs:
    """Mean (J, p) and covariance (J, p, p) of the observation of each state (J, n)."""
    return _observation_moments(variable, states, None)


def gaussian_predictions(variable: StateSpaceVariable) -> Graphs | None:
    """Terms (J,), and mean (J, p) and covariance (J, p, p) of every observation before it is seen.

    They are read from the tape of the filter, as if the observation were linear over the spread of
    the state; None if the filter has no tape of moments. NaN if the filter failed.
    """
    filter, n = variable.filter, variable.system.n
    has_tape = isinstance(filter, DifferentiableFilter) and filter.has_gradient
    if not has_tape or isinstance(filter, PredictionFilter):
        return None
    terms, _, tape = TapedLogLikelihood(variable.system, filter)(*_record(variable))
    rows = variable.steps + pt.arange(variable.steps.shape[0])
    padding = pt.full((rows.shape[0] + variable.steps[-1], tape.shape[1]), np.nan)
    before = pt.concatenate([tape, padding])[rows]
    if compile_system(variable.system).is_deterministic:
        return [terms, *_observation_moments(variable, before[:, :n], None)]
    position = np.zeros((n, n), dtype=np.int64)
    position[np.tril_indices(n)] = np.arange(n, n + n * (n + 1) // 2)
    cov = before[:, np.maximum(position, position.T)]
    return [terms, *_observation_moments(variable, before[:, :n], cov)]


def exact_predictions(variable: StateSpaceVariable) -> Graphs | None:
    """Moments, and logs of the distribution function and of its complement; None if unknown."""
    if not (isinstance(variable.filter, PredictionFilter) and variable.system.additive_noise):
        return None
    operation = Predictions(variable.system, variable.filter)
    return operation(*_record(variable), return_list=True)


def _record(variable: StateSpaceVariable) -> tuple[TensorVariable, ...]:
    return (
        variable.theta, variable.steps, variable.observed, variable.inputs, variable.t0,
        variable.seed,
    )  # fmt: skip


def _observation_moments(
    variable: StateSpaceVariable, mean: TensorVariable, cov: TensorVariable | None
) -> Graphs:
    """Moments of d = h(x) + e (Eq. 4.4) for states with these means and covariances, linearised."""
    system = variable.system
    symbols = symbols_of(system)
    x, P = symbols["x"], pt.tensor("P", shape=(system.n, system.n), dtype="float64")
    expected, noise_cov = observation_moments(system, symbols)
    C = jacobian_of(expected, x)
    spread = noise_cov if cov is None else C @ P @ C.T + noise_cov
    n_rows = variable.steps.shape[0]
    used = variable.inputs[variable.steps] if system.observation_uses_inputs else None
    rows = {
        x: mean,
        symbols["t"]: variable.t0 + variable.steps * system.dt,
        symbols["u"]: pt.zeros((n_rows, system.n_input_columns)) if used is None else used,
        symbols["theta"]: pt.broadcast_to(variable.theta, (n_rows, system.n_theta)),
    }
    if cov is not None:
        rows[P] = cov
    # A row of NaN states gives NaN in both, also where the noise does not depend on the state.
    known = pt.switch(pt.isnan(mean).any(axis=1), np.nan, 0.0)
    d_mean, d_cov = vectorize_graph([expected + 0.0 * pt.sum(x), spread + 0.0 * pt.sum(x)], rows)
    return [d_mean + known[:, None], d_cov + known[:, None, None]]
