"""The candidates: which scalars of a model vanish together, and at which values."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from ..errors import ModelError
from ..pymc_model.inspection import element_names
from ..pymc_model.prior import is_improper
from ..pymc_model.switched_density import Switches
from ..system.checks import is_finite
from .support import support

Key = str | tuple[str, ...]


@dataclass(frozen=True)
class Candidates:
    """The K candidate terms of a model.

    Attributes
    ----------
    keys : tuple
        As the user has named them: a scalar, or a tuple of scalars.
    switches : Switches
        Their columns of the unconstrained vector, and the values at which they vanish.
    """

    keys: tuple[Key, ...]
    switches: Switches

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def labels(self) -> list[str]:
        """Their names in results."""
        return [label(key) for key in self.keys]

    def number(self, key: Any, argument: str) -> int:
        """The number of the candidate that an argument names."""
        if key not in self.keys:
            raise ModelError(
                f"{argument} must name candidates, the keys of absent, {list(self.keys)}, got "
                f"{key!r}"
            )
        return self.keys.index(key)


def label(key: Key) -> str:
    """The name of a candidate in results."""
    return key if isinstance(key, str) else ", ".join(key)


def read_candidates(model: pm.Model, absent: Mapping[Any, Any]) -> Candidates:
    """Check the argument ``absent`` of `select_terms`."""
    if not isinstance(absent, Mapping) or not absent:
        raise ModelError(
            "absent must be a dictionary from candidates to the values at which they vanish, such "
            f"as {{'k3': 0.0}}, got {absent!r}"
        )
    names = element_names(model)
    columns: list[NDArray[np.int64]] = []
    values: list[NDArray[np.float64]] = []
    taken: dict[str, Key] = {}
    for key, value in absent.items():
        members = _members(key)
        for name in members:
            _check_name(name, names, model)
            if name in taken:
                raise ModelError(
                    f"absent must name every scalar once, got {name!r} in {taken[name]!r} and in "
                    f"{key!r}"
                )
            taken[name] = key
        _check_proper(members, model)
        columns.append(np.array([names.index(name) for name in members]))
        values.append(_values(key, value, len(members)))
        _check_support(members, values[-1], names, model)
    return Candidates(tuple(absent), Switches(tuple(columns), tuple(values)))


def _members(key: Any) -> tuple[str, ...]:
    members = (key,) if isinstance(key, str) else key
    is_tuple = isinstance(members, tuple) and bool(members)
    if not is_tuple or not all(isinstance(name, str) for name in members):
        raise ModelError(
            f"absent must have names of scalars, or tuples of such names, as keys, got {key!r}"
        )
    return members


def _check_name(name: str, names: list[str], model: pm.Model) -> None:
    if name in names:
        return
    if elements := [one for one in names if one.startswith(f"{name}[")]:
        raise ModelError(
            f"absent must name scalars, got {name!r} of {len(elements)} elements: name them one by "
            f"one, {elements[0]!r} to {elements[-1]!r}, or a tuple of them that comes and goes "
            "together"
        )
    kind = "no free variable" if name in model.named_vars else "unknown"
    raise ModelError(
        f"absent must name free variables of the model, or elements of them, got {name!r}, which "
        f"is {kind}: the model has {names}"
    )


def _check_proper(members: tuple[str, ...], model: pm.Model) -> None:
    for name in dict.fromkeys(one.partition("[")[0] for one in members):
        if is_improper(model[name], model):
            raise ModelError(
                f"the prior of {name!r} is improper or not normalised, and the probability of its "
                f"term is proportional to an unknown number: give it a proper prior, such as "
                f"pm.Normal({name!r}, ...)"
            )


def _check_support(
    members: tuple[str, ...], values: NDArray[np.float64], names: list[str], model: pm.Model
) -> None:
    """Raise if a term vanishes where its prior has no density; the edge is no such place."""
    for name, value in zip(members, values, strict=True):
        own = name.partition("[")[0]
        elements = [one for one in names if one.partition("[")[0] == own]
        limits = support(model[own], model, len(elements))
        lower, upper = (float(one[elements.index(name)]) for one in limits)
        if not lower <= value <= upper:
            raise ModelError(
                f"absent must give a value of {name!r} that its prior permits, from {lower:g} to "
                f"{upper:g}, got {value:g}"
            )


def _values(key: Key, value: Any, count: int) -> NDArray[np.float64]:
    given = [value] if is_finite(value) else value
    if isinstance(given, tuple | list | np.ndarray) and len(given) == count:
        if all(is_finite(one) for one in given):
            return np.array(given, dtype=float)
    what = "a finite number" if count == 1 else f"{count} finite numbers"
    raise ModelError(
        f"absent must give {what} for {key!r}, at which its term vanishes, got {value!r}"
    )
