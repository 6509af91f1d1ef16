"""What samplers, evidence and diagnostics need to know of the state-space variables in a model."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import pymc as pm
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Variable
from pytensor.graph.replace import clone_replace
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters import COLLAPSED, FAILURES
from pymc_statespace_filters.ops import LogLikelihood, LogLikelihoodOfNoise, StoredNoise
from pymc_statespace_filters.random_variable import StateSpaceRV

__all__ = [
    "COLLAPSED",
    "FAILURES",
    "MovedNoise",
    "exactness",
    "health_outputs",
    "hold_noise",
    "move_noise",
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


def hold_noise(
    graphs: Sequence[Variable], seeds: Mapping[str, SharedVariable]
) -> tuple[list[Variable], dict[TensorVariable, TensorVariable]]:
    """Graphs that read stored normals where they made them from a seed, with the same values.

    The mapping gives for each new input the expression of its value, which depends on the seed and
    on the steps of the record alone.
    """
    replaced: dict[Variable, Variable] = {}
    normals: dict[TensorVariable, TensorVariable] = {}
    names = {seed: name for name, seed in seeds.items()}
    for node in {v.owner: None for v in ancestors(graphs) if v.owner is not None}:
        if isinstance(node.op, LogLikelihood) and node.inputs[-1] in names:
            *arguments, seed = node.inputs
            system, filter = node.op.system, node.op.filter
            stored = pt.dvector(f"{names[seed]}_normals")
            normals[stored] = StoredNoise(system, filter)(arguments[1], seed)
            outputs = LogLikelihoodOfNoise(system, filter)(*arguments, stored)
            replaced |= dict(zip(node.outputs, outputs, strict=True))
    return clone_replace(list(graphs), replaced), normals


class MovedNoise(NamedTuple):
    """The symbols of `move_noise`; one entry a noisy variable in each tuple, in the same order.

    Attributes
    ----------
    correlation : TensorVariable
        Input, from 0 to 1: that of the moved normals with the present ones.
    normals : tuple of TensorVariable
        Inputs: the present normals, finite, ``sizes`` of them.
    moved : tuple of TensorVariable
        The moved normals, to be kept if the move is accepted.
    sizes : tuple of TensorVariable
        How many normals there are, from the steps of the record alone.
    """

    correlation: TensorVariable
    normals: tuple[TensorVariable, ...]
    moved: tuple[TensorVariable, ...]
    sizes: tuple[TensorVariable, ...]


def move_noise(
    graphs: Sequence[Variable], seeds: Mapping[str, SharedVariable]
) -> tuple[list[Variable], MovedNoise]:
    """Graphs whose noise is moved from given normals instead of made from a seed.

    Normals u become rho u + sqrt(1 - rho^2) v, where v are fresh ones, those of the seed; they are
    standard normals again (Deligiannidis, Doucet and Pitt 2018). Filters are replaced by their
    smooth versions, for which a small move of the normals is a small move of the estimate. With
    rho = 0 the estimate is that of the seed.

    Raises
    ------
    ModelError
        If a filter has no smooth version for its system.
    """
    correlation = pt.dscalar("correlation")
    innovation = pt.sqrt(1.0 - correlation**2)
    replaced: dict[Variable, Variable] = {}
    noises: list[tuple[TensorVariable, TensorVariable, TensorVariable]] = []
    names = {seed: name for name, seed in seeds.items()}
    for node in {v.owner: None for v in ancestors(graphs) if v.owner is not None}:
        if isinstance(node.op, LogLikelihood) and node.inputs[-1] in names:
            *arguments, seed = node.inputs
            system, noisy, steps = node.op.system, node.op.filter, arguments[1]
            filter: Any = noisy.smooth()  # type: ignore[union-attr]
            filter.check(system)
            normals = pt.dvector(f"{names[seed]}_normals")
            fresh = StoredNoise(system, filter)(steps, seed)
            moved = correlation * normals + innovation * fresh
            # The sum of one element, or of none: the last step of an empty record is 0.
            size = filter.n_normals(system, pt.sum(steps[-1:]), steps.shape[0])
            outputs = LogLikelihoodOfNoise(system, filter)(*arguments, moved)
            replaced |= dict(zip(node.outputs, outputs, strict=True))
            noises.append((normals, moved, size))
    columns = zip(*noises, strict=True) if noises else ((), (), ())
    return clone_replace(list(graphs), replaced), MovedNoise(correlation, *columns)


def exactness(model: pm.Model) -> bool:
    """Whether sampling the model targets its posterior itself, without the bias of a filter."""
    ops = [node.op for node in _state_space_nodes(model).values()]
    return all(op.filter.is_exact_for(op.system) for op in ops)
