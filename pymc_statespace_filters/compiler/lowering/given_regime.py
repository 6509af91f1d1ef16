"""The system of the continuous states where the finite ones are given, as columns of inputs."""

from collections.abc import Mapping

import numpy as np
import pytensor.tensor as pt
from pytensor.gradient import jacobian
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from ...system.model import StateSpaceModel
from .finite_states import FiniteStates, start_symbols, step_symbols
from .symbols import SYMBOLS, call, symbols_of

_KEPT = ("process_noise", "observation", "observation_noise", "observation_logp", "censoring")


def given_regime(model: StateSpaceModel, found: FiniteStates) -> StateSpaceModel:
    """The system of the continuous states, given the finite ones and the finite variables.

    Row k of its inputs has the columns of the system itself, then the finite states at step k, then
    the values of the finite variables drawn in the step from k to k + 1. Other variables are normal
    ones of their means and variances. The start is that of the first values of the finite
    variables in ``initial_dist``.
    """
    states, n_columns = found.continuous, model.n_input_columns
    n_more = len(found.indices) + found.step.values.shape[1]
    symbols = symbols_of(model)
    x = symbols["x"].type.clone(shape=(len(states),))("x")
    u = symbols["u"].type.clone(shape=(n_columns + n_more,))("u")
    own = symbols | {"x": x, "u": u}
    inputs = [own[name] for name in SYMBOLS]
    elements = {i: u[n_columns + k] for k, i in enumerate(found.indices)}
    elements |= {i: x[k] for k, i in enumerate(states)}
    whole = pt.stack([elements[i] for i in range(model.n)])
    given = own | {"x": whole, "u": u[:n_columns]}

    def graph(output: TensorVariable) -> FrozenFunctionGraph:
        return FrozenFunctionGraph.from_io(inputs, [output])

    equations = model.equations
    replaced: dict[str, FrozenFunctionGraph | None] = {
        name: graph(call(old, model, given))
        for name in _KEPT
        if (old := getattr(equations, name)) is not None
    }
    if equations.observation_draw is not None:
        replaced["observation_draw"] = _draw(equations.observation_draw, inputs, given)
    values = {"v": u[n_columns + len(found.indices) :]}
    step = _at(*step_symbols(model), given | values)
    replaced["transition"] = graph(pt.stack([step[i] for i in states]))
    mean, cov = _start(model, found, own["theta"])
    replaced |= {"initial_mean": graph(mean), "initial_cov": graph(cov)}
    others = ("gaussian_transition", "initial_draw", "finite_step", "finite_start")
    names = tuple(model.states[i] for i in states)
    columns = (*(f"{model.states[i]} now" for i in found.indices),
               *(f"drawn {k}" for k in range(found.step.values.shape[1])))  # fmt: skip
    return model._with_equations(replaced | dict.fromkeys(others))._with(
        n=len(states), states=names, n_inputs=model.n_inputs + n_more,
        inputs=(*model.inputs, *columns), discrete_noise=False, keeps_noises=True,
        carried=tuple(name for name in model.carried if name in names),
        observation_uses_inputs=True,
    )  # fmt: skip


def _at(
    symbols: Mapping[str, TensorVariable],
    output: TensorVariable,
    values: Mapping[str, TensorVariable],
) -> TensorVariable:
    """A graph of symbols at values of them."""
    replacements = {symbol: values[name] for name, symbol in symbols.items()}
    return graph_replace(output, replacements, strict=False)


def _draw(graph: FrozenFunctionGraph, inputs: list, given: Mapping) -> FrozenFunctionGraph:
    generators = [variable.type() for variable in graph.inputs[len(SYMBOLS) :]]
    outputs = graph.bind([*(given[name] for name in SYMBOLS), *generators])
    return FrozenFunctionGraph.from_io([*inputs, *generators], outputs)


def _start(
    model: StateSpaceModel, found: FiniteStates, theta: TensorVariable
) -> tuple[TensorVariable, TensorVariable]:
    """Mean and covariance of the continuous states at step 0."""
    kept = np.array(found.continuous, dtype=int)
    if model.equations.finite_start is None:
        mean = call(model.equations.initial_mean, model, {"theta": theta})
        return mean[kept], call(model.equations.initial_cov, model, {"theta": theta})[kept][:, kept]
    symbols, output = start_symbols(model)
    values = pt.as_tensor(found.start.values[0])
    state = graph_replace(
        output[: model.n][kept], {symbols["theta"]: theta, symbols["v"]: values}, strict=False
    )
    z = symbols["z"]
    gain = pt.specify_shape(
        jacobian(state, z, vectorize=True, disconnected_inputs="ignore"),
        (kept.size, z.type.shape[0]),
    )
    none = {z: pt.zeros(z.type.shape)}
    mean, cov = graph_replace([state, gain @ gain.T], none, strict=False)
    return mean, cov
