"""Rewrites of a model's graphs that replace its likelihoods: callbacks, moved noise, other filters.

Every function takes graphs and returns new ones; the model itself is not changed.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import pymc as pm
import pytensor.tensor as pt
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.replace import clone_replace
from pytensor.tensor.variable import TensorVariable

from ..compiler.lowering.compiled_system import compile_system
from ..errors import ModelError
from ..filters import EKF, IPLF
from ..filters.checks import check_system_and_filter, takes
from ..filters.protocol import Filter, ToleranceFilter
from ..ops.distributed import CallbackLogLikelihood, CallbackLogLikelihoodOfNoise
from ..ops.likelihood import LogLikelihood, LogLikelihoodOfNoise, StoredNoise
from ..ops.signatures import PANEL
from ..system.model import StateSpaceModel
from .inspection import likelihood_nodes, noisy_filters, state_space_nodes


class CallbackLikelihoods(NamedTuple):
    """The symbols of `with_likelihood_callback`.

    The callback evaluates likelihoods of these ``kinds``, and is called with an index into them.
    The input ``address`` is its address; at 0 the filters evaluate. ``normals`` are inputs, each
    with the expression of its values, which depends only on the seed and on the steps of the
    record. With an empty vector the filter draws from its seed.
    """

    kinds: tuple[tuple[StateSpaceModel, Filter], ...]
    address: TensorVariable
    normals: dict[TensorVariable, TensorVariable]


def with_likelihood_callback(
    graphs: Sequence[Variable], held: Mapping[str, SharedVariable]
) -> tuple[list[Variable], CallbackLikelihoods]:
    """Graphs whose noisy likelihoods a `PythonCallback` can evaluate, with the same values.

    Likelihoods whose seed is in ``held`` read stored normals, made once from that seed. Those of
    panels stay as they are.
    """
    address = pt.lscalar("callback")
    replaced: dict[Variable, Variable] = {}
    normals: dict[TensorVariable, TensorVariable] = {}
    names = {seed: name for name, seed in held.items()}
    nodes = [node for node in likelihood_nodes(graphs) if node.op.filter.noisy]
    noisy_nodes = [node for node in nodes if node.op.form != PANEL]
    for number, node in enumerate(noisy_nodes):
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
    kinds = tuple((node.op.system, node.op.filter) for node in noisy_nodes)
    return clone_replace(list(graphs), replaced), CallbackLikelihoods(kinds, address, normals)


class AutoregressiveNoise(NamedTuple):
    """The symbols of `autoregressive_noise`; one entry per noisy variable."""

    correlation: TensorVariable  # input, from 0 to 1: of the moved normals with the current ones
    normals: tuple[TensorVariable, ...]  # inputs: the current ones, finite, ``sizes`` of them
    moved: tuple[TensorVariable, ...]  # which are stored if the move is accepted
    sizes: tuple[TensorVariable, ...]  # numbers, functions of the steps of the record alone


def autoregressive_noise(
    graphs: Sequence[Variable], seeds: Mapping[str, SharedVariable]
) -> tuple[list[Variable], AutoregressiveNoise]:
    """Graphs whose noise is an autoregressive move of given normals, not a fresh draw.

    Normals u become rho u + sqrt(1 - rho^2) v, where v are drawn from the seed; the result is
    standard normal again (Deligiannidis, Doucet and Pitt 2018). Filters are replaced by their
    smooth versions, whose estimate moves little if the normals do. With rho = 0 the estimate is
    that of the seed.
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
            if node.op.form == PANEL:
                raise ModelError(
                    "correlation must be None for a panel, whose records keep estimates of their "
                    "own"
                )
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

    ``filters`` maps names of variables to their new filters. Data, parameters and seed stay the
    same: a deterministic filter ignores the seed, and a noisy filter that replaces a deterministic
    one uses that variable's constant seed.
    """
    variables = state_space_nodes(model)
    for name, filter in filters.items():
        if name not in variables:
            raise ModelError(
                f"filters must name StateSpace variables, {list(variables)}, got {name!r}"
            )
        check_system_and_filter(variables[name].op.system, filter)
    replaced: dict[Variable, Variable] = {}
    found: set[str] = set()
    for node in likelihood_nodes(graphs):
        names = [name for name in variables if _is_likelihood_of(node, model, variables[name])]
        found.update(names)
        new = {filters.get(name, node.op.filter) for name in names}
        if len(new) > 1:
            raise ModelError(
                f"filters must be the same for {', '.join(names)}: their likelihoods are equal"
            )
        if names:
            outputs = node.op.of(node.op.system, new.pop())(*node.inputs)
            replaced |= dict(zip(node.outputs, outputs, strict=True))
    if missing := [name for name in filters if name not in found]:
        raise ModelError(f"the graphs must contain the likelihood of {', '.join(missing)}")
    return clone_replace(list(graphs), replaced)


def _is_likelihood_of(node: Any, model: pm.Model, variable: Any) -> bool:
    """Whether a likelihood node has the system, filter, steps, data and seed of a variable."""
    expected = (variable.inputs[3], model.rvs_to_values[variable.outputs[1]], variable.inputs[-1])
    found = (node.inputs[1], node.inputs[2], node.inputs[-1])
    same_op = (node.op.system, node.op.filter) == (variable.op.system, variable.op.filter)
    return same_op and all(map(_is_same, found, expected))


def _is_same(a: Variable, b: Variable) -> bool:
    """Whether two inputs are the same variable or equal constants, which PyMC merges."""
    return a is b or (isinstance(a, Constant) and isinstance(b, Constant) and a.equals(b))


def smooth_filters(model: pm.Model) -> dict[str, Filter]:
    """The filters that `autoregressive_noise` uses, by the names of the noisy variables."""
    nodes = state_space_nodes(model)
    ops = {name: nodes[name].op for name in noisy_filters(model)}
    return {name: op.filter.smooth(compile_system(op.system)) for name, op in ops.items()}


def expensive_variables(model: pm.Model) -> list[str]:
    """Names of the variables whose filter takes milliseconds: particles, members or a grid."""
    filters = {name: node.op.filter for name, node in state_space_nodes(model).items()}
    return [name for name, one in filters.items() if one.noisy or isinstance(one, ToleranceFilter)]


def coarse_filters(model: pm.Model) -> dict[str, Filter]:
    """The coarse forms of the filters that have one and are not coarse, by names."""
    filters = {name: node.op.filter for name, node in state_space_nodes(model).items()}
    coarse = {n: f.coarse() for n, f in filters.items() if isinstance(f, ToleranceFilter)}
    return {name: filter for name, filter in coarse.items() if filter != filters[name]}


def pilot_filters(model: pm.Model, *, takes_counts: bool) -> dict[str, Filter]:
    """An `EKF` in place of each expensive filter, by names; none if a system does not allow it.

    With ``takes_counts``, an `IPLF` for counts and other observations that an `EKF` does not take.
    """
    candidates: list[Filter] = [EKF(), IPLF()] if takes_counts else [EKF()]
    nodes, found = state_space_nodes(model), dict[str, Filter]()
    for name in expensive_variables(model):
        system = compile_system(nodes[name].op.system)
        taken = [one for one in candidates if takes(one, system)]
        if not taken:
            return {}
        found[name] = taken[0]
    return found
