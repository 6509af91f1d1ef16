"""The traced functions of a system at given symbols, and their Jacobians."""

from collections.abc import Mapping, Sequence

import pytensor.tensor as pt
from pytensor.gradient import jacobian
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.tensor.variable import TensorVariable

from ...system.model import StateSpaceModel

# What the traced functions of a system are functions of, in this order.
SYMBOLS = ("theta", "x", "q", "u", "t", "e", "d")


def _sizes(system: StateSpaceModel) -> dict[str, int | None]:
    counts = (system.n_theta, system.n, system.m, system.n_input_columns, None, system.r, system.p)
    return dict(zip(SYMBOLS, counts, strict=True))


def symbols_of(system: StateSpaceModel) -> dict[str, TensorVariable]:
    """Fresh symbols with the names and sizes of the system's."""
    return {
        name: pt.tensor(name, shape=() if size is None else (size,), dtype="float64")
        for name, size in _sizes(system).items()
    }


def call(
    graph: FrozenFunctionGraph,
    system: StateSpaceModel,
    values: Mapping[str, TensorVariable],
) -> TensorVariable:
    """The output of a traced function at given values; symbols not given are zero."""
    arguments = [
        values[name] if name in values else pt.zeros(() if size is None else (size,))
        for name, size in _sizes(system).items()
    ]
    (output,) = graph.bind(arguments)
    return output


def uses(graph: FrozenFunctionGraph, names: Sequence[str]) -> bool:
    """Whether a traced function depends on one of these symbols."""
    symbols = [graph.inputs[SYMBOLS.index(name)] for name in names]
    found = [*graph.outputs, *(v for node in graph.apply_nodes for v in node.inputs)]
    return any(symbol in found for symbol in symbols)


def process_noise_cov(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable], gain: TensorVariable
) -> TensorVariable:
    """G Q G^T, for the covariance Q of q and a gain G (n, m); an integrator's Q is the identity."""
    if system.equations.process_noise is None:
        return gain @ gain.T
    return gain @ call(system.equations.process_noise, system, symbols) @ gain.T


def transition_moments(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable]
) -> tuple[TensorVariable, TensorVariable]:
    """g(x, 0) and G Q G^T, the noise linearised at zero; exact where it is additive given x."""
    q = pt.zeros((system.m,))
    mean = call(system.equations.transition, system, {**symbols, "q": q})
    return mean, process_noise_cov(system, symbols, jacobian_of(mean, q))


def observation_moments(
    system: StateSpaceModel, symbols: Mapping[str, TensorVariable]
) -> tuple[TensorVariable, TensorVariable]:
    """h(x, 0) and D Gamma D^T (Eq. 4.4); for additive noise D is the identity."""
    symbols = {name: symbol for name, symbol in symbols.items() if name != "e"}
    cov = call(system.equations.observation_noise, system, symbols)
    if system.additive_noise:
        return call(system.equations.observation, system, symbols), cov
    e = pt.tensor("e", shape=(system.r,), dtype="float64")
    seen = call(system.equations.observation, system, {**symbols, "e": e})
    noise_jac = jacobian_of(seen, e)
    at_zero = FrozenFunctionGraph.from_io([e, *symbols.values()], [seen, noise_jac])
    mean, noise_jac = at_zero.bind([pt.zeros((system.r,)), *symbols.values()])
    return mean, noise_jac @ cov @ noise_jac.T


def jacobian_of(output: TensorVariable, wrt: TensorVariable) -> TensorVariable:
    """d output / d wrt, shape (len(output), len(wrt)); zeros where there is no connection."""
    shape = (output.type.shape[0], wrt.type.shape[0])
    if 0 in shape:
        return pt.zeros(shape)
    return pt.specify_shape(
        jacobian(output, wrt, vectorize=True, disconnected_inputs="ignore"), shape
    )
