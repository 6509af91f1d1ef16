"""What samplers, evidence and diagnostics need to know of the state-space variables in a model."""

from collections.abc import Sequence
from typing import Any

import pymc as pm
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters import COLLAPSED, FAILURES
from pymc_statespace_filters.ops import LogLikelihood
from pymc_statespace_filters.random_variable import StateSpaceRV

__all__ = [
    "COLLAPSED",
    "FAILURES",
    "exactness",
    "health_outputs",
    "noise_seeds",
]


def _state_space_nodes(model: pm.Model) -> dict[str, Any]:
    return {
        rv.name: rv.owner
        for rv in model.basic_RVs
        if rv.owner is not None and isinstance(rv.owner.op, StateSpaceRV)
    }


def noise_seeds(model: pm.Model) -> dict[str, SharedVariable]:
    """The shared noise seed of every variable whose likelihood is a random estimate."""
    seeds = {}
    for name, node in _state_space_nodes(model).items():
        if not node.op.filter.noisy:
            continue
        seed = node.inputs[-1]
        if not isinstance(seed, SharedVariable):
            raise ModelError(
                f"the noise seed of {name!r} has been frozen into the model "
                f"(freeze_dims_and_data); use the model as it was before freezing"
            )
        seeds[name] = seed
    return seeds


def health_outputs(graphs: Sequence[Variable]) -> list[TensorVariable]:
    """The health vector of every filter evaluation in the graphs: see `ops.LogLikelihood`."""
    nodes = {v.owner: None for v in ancestors(graphs) if v.owner is not None}
    return [node.outputs[1] for node in nodes if isinstance(node.op, LogLikelihood)]


def exactness(model: pm.Model) -> bool:
    """Whether sampling the model targets its posterior itself, without the bias of a filter."""
    ops = [node.op for node in _state_space_nodes(model).values()]
    return all(op.filter.is_exact_for(op.system) for op in ops)
