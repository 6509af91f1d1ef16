"""Graphs of the one-step-ahead prediction of the observations of a StateSpace variable."""

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.replace import vectorize_graph
from pytensor.tensor.variable import TensorVariable

from ..compiler.lowering.compiled_system import compile_system
from ..compiler.lowering.symbols import jacobian_of, observation_moments, symbols_of
from ..filters.protocol import DifferentiableFilter, PredictionFilter
from ..ops.likelihood import TapedLogLikelihood
from ..ops.states import Predictions
from .state_graphs import StateSpaceVariable

type Graphs = list[TensorVariable]


def observations_given(variable: StateSpaceVariable, states: TensorVariable) -> Graphs:
    """Mean (J, p) and covariance (J, p, p) of the observation of each state (J, n)."""
    return _observation_moments(variable, states, None)


def gaussian_predictions(variable: StateSpaceVariable) -> Graphs | None:
    """Terms (J,), and mean (J, p) and covariance (J, p, p) of every observation before it is seen.

    They are read from the tape of the filter, as if the observation were linear over the spread of
    the state; None if the filter has no tape. NaN if the filter failed.
    """
    filter, n = variable.filter, variable.system.n
    if not (isinstance(filter, DifferentiableFilter) and filter.has_gradient):
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
