"""What samplers, evidence and diagnostics need to know of the state-space variables in a model."""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple

import pymc as pm
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.replace import clone_replace
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evaluation.log_likelihood import check_kinds
from pymc_statespace_filters.filters.outcomes import COLLAPSED, FAILURES
from pymc_statespace_filters.filters.protocol import Filter
from pymc_statespace_filters.ops.distributed import (
    CallbackLogLikelihood,
    CallbackLogLikelihoodOfNoise,
    PythonCallback,
)
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.ops.noise import LogLikelihoodOfNoise, StoredNoise
from pymc_statespace_filters.pymc_model.random_variable import StateSpaceRV
from pymc_statespace_filters.system.model import StateSpaceModel

__all__ = [
    "COLLAPSED",
    "FAILURES",
    "AutoregressiveNoise",
    "CallbackLikelihoods",
    "PythonCallback",
    "autoregressive_noise",
    "exactness",
    "health_outputs",
    "is_filter",
    "likelihood_nodes",
    "log_density_terms",
    "noise_seeds",
    "noisy_filters",
    "resized",
    "smooth_filters",
    "state_space_names",
    "state_space_nodes",
    "with_filter",
    "with_likelihood_callback",
]


def state_space_nodes(model: pm.Model) -> dict[str, Any]:
    """The application behind every StateSpace variable; parameters are its last five inputs."""
    return {
        rv.name: rv.owner
        for rv in model.basic_RVs
        if rv.owner is not None and isinstance(rv.owner.op, StateSpaceRV)
    }


def likelihood_nodes(graphs: Sequence[Variable]) -> list[Any]:
    """The applications of likelihood operations that graphs depend on, each once."""
    nodes = {v.owner: None for v in ancestors(graphs) if v.owner is not None}
    return [node for node in nodes if isinstance(node.op, LogLikelihood)]


def log_density_terms(model: pm.Model) -> list[tuple[str, TensorVariable]]:
    """The terms of a model's log-density, with the names of the variables they belong to."""
    names = [variable.name for variable in [*model.basic_RVs, *model.potentials]]
    return list(zip(names, model.logp(sum=False), strict=True))


def state_space_names(model: pm.Model) -> list[str]:
    """The names of the StateSpace variables."""
    return list(state_space_nodes(model))


def noise_seeds(model: pm.Model) -> dict[str, SharedVariable]:
    """The shared noise seed of every variable whose likelihood is a random estimate."""
    seeds = {}
    for name, node in state_space_nodes(model).items():
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


def noisy_filters(model: pm.Model) -> dict[str, Filter]:
    """The filter of every variable whose likelihood is a random estimate."""
    filters = {name: node.op.filter for name, node in state_space_nodes(model).items()}
    return {name: filter for name, filter in filters.items() if filter.noisy}


def is_filter(value: object) -> bool:
    """Whether a value is the settings of a filter."""
    return isinstance(value, Filter) and not isinstance(value, type)


def resized(filter: Any, n_members: int) -> Filter:
    """The same noisy filter with another number of members, the first of its settings."""
    count: dict[str, Any] = {fields(filter)[0].name: n_members}
    return replace(filter, **count)


def health_outputs(graphs: Sequence[Variable]) -> list[TensorVariable]:
    """The health vector of every filter evaluation in the graphs: see `ops.LogLikelihood`."""
    return [node.outputs[1] for node in likelihood_nodes(graphs)]


class CallbackLikelihoods(NamedTuple):
    """The symbols of `with_likelihood_callback`.

    Attributes
    ----------
    kinds : tuple of (StateSpaceModel, filter)
        The likelihoods that a delegate is to evaluate, by the number that it is called with.
    address : TensorVariable
        Input: of the delegate; with 0 the filters evaluate.
    normals : dict of TensorVariable to TensorVariable
        Inputs, and the expressions of their values, which depend on the seed and on the steps of
        the record alone. An empty vector makes the filter read its seed after all.
    """

    kinds: tuple[tuple[StateSpaceModel, Filter], ...]
    address: TensorVariable
    normals: dict[TensorVariable, TensorVariable]


def with_likelihood_callback(
    graphs: Sequence[Variable], held: Mapping[str, SharedVariable]
) -> tuple[list[Variable], CallbackLikelihoods]:
    """Graphs whose noisy likelihoods a `PythonCallback` can evaluate, with the same values.

    With seeds that are held, stored normals are read where they were made from one of these.
    """
    address = pt.lscalar("delegate")
    replaced: dict[Variable, Variable] = {}
    normals: dict[TensorVariable, TensorVariable] = {}
    names = {seed: name for name, seed in held.items()}
    delegable = [node for node in likelihood_nodes(graphs) if node.op.filter.noisy]
    for number, node in enumerate(delegable):
        system, filter = node.op.system, node.op.filter
        steps, seed = node.inputs[1], node.inputs[-1]
        if seed in names:
            stored = pt.dvector(f"{names[seed]}_normals")
            normals[stored] = StoredNoise(system, filter)(steps, seed)
            op: LogLikelihood = CallbackLogLikelihoodOfNoise(system, filter)
            outputs = op(*node.inputs, stored, number, address)
        else:
            outputs = CallbackLogLikelihood(system, filter)(*node.inputs, number, address)
        replaced |= dict(zip(node.outputs, outputs, strict=True))
    kinds = tuple((node.op.system, node.op.filter) for node in delegable)
    return clone_replace(list(graphs), replaced), CallbackLikelihoods(kinds, address, normals)


class AutoregressiveNoise(NamedTuple):
    """The symbols of `autoregressive_noise`; one entry per noisy variable.

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


def autoregressive_noise(
    graphs: Sequence[Variable], seeds: Mapping[str, SharedVariable]
) -> tuple[list[Variable], AutoregressiveNoise]:
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
    for node in likelihood_nodes(graphs):
        if node.inputs[-1] in names:
            *arguments, seed = node.inputs
            system, noisy, steps = node.op.system, node.op.filter, arguments[1]
            compiled = compile_system(system)
            filter = noisy.smooth(compiled)
            filter.check(compiled)
            normals = pt.dvector(f"{names[seed]}_normals")
            fresh = StoredNoise(system, filter)(steps, seed)
            moved = correlation * normals + innovation * fresh
            # The sum of one element, or of none: the last step of an empty record is 0.
            size = filter.n_normals(compiled, pt.sum(steps[-1:]), steps.shape[0])
            outputs = LogLikelihoodOfNoise(system, filter)(*arguments, moved)
            replaced |= dict(zip(node.outputs, outputs, strict=True))
            noises.append((normals, moved, size))
    columns = zip(*noises, strict=True) if noises else ((), (), ())
    return clone_replace(list(graphs), replaced), AutoregressiveNoise(correlation, *columns)


def with_filter(
    graphs: Sequence[Variable], model: pm.Model, filters: Mapping[str, Filter]
) -> list[Variable]:
    """Graphs of a model's log-density in which some variables have another filter.

    The mapping gives the new filters by the name of their variable. Data, parameters and seed stay:
    a deterministic filter does not read the seed, and one that was put in the place of a
    deterministic filter has that variable's constant seed.

    Raises
    ------
    ModelError
        If a name is not that of a StateSpace variable, its likelihood is not in the graphs, or the
        filter cannot treat its system.
    """
    variables = state_space_nodes(model)
    for name, filter in filters.items():
        if name not in variables:
            raise ModelError(f"{name!r} is not a StateSpace variable: expected {list(variables)}")
        check_kinds(variables[name].op.system, filter)
    replaced: dict[Variable, Variable] = {}
    found: set[str] = set()
    for node in likelihood_nodes(graphs):
        names = [name for name in variables if _is_likelihood_of(node, model, variables[name])]
        found.update(names)
        new = {filters.get(name, node.op.filter) for name in names}
        if len(new) > 1:
            raise ModelError(f"{', '.join(names)} cannot be told apart, they need one filter")
        if names:
            outputs = LogLikelihood(node.op.system, new.pop())(*node.inputs)
            replaced |= dict(zip(node.outputs, outputs, strict=True))
    if missing := [name for name in filters if name not in found]:
        raise ModelError(f"the graphs hold no likelihood of {', '.join(missing)}")
    return clone_replace(list(graphs), replaced)


def _is_likelihood_of(node: Any, model: pm.Model, variable: Any) -> bool:
    """Whether a likelihood is that of a variable: its system, filter, steps, data and seed."""
    own = (variable.inputs[3], model.rvs_to_values[variable.outputs[1]], variable.inputs[-1])
    theirs = (node.inputs[1], node.inputs[2], node.inputs[-1])
    same_op = (node.op.system, node.op.filter) == (variable.op.system, variable.op.filter)
    return same_op and all(map(_is_same, theirs, own))


def _is_same(a: Variable, b: Variable) -> bool:
    """Whether two inputs are one: PyMC merges equal constants."""
    return a is b or (isinstance(a, Constant) and isinstance(b, Constant) and a.equals(b))


def smooth_filters(model: pm.Model) -> dict[str, Filter]:
    """The filters that `autoregressive_noise` uses, by the names of the noisy variables."""
    nodes = state_space_nodes(model)
    ops = {name: nodes[name].op for name in noisy_filters(model)}
    return {name: op.filter.smooth(compile_system(op.system)) for name, op in ops.items()}


def exactness(model: pm.Model) -> bool:
    """Whether sampling the model targets its posterior itself, without the bias of a filter."""
    ops = [node.op for node in state_space_nodes(model).values()]
    return all(op.filter.is_exact_for(compile_system(op.system)) for op in ops)
