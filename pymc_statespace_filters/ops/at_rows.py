"""An operation at many rows of its arguments: machine code in threads, without a graph."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np
import pytensor

from ..compiler.native.compilation import COMPILATION, undamaged_files
from ..compiler.native.planned_function import PlannedFunction
from ..compiler.native.planned_rows import PlannedRow
from ..compiler.native.pytensor_function import NativeFunction
from ..compiler.native.rows import RowFunction, Rows
from .base import FilterOp, kernel


def at_rows(
    operation: FilterOp,
    results: Sequence[str],
    varying: Mapping[str, np.ndarray],
    constant: Mapping[str, np.ndarray],
    on_progress: Callable[[int], None] = lambda count: None,
) -> list[np.ndarray]:
    """Some results of an operation, by their names, each (m, ...).

    The ``varying`` arguments have a first dimension of length m, the ``constant`` ones are the same
    for all rows. A tape has the length of one that is complete; what follows a failure in it has no
    meaning. ``on_progress`` is as in `Rows`.
    """
    names = [*varying, *constant]
    example = [
        *(operation.array(name, values[0]) for name, values in varying.items()),
        *(operation.array(name, values) for name, values in constant.items()),
    ]
    rows = Rows(_row_function(operation, names, results, example), len(varying))
    rows.on_progress = on_progress
    return rows(*varying.values())


def _row_function(
    operation: FilterOp, names: Sequence[str], results: Sequence[str], example: list[np.ndarray]
) -> RowFunction:
    """The function of arguments in this order."""
    kept = [[name for name, _ in operation.results].index(name) for name in results]
    with COMPILATION:
        function = kernel(operation)
        if isinstance(function, PlannedFunction):
            arguments = [name for name, _ in operation.arguments]
            order = [arguments.index(name) for name in names]
            return PlannedRow(function.loaded(), order, example, kept)
        compiled, lock = _without_plan(operation, tuple(names), tuple(kept))
    return NativeFunction(compiled, example, one_at_a_time=lock)


# Made once for all records and calls: one takes seconds to compile.
@lru_cache(maxsize=64)
def _without_plan(
    operation: FilterOp, names: tuple[str, ...], kept: tuple[int, ...]
) -> tuple[Any, Lock]:
    """The PyTensor function of a filter without a plan, such as a user's; a lock for its calls."""
    symbols = {name: operation.symbol(name) for name, _ in operation.arguments}
    outputs = operation(*symbols.values(), return_list=True)
    with undamaged_files():
        compiled = pytensor.function(
            [symbols[name] for name in names], [outputs[i] for i in kept], trust_input=True
        )
    return compiled, Lock()
