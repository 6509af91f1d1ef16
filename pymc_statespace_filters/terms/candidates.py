"""The candidates: which scalars of a model vanish together, and at which values."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from ..errors import ModelError
from ..pymc_model.elements import Columns, Elements
from ..pymc_model.ends_of_support import ends_of_support, falls_to_zero
from ..pymc_model.prior import is_improper
from ..pymc_model.switched_density import Switches
from ..system.checks import is_finite

Key = str | tuple[str, ...]


@dataclass(frozen=True)
class Candidates:
    """The K candidate terms of a model."""

    elements: Elements  # of the model
    switches: Switches  # their columns of the unconstrained vector, and where they vanish
    keys: tuple[Key, ...]  # their names: a scalar, or a tuple of scalars

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def labels(self) -> list[str]:
        """Their names in results: a tuple that has all elements of a variable has its name."""
        sizes = Counter(self.elements.variables)
        found = []
        for own in map(np.ndarray.tolist, self.switches.columns):
            variables = [self.elements.variables[column] for column in own]
            whole = {name for name, n in Counter(variables).items() if 1 < n == sizes[name]}
            names = (
                name if name in whole else self.elements.labels[column]
                for name, column in zip(variables, own, strict=True)
            )  # fmt: skip
            found.append(", ".join(dict.fromkeys(names)))
        return found

    @property
    def variables(self) -> list[str]:
        """The names of the free variables that they are of, in the order of the model."""
        columns = np.sort(np.concatenate(self.switches.columns))
        return list(dict.fromkeys(self.elements.variables[column] for column in columns))

    def numbers(self, key: Any, argument: str) -> list[int]:
        """The numbers of the candidates that an argument names: several for a whole vector."""
        if key in self.keys:  # as results label it, whatever else that may stand for
            return [self.keys.index(key)]
        named = {one for of in _columns(key, self.elements, argument) for one in of}
        found = [i for i, own in enumerate(self.switches.columns) if named.issuperset(own)]
        if sum(len(self.switches.columns[i]) for i in found) < len(named):
            raise ModelError(
                f"{argument} must name candidates, those of absent, {list(self.keys)}, got {key!r}"
            )
        return found


def read_candidates(model: pm.Model, absent: Mapping[Any, Any]) -> Candidates:
    """Check the argument ``absent`` of `select_terms`."""
    if not isinstance(absent, Mapping) or not absent:
        raise ModelError(
            "absent must be a dictionary from candidates to the values at which they vanish, such "
            f"as {{'k3': 0.0}}, got {absent!r}"
        )
    elements = Elements.of(model)
    columns: list[NDArray[np.int64]] = []
    values: list[NDArray[np.float64]] = []
    taken: dict[int, Any] = {}
    for key, value in absent.items():
        for own, at in _terms(key, value, elements):
            for column in own.tolist():
                if column in taken:
                    raise ModelError(
                        f"absent must name every scalar once, got {elements.labels[column]!r} in "
                        f"{taken[column]!r} and in {key!r}"
                    )
                taken[column] = key
            columns.append(own)
            values.append(at)
    labels = [tuple(elements.labels[column] for column in own) for own in columns]
    keys = tuple(own if len(own) > 1 else own[0] for own in labels)
    candidates = Candidates(elements, Switches(tuple(columns), tuple(values)), keys)
    _check_proper(candidates, model)
    _check_support(candidates, model)
    _check_density(candidates, model)
    return candidates


def _terms(
    key: Any, value: Any, elements: Elements
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Columns and values of the candidates of a key of ``absent``.

    These are the elements of a vector, one by one; or all that a tuple names, together.
    """
    columns = _columns(key, elements, "absent")
    own = np.array([one for of in columns for one in of])
    at = _values(key, value, list(map(len, columns)))
    if isinstance(key, tuple):
        yield own, at
    else:
        yield from zip(own[:, None], at[:, None], strict=True)


def _columns(key: Any, elements: Elements, argument: str) -> list[Columns]:
    """The columns of each name in a key."""
    names = (key,) if isinstance(key, str) else key
    is_tuple = isinstance(names, tuple) and bool(names)
    if not is_tuple or not all(isinstance(name, str) for name in names):
        raise ModelError(f"{argument} must have names, or tuples of names, as keys, got {key!r}")
    return [elements.columns(name, argument) for name in names]


def _check_proper(candidates: Candidates, model: pm.Model) -> None:
    for name in candidates.variables:
        if is_improper(model[name], model):
            raise ModelError(
                f"the prior of {name!r} is improper or not normalised, and the probability of its "
                f"term is proportional to an unknown number: give it a proper prior, such as "
                f"pm.Normal({name!r}, ...)"
            )


def _check_support(candidates: Candidates, model: pm.Model) -> None:
    """Raise if a term vanishes where its prior has no density; the edge is no such place."""
    elements, switches = candidates.elements, candidates.switches
    limits = {name: _limits(name, elements, model) for name in candidates.variables}
    columns, values = np.concatenate(switches.columns), np.concatenate(switches.values)
    for column, value in zip(columns, values, strict=True):
        lower, upper = limits[elements.variables[column]][column]
        if not lower <= value <= upper:
            raise ModelError(
                f"absent must give a value of {elements.labels[column]!r} that its prior permits, "
                f"from {lower:g} to {upper:g}, got {value:g}"
            )


def _check_density(candidates: Candidates, model: pm.Model) -> None:
    """Raise if the density of a prior is zero where its term vanishes, as of a LogNormal at zero.

    The model with the term does not contain the one without it then, not even as a limit.
    """
    elements, switches = candidates.elements, candidates.switches
    columns, values = np.concatenate(switches.columns), np.concatenate(switches.values)
    for name in candidates.variables:
        own = np.array([i for i, of in enumerate(elements.variables) if of == name])
        held = switches.held_at(len(elements.variables))[own]
        falls = falls_to_zero(model[name], held, model)
        if (without := own[falls & np.isin(own, columns)]).size:
            label, value = elements.labels[without[0]], values[columns == without[0]][0]
            prior = model[name].owner.op._print_name[0]
            raise ModelError(
                f"the prior of {label!r}, {prior}, has no density at {value:g}, where its term "
                "vanishes: small terms are improbable under it too. Give a prior with a density "
                f"there, such as pm.HalfNormal({name!r}, ...) at zero; or compare the evidences of "
                "two models, with the term and without"
            )


def _limits(name: str, elements: Elements, model: pm.Model) -> dict[int, tuple[float, float]]:
    """The limits of a variable by column; infinite if they depend on others, or are joint."""
    columns = [i for i, of in enumerate(elements.variables) if of == name]
    ends = ends_of_support(model[name], model)
    if ends is None or len(ends[0]) != len(columns):
        return dict.fromkeys(columns, (-np.inf, np.inf))
    return dict(zip(columns, zip(*ends, strict=True), strict=True))


def _values(key: Key, value: Any, sizes: list[int]) -> NDArray[np.float64]:
    """The values of all scalars of a key, from one for each name, or for each of its elements."""
    given = [value] if len(sizes) == 1 else value
    if isinstance(given, tuple | list | np.ndarray) and len(given) == len(sizes):
        flat = [_flat(one, size) for one, size in zip(given, sizes, strict=True)]
        if all(len(one) == size for one, size in zip(flat, sizes, strict=True)):
            return np.concatenate(flat).astype(float)
    what = "a finite number" if len(sizes) == 1 else f"{len(sizes)} finite numbers"
    elements = "" if max(sizes) == 1 else ", or as many as it has elements,"
    raise ModelError(
        f"absent must give {what}{elements} for {key!r}, at which its term vanishes, got {value!r}"
    )


def _flat(value: Any, size: int) -> list[Any]:
    """Finite numbers, a single one ``size`` times; empty if they are something else."""
    flat = list(value.flat) if isinstance(value, np.ndarray) else value
    flat = flat if isinstance(flat, tuple | list) else [flat]
    if not all(is_finite(one) for one in flat):
        return []
    return list(flat) * (size if len(flat) == 1 else 1)
