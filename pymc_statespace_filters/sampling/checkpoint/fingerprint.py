"""Fingerprints of a PyMC model and of its data, to tell whether a checkpoint is of the same run.

A model is identified by what its graphs compute. The digest of a variable is that of its operation
and of the digests of the operation's inputs, down to constants and to inputs by name. So two builds
of a model have the same fingerprint, in one process or in two: addresses and the order of sets do
not enter.
"""

import enum
import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import singledispatch
from types import FunctionType
from typing import Any

import numpy as np
import pymc as pm
from pytensor.compile.sharedvalue import SharedVariable
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.fg import FrozenFunctionGraph, FunctionGraph
from pytensor.graph.op import Op
from pytensor.graph.traversal import graph_inputs, io_toposort
from pytensor.graph.type import Type
from pytensor.tensor.random.type import RandomType

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.system.model import StateSpaceModel


def model_fingerprint(model: pm.Model) -> str:
    """Hash everything that the draws of a model depend on, except for the numbers in its data.

    Parameters
    ----------
    model : pymc.Model

    Returns
    -------
    str
        Hexadecimal SHA-256: the same for every build of the model, in every process of the same
        versions of PyMC and PyTensor. It changes with any constant, prior, transform, potential,
        deterministic, name, dimension, coordinate and initial value, with the equations of a
        `StateSpace` and with the settings of its filter. Of observed values and other data it holds
        type and name: see `model_data_fingerprint`. Of an operation of the user's own it holds the
        properties or attributes, not the Python code.

    Raises
    ------
    ModelError
        If an operation holds something that has no text which is the same in every process, such
        as a Python function without a name; the message names both.
    """
    known = {value: _digest("value of", rv.name) for rv, value in _roots(model).items()}
    names = {
        "free": [(rv.name, model.rvs_to_values[rv].name) for rv in model.free_RVs],
        "observed": [rv.name for rv in model.observed_RVs],
        "deterministics": [variable.name for variable in model.deterministics],
        "potentials": [variable.name for variable in model.potentials],
        "dims": dict(model.named_vars_to_dims),
        "coords": dict(model.coords),
        "starts": {rv.name: value for rv, value in model.rvs_to_initial_values.items()},
    }
    described = [_described(f"the model's {what}", value) for what, value in names.items()]
    return _digest(*described, _graph_digest(_outputs(model), known))


def model_data_fingerprint(model: pm.Model) -> str:
    """Hash all numbers that a model was given as data, with their names.

    Parameters
    ----------
    model : pymc.Model

    Returns
    -------
    str
        Hexadecimal SHA-256 of the names, types and bytes of observed values, of `pymc.Data`, and
        of every other shared variable that the model uses, including the noise seeds of its
        likelihoods. (The ``data_fingerprint`` of an evidence is another one: that of the observed
        values alone, which rival models share under any name.)
    """
    constants = {
        f"observed {rv.name}": value.data
        for rv, value in _roots(model).items()
        if isinstance(value, Constant)
    }
    used = [v for v in graph_inputs(_outputs(model)) if isinstance(v, SharedVariable)]
    shared = [
        (v.name, v.get_value(borrow=True) if isinstance(v, SharedVariable) else v.data)
        for v in dict.fromkeys([*model.data_vars, *used])
        # Generators are for draws outside the log-density, as in a posterior predictive.
        if not isinstance(v.type, RandomType)
    ]
    return _digest(_described("the model's data", [constants, shared]))


def _roots(model: pm.Model) -> dict[Variable, Variable]:
    """Values of random variables at which the graphs begin: of free ones, and constants."""
    return {
        rv: model.rvs_to_values[rv]
        for rv in model.basic_RVs
        if model.rvs_to_values[rv].owner is None
        and not isinstance(model.rvs_to_values[rv], SharedVariable)
    }


def _outputs(model: pm.Model) -> list[Variable]:
    return [model.logp(), *model.unobserved_value_vars]


def _graph_digest(outputs: Sequence[Variable], known: Mapping[Variable, str]) -> str:
    """Digest of what the outputs compute; inputs not in ``known`` enter by order, name and type.

    Equal parts of a graph have equal digests, whether they are one node or several.
    """
    digests = dict(known)
    n_unknown = 0

    def look_up(variable: Variable) -> str:
        nonlocal n_unknown
        if variable not in digests:
            if isinstance(variable, Constant):
                root = variable.data
            else:
                root = (n_unknown, variable.name)
                n_unknown += 1
            digests[variable] = _digest(_described(variable, [variable.type, root]))
        return digests[variable]

    for node in io_toposort(list(known), list(outputs)):
        arguments = [look_up(variable) for variable in node.inputs]
        operation = describe(node.op)
        for i, output in enumerate(node.outputs):
            digests[output] = _digest(operation, describe(output.type), i, *arguments)
    return _digest(*map(look_up, outputs))


def _digest(*parts: str | int) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()


class _UnstableError(Exception):
    """A value has no text that is the same in every process."""


def _described(what: object, value: Any) -> str:
    """Describe a value; where that is impossible, name in the error what the value belongs to."""
    try:
        return describe(value)
    except _UnstableError as error:
        raise ModelError(
            f"{what} holds {error}, which cannot be recognised in another process: a run of this "
            f"model could not be resumed from a checkpoint"
        ) from None


@singledispatch
def describe(value: Any) -> str:
    """A text that is equal for equal values, in every process."""
    if is_dataclass(value):
        return _of(value, {field.name: getattr(value, field.name) for field in fields(value)})
    text = repr(value)
    if text.startswith("<") or " at 0x" in text:
        raise _UnstableError(text)
    return f"{_name(type(value))}:{text}"


def _name(value: type | FunctionType) -> str:
    return f"{value.__module__}.{value.__qualname__}"


def _of(value: object, parts: Mapping[str, Any]) -> str:
    return f"{_name(type(value))}{describe(dict(parts))}"


@describe.register(bool | int | float | complex | str | bytes | None)
def _(value: Any) -> str:
    return repr(value)


@describe.register(np.ndarray | np.generic)
def _(value: Any) -> str:
    array = np.asarray(value)
    if array.dtype.hasobject:
        return f"{array.shape}{describe(array.ravel().tolist())}"
    content = array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes()
    return f"{array.dtype}{array.shape}{hashlib.sha256(content).hexdigest()}"


@describe.register(tuple | list)
def _(value: Any) -> str:
    return f"{_name(type(value))}({', '.join(map(describe, value))})"


@describe.register(slice)
def _(value: slice) -> str:
    return f"slice{describe((value.start, value.stop, value.step))}"


@describe.register(set | frozenset)
def _(value: Any) -> str:
    return f"set({', '.join(sorted(map(describe, value)))})"


@describe.register
def _(value: Mapping) -> str:
    items = sorted((describe(key), describe(item)) for key, item in value.items())
    return f"{{{', '.join(f'{key}: {item}' for key, item in items)}}}"


@describe.register
def _(value: enum.Enum) -> str:
    return f"{_name(type(value))}.{value.name}"


@describe.register
def _(value: type) -> str:
    return _name(value)


@describe.register
def _(value: FunctionType) -> str:
    found: Any = sys.modules.get(value.__module__)
    for part in value.__qualname__.split("."):
        found = getattr(found, part, None)
    if found is not value:
        raise _UnstableError(f"the function {value!r}")
    return _name(value)


@describe.register
def _(value: StateSpaceModel) -> str:
    return _of(value, {name: getattr(value, name) for name in StateSpaceModel.__annotations__})


@describe.register
def _(value: Variable) -> str:
    return _graph_digest([value], {})


@describe.register(FunctionGraph | FrozenFunctionGraph)
def _(value: Any) -> str:
    inputs = {v: _digest("input", i, describe(v.type)) for i, v in enumerate(value.inputs)}
    return _graph_digest(value.outputs, inputs)


@describe.register
def _(value: Type) -> str:
    names = getattr(value, "__props__", vars(value))
    return _of(value, {name: getattr(value, name) for name in names})


@describe.register
def _(value: Op) -> str:
    kind = _name(type(value))
    parts = [
        f"{name}={_described(f'{name!r} of the operation {kind}', setting)}"
        for name, setting in _settings(value).items()
    ]
    return f"{kind}({', '.join(parts)})"


# Attributes of loops and optimisers beside the graph that they run.
_AROUND_A_GRAPH = ("info", "truncate_gradient", "method", "optimizer_kwargs", "bound_kwargs")


def _settings(op: Op) -> dict[str, Any]:
    """The properties of an operation, else all its attributes; and its inner graph."""
    names = getattr(op, "__props__", _AROUND_A_GRAPH if hasattr(op, "fgraph") else vars(op))
    settings = {name: getattr(op, name) for name in names if hasattr(op, name)}
    settings.pop("output_types_preference", None)  # a function; the types themselves are described
    if hasattr(op, "fgraph"):
        settings["fgraph"] = op.fgraph
    return settings
