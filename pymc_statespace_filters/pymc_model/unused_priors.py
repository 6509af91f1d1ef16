"""Warnings of priors that reach no data: a name is misspelt, or all data are missing."""

import difflib
from collections.abc import Iterator
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pymc as pm
from pytensor.graph.basic import Constant
from pytensor.graph.traversal import ancestors

from ..errors import ModelWarning, warn
from ..system.equations import RESERVED
from .held_seed import BETWEEN
from .inspection import parameter_graphs, state_space_nodes

# Of the similarity of two names from 0 to 1: "beta" and "b" have 0.4.
_SIMILAR = 0.35
# Names of which a model has been told: it is compiled several times in one run.
_told: WeakKeyDictionary[pm.Model, set[str]] = WeakKeyDictionary()


def warn_of_unused_priors(model: pm.Model) -> None:
    """Warn once of each free variable that nothing uses: its posterior is its prior."""
    nodes = state_space_nodes(model)
    fixed = {
        name: label for label, node in nodes.items() for name in _constant_parameters(model, node)
    }
    told = _told.setdefault(model, set())
    for name in _unused_priors(model, nodes):
        if name in told:
            continue
        told.add(name)
        warn(
            f"the prior of {name!r} reaches no likelihood, so its posterior is the prior"
            + _probable_cause(name, fixed),
            ModelWarning,
            *BETWEEN,
        )


def warn_of_no_data(name: str, observed: Any) -> None:
    """Warn if data that cannot be set later have no number."""
    if isinstance(observed, Constant) and np.isnan(observed.data).all():
        warn(
            f"observed of {name!r} has no number, all of its {len(observed.data)} rows are missing "
            "(NaN), so that the posterior is the prior",
            ModelWarning,
            *BETWEEN,
        )


def _unused_priors(model: pm.Model, nodes: dict[str, Any]) -> Iterator[str]:
    """Names of free variables that neither data nor a Deterministic depend on.

    A variable that depends on one that reaches data is predicted, and not unused. A Deterministic
    excuses no name that is reserved, which was meant to be a parameter.
    """
    data = [*model.observed_RVs, *model.potentials]
    if not (data and nodes):
        return
    free = set(model.free_RVs)
    reached = free & set(ancestors([*data, *(node.outputs[1] for node in nodes.values())]))
    shown = free & set(ancestors(model.deterministics))
    for rv in model.free_RVs:
        excused = rv in shown and rv.name not in RESERVED
        if not (rv in reached or excused) and not reached & set(ancestors([rv])):
            yield rv.name


def _constant_parameters(model: pm.Model, node: Any) -> list[str]:
    """The parameters of a StateSpace variable that depend on no random variable."""
    random = set(model.basic_RVs)
    graphs = parameter_graphs(node).items()
    return [name for name, graph in graphs if random.isdisjoint(ancestors([graph]))]


def _probable_cause(name: str, fixed: dict[str, str]) -> str:
    """What was probably meant, given the fixed parameters and the variables that have them."""
    if name in RESERVED:
        return (
            f": {name!r} is {RESERVED[name]} in the functions of a system, never a parameter. Give "
            "the parameter another name"
        )
    similar = difflib.get_close_matches(name.lower(), fixed, n=1, cutoff=_SIMILAR)
    if similar:
        (near,) = similar
        return (
            f". The parameter {near!r} of {fixed[near]!r} is fixed at a number, its default if you "
            f"gave none: name the prior {near!r}, or give params={{{near!r}: {name}}}"
        )
    others = f"; of the parameters, {list(fixed)} are fixed at numbers" if fixed else ""
    return (
        f"{others}. Give a parameter of the system this name, or remove the prior; one that you "
        "want to keep is used in a pm.Deterministic"
    )
