"""Parameters that are states: their values in the equations, their start and their moves.

A drifting parameter is a state on the scale of its process, behind the states of the user, and has
a noise behind those of the user. The equations of a step see the value that it has at the beginning
of the step; it moves once, at the end.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.basic import Constant
from pytensor.tensor.variable import TensorVariable

from .drift_processes import DriftProcess
from .links import Link

Values = Mapping[str, TensorVariable]


@dataclass(frozen=True)
class DriftingParameter:
    """A parameter, or one element of a parameter, that is a state.

    ``name`` is that of the state, such as "b[2]"; ``index`` is the place in the parameter, () in a
    scalar. ``laws`` are names of the parameters of the process, the strength first, and where in
    them the values of this state are.
    """

    name: str
    parameter: str
    index: tuple[int, ...]
    process: DriftProcess
    laws: tuple[str, ...]
    law_index: tuple[int, ...]

    @property
    def link(self) -> Link:
        """The scale of the state."""
        return self.process.link

    @property
    def strength(self) -> str:
        """Name of the parameter that holds the strength; its element is ``law_index``."""
        return self.laws[0]

    def start(self, values: Values) -> TensorVariable:
        """The number on the scale at the start."""
        return self.link.forward(values[self.parameter][self.index])

    def moved(
        self, now: TensorVariable, noise: TensorVariable, row: "MovingRow", values: Values
    ) -> TensorVariable:
        """The number on the scale a step later."""
        laws = [values[name][self.law_index] for name in self.laws]
        every = self.process.every
        length = row.length if every == 1 else every * row.dt
        move = self.process.move(now, self.start(values), noise, length, laws)
        return now + (move if every == 1 else row.flags[every] * move)


@dataclass(frozen=True)
class MovingRow:
    """When parameters move at the end of a step.

    That is after its length, a number or a symbol, or where ``flags`` has a one for those that are
    held for so many steps ``dt``.
    """

    length: Any
    dt: float
    flags: Mapping[int, TensorVariable]


def held_for(drifting: Sequence[DriftingParameter]) -> tuple[int, ...]:
    """The numbers of steps, above one, for which some parameters are held."""
    return tuple(dict.fromkeys(one.process.every for one in drifting if one.process.every > 1))


def values_now(
    drifting: Sequence[DriftingParameter], values: Values, numbers: TensorVariable
) -> dict[str, TensorVariable]:
    """The values of a step: drifting parameters from their numbers on the scale."""
    found = dict(values)
    elements: dict[str, dict[tuple[int, ...], TensorVariable]] = {}
    for i, one in enumerate(drifting):
        elements.setdefault(one.parameter, {})[one.index] = one.link.inverse(numbers[i])
    for name, moving in elements.items():
        found[name] = _with_elements(values[name], moving)
    return found


def _with_elements(
    value: TensorVariable, elements: Mapping[tuple[int, ...], TensorVariable]
) -> TensorVariable:
    """A parameter with some of its elements replaced."""
    if value.type.ndim == 0:
        return elements[()]
    shape = value.type.shape
    parts = [elements.get(i, value[i]) for i in np.ndindex(shape)]
    return pt.stack(parts).reshape(shape)


def starts(drifting: Sequence[DriftingParameter], values: Values) -> TensorVariable:
    """The numbers on the scale at the start."""
    return pt.stack([one.start(values) for one in drifting])


def moved(
    drifting: Sequence[DriftingParameter],
    values: Values,
    numbers: TensorVariable,
    noises: TensorVariable,
    row: MovingRow,
) -> TensorVariable:
    """The numbers on the scale a step later."""
    states = [one.moved(numbers[i], noises[i], row, values) for i, one in enumerate(drifting)]
    return pt.stack(states)


def bordered(matrix: Any, size: int, diagonal: float) -> Any:
    """A covariance (n, n) with this diagonal in ``size`` more rows and columns."""
    n = matrix.type.shape[0]
    border = np.zeros((n + size, n + size))
    border[range(n, n + size), range(n, n + size)] = diagonal
    if isinstance(matrix, Constant):
        border[:n, :n] = matrix.data
        return pt.as_tensor(border)
    return pt.set_subtensor(pt.as_tensor(border)[:n, :n], matrix)
