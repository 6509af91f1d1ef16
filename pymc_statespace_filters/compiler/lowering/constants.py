"""Constants of an evaluation: linear algebra of parameters alone, done once and not at every step.

A system whose functions have such parts is lowered to one with a longer vector of parameters: the
user's, followed by the values of these parts, which its functions read. Whatever is compiled for it
takes the longer vector, which `extension` makes of the user's. Covariances and their lower square
roots are constants too.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pytensor
import pytensor.tensor as pt
from numba import carray, types
from pytensor.graph.basic import Variable
from pytensor.graph.fg import FrozenFunctionGraph
from pytensor.graph.op import Op
from pytensor.graph.replace import graph_replace
from pytensor.graph.traversal import io_toposort
from pytensor.tensor.variable import TensorVariable

from ...system.model import StateSpaceModel
from ..codegen.function_types import ParameterFunction
from ..codegen.scalarize import is_linear_algebra
from ..native.entry_point import F64_PTR, EntryPoint
from ..numerics.small_cholesky import covariance_root
from .staged import ENTRY_POINTS, staged
from .symbols import call, uses

# Functions that are called at every step; the others, once per evaluation.
_AT_EVERY_STEP = (
    "transition", "gaussian_transition", "process_noise", "observation", "observation_noise",
    "observation_logp", "finite_step",
)  # fmt: skip


@dataclass(frozen=True)
class Lowered:
    """A system with constants as more parameters; ``extension`` is theta -> (theta, constants).

    ``extension`` is None where there are none, and ``model`` the user's system.
    """

    model: StateSpaceModel
    extension: FrozenFunctionGraph | None


@lru_cache(maxsize=256)
def lowered(model: StateSpaceModel) -> Lowered:
    """The system as it is compiled."""
    theta = pt.tensor("theta", shape=(model.n_theta,), dtype="float64")
    traced = {
        name: _trace(graph, theta)
        for name, graph in vars(model.equations).items()
        if isinstance(graph, FrozenFunctionGraph)
    }
    constants = [
        constant
        for name in _AT_EVERY_STEP
        if name in traced
        for constant in _constants(theta, *traced[name])
    ]
    if not constants:
        return Lowered(model, None)
    ends = model.n_theta + np.cumsum([_size(constant) for constant in constants])
    whole = pt.tensor("theta", shape=(int(ends[-1]),), dtype="float64")
    known = {
        constant: whole[end - _size(constant) : end].reshape(constant.type.shape)
        for constant, end in zip(constants, ends.tolist(), strict=True)
    }
    known[theta] = whole[: model.n_theta]
    equations = {
        name: FrozenFunctionGraph.from_io(
            [whole, *inputs[1:]], graph_replace([output], known, strict=False)
        )
        for name, (inputs, output) in traced.items()
    }
    new = copy(model)
    new.__dict__.update(
        equations=replace(model.equations, **equations),
        parameters=(*model.parameters, "constants of an evaluation"),
        parameter_shapes=(*model.parameter_shapes, (int(ends[-1]) - model.n_theta,)),
    )
    extended = pt.concatenate([theta, *(constant.ravel() for constant in constants)])
    extended = pt.specify_shape(extended, whole.type.shape)
    return Lowered(new, FrozenFunctionGraph.from_io([theta], [extended], dedup_nodes=True))


def _trace(
    graph: FrozenFunctionGraph, theta: TensorVariable
) -> tuple[list[Variable], TensorVariable]:
    """Inputs, theta first, and output of a traced function."""
    inputs = [theta, *(v.type() for v in graph.inputs[1:])]
    (output,) = graph.bind(inputs)
    return inputs, output


def _constants(
    theta: TensorVariable, inputs: Sequence[Variable], output: TensorVariable
) -> list[TensorVariable]:
    """The largest parts with linear algebra that depend on theta alone."""
    varying: set[Variable] = set(inputs[1:])
    heavy: set[Variable] = set()
    nodes = io_toposort(inputs, [output])
    for node in nodes:
        if varying.intersection(node.inputs):
            varying.update(node.outputs)
        elif _is_linear_algebra(node.op) or heavy.intersection(node.inputs):
            heavy.update(node.outputs)
    read = [v for node in nodes if varying.intersection(node.outputs) for v in node.inputs]
    found = dict.fromkeys(v for v in [*read, output] if v in heavy)
    return [v for v in found if v.type.dtype == "float64" and None not in v.type.shape]


def _is_linear_algebra(op: Op) -> bool:
    return type(op) in ENTRY_POINTS or is_linear_algebra(op)


def _size(variable: TensorVariable) -> int:
    return int(np.prod(variable.type.shape, dtype=int))


def extend(extension: FrozenFunctionGraph) -> ParameterFunction:
    """theta -> (theta, constants), an array."""
    theta, extended = _symbols(extension)
    return staged("extend", [theta], extended)


def pull_back(extension: FrozenFunctionGraph) -> ParameterFunction:
    """Cotangent of theta from an array: theta, then the cotangent of (theta, constants)."""
    theta, extended = _symbols(extension)
    cotangent = extended.type("c_bar")
    (bar,) = pytensor.grad(None, [theta], known_grads={extended: cotangent})
    theta_bar = pt.specify_shape(bar, theta.type.shape)
    return staged("pull_back", [theta, cotangent], theta_bar)


def _symbols(extension: FrozenFunctionGraph) -> tuple[TensorVariable, TensorVariable]:
    theta = extension.inputs[0].type("theta")
    (extended,) = extension.bind([theta])
    return theta, extended


def covariances(
    system: StateSpaceModel, merged_noise: FrozenFunctionGraph | None = None
) -> dict[str, FrozenFunctionGraph]:
    """Covariances of parameters, whose square roots colour the noise.

    An integrator's noise is white. The covariance of an observation that depends on inputs or time
    is none of them.
    """
    graphs = dict(vars(system.equations))
    if graphs["observation_noise"] is not None and uses(graphs["observation_noise"], "ut"):
        graphs["observation_noise"] = None
    if not system.has_gaussian_start:
        graphs["initial_cov"] = None
    if merged_noise is not None:
        graphs["process_noise"] = merged_noise
    names = ("initial_cov", "process_noise", "observation_noise")
    return {name: graphs[name] for name in names if graphs[name] is not None}


def followed_by_square_roots(
    outputs: Sequence[TensorVariable],
    system: StateSpaceModel,
    given: TensorVariable,
    theta: TensorVariable,
    graphs: Mapping[str, FrozenFunctionGraph],
) -> ParameterFunction:
    """These vectors, then the lower square root of every covariance, as a function of ``given``.

    The parameters theta are a function of it too.
    """
    covs = [call(graph, system, {"theta": theta}) for graph in graphs.values()]
    flat = pt.concatenate([*outputs, *(cov.ravel() for cov in covs)])
    sizes = [cov.type.shape[0] for cov in covs]
    return staged("prepare", [given], flat, SQUARE_ROOT, sizes)


def _take_root(a, size):
    covariance_root(carray(a, (size, size)))


SQUARE_ROOT = EntryPoint(_take_root, {"a": F64_PTR, "size": types.intp}, "square_root")
"""`covariance_root` of the matrix at an address, compiled once for all systems."""
