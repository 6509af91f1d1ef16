"""Process noise drawn with no more normals than there are states, where the law allows it."""

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.fg import FrozenFunctionGraph

from pymc_statespace_filters.lowering.compile import unrolled
from pymc_statespace_filters.lowering.compiled import Graph
from pymc_statespace_filters.lowering.graphs import SYMBOLS, call, jacobian_of, symbols_of
from pymc_statespace_filters.lowering.source import depends_on
from pymc_statespace_filters.lowering.unroll import NotUnrollableError
from pymc_statespace_filters.model import StateSpaceModel


def merged_noise(system: StateSpaceModel) -> FrozenFunctionGraph | None:
    """B Q B^T, if g(x, q) = g(x, 0) + B q with more noises than states and B the same everywhere.

    The sum of independent noises on one state, ``[[0.6, sigma_m]]``, is one noise of the same law,
    and drawing normals is most of the cost of an ensemble.
    """
    if system.m <= system.n:
        return None
    symbols = symbols_of(system)
    gain = jacobian_of(call(system.equations.transition, system, symbols), symbols["q"])
    inputs = {name: symbols[name] for name in ("theta", "x", "q", "u", "t")}
    try:
        (values,) = unrolled(Graph(inputs, [gain.ravel()]))
    except NotUnrollableError:
        return None
    elsewhere = {
        f"{name}.{i}" for name in ("x", "q", "u", "t") for i in range(max(1, _size(symbols[name])))
    }
    if depends_on(values, frozenset(elsewhere)):
        return None
    cov = pt.as_tensor(np.eye(system.m))
    if system.equations.process_noise is not None:
        cov = call(system.equations.process_noise, system, symbols)
    return FrozenFunctionGraph.from_io([symbols[s] for s in SYMBOLS], [gain @ cov @ gain.T])


def _size(symbol) -> int:
    return symbol.type.shape[0] if symbol.type.ndim else 1
