"""A filter at many points: machine code in threads, without a graph."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ..compiler.native.compilation import COMPILATION
from ..compiler.native.planned_rows import PlannedRow
from ..compiler.native.rows import Rows
from ..parallel.shared_rows import evaluated_rows
from ..parallel.threads import Pieces
from .base import FilterOp, evaluator, kernel
from .signatures import POINTS

_PIECE_SECONDS = 0.02  # of one call for many points, for whose end an interrupt waits
_AT_ONCE = 8  # points, at least, of one such call

type Arrays = Mapping[str, np.ndarray]


class FilterAtPoints:
    """Some results of an operation, by their names, at many points.

    Each point has a call of machine code; where the operation takes many points, a call has some of
    them. Threads share the calls, and so do ranks, see `parallel.shared_rows`.
    """

    def __init__(self, operation: FilterOp, results: Sequence[str]) -> None:
        self._operation, self._results = operation, results
        names = [name for name, _ in operation.results]
        self._kept = [names.index(name) for name in results]
        self._pieces = Pieces(_PIECE_SECONDS, _AT_ONCE)

    def __call__(
        self,
        varying: Arrays,
        constant: Arrays,
        on_progress: Callable[[int], None] = lambda count: None,
    ) -> list[np.ndarray]:
        """The results, each (m, ...), given arguments by their names.

        The ``varying`` ones have a first dimension of length m, the ``constant`` ones are the same
        for all points. A tape has the length of one that is complete; what follows a failure in it
        has no meaning. ``on_progress`` is as in `Rows`.
        """
        if self._operation.form == POINTS:
            return self._some_at_once(varying, constant)
        names = [*varying, *constant]
        example = [
            *(self._operation.array(name, values[0]) for name, values in varying.items()),
            *(self._operation.array(name, values) for name, values in constant.items()),
        ]
        function = _row_function(self._operation, names, self._kept, example)
        rows = Rows(function, len(varying))
        rows.on_progress = on_progress
        return rows(*varying.values())

    def _some_at_once(self, varying: Arrays, constant: Arrays) -> list[np.ndarray]:
        evaluate = evaluator(self._operation)

        def given(points: slice) -> list[np.ndarray]:
            values = {**constant, **{name: value[points] for name, value in varying.items()}}
            return [values[name] for name, _ in self._operation.arguments]

        def at(points: slice) -> list[np.ndarray]:
            found = evaluate(*given(points))
            return [found[i] for i in self._kept]

        def in_pieces(points: slice) -> list[np.ndarray]:
            return self._pieces(at, points, self._operation.n_steps(given(points)))

        def empty(m: int) -> list[np.ndarray]:
            return [np.empty((m, *part.shape[1:])) for part in at(slice(0, 0))]

        return evaluated_rows(in_pieces, list(varying.values()), empty)


def _row_function(
    operation: FilterOp, names: Sequence[str], kept: list[int], example: list[np.ndarray]
) -> PlannedRow:
    """The function of arguments in this order."""
    with COMPILATION:
        function = kernel(operation).loaded()
    arguments = [name for name, _ in operation.arguments]
    return PlannedRow(function, [arguments.index(name) for name in names], example, kept)
