"""States along a record, by a filter: an operation without a derivative."""

import pytensor.tensor as pt
from pytensor.graph.basic import Variable

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.filters import Filter
from pymc_statespace_filters.ops.base import RECORD_INPUTS, FilterOp
from pymc_statespace_filters.system.model import StateSpaceModel


class States(FilterOp):
    """Mean, sd and a draw (R, n) of the state at ``rows``, n_effective (R,), and health (3,).

    ``moment`` is "predicted" (observations at earlier steps than the row's are known), "filtered"
    (those up to its own) or "smoothed" (all). ``draw_seed`` is the noise of the draw alone.
    """

    __props__ = ("system", "filter", "moment")  # type: ignore[assignment]
    input_types = (*RECORD_INPUTS, ("rows", "int64", 1), ("draw_seed", "int64", 0))

    def __init__(self, system: StateSpaceModel, filter: Filter, moment: str) -> None:
        super().__init__(system, filter)
        self.moment = moment

    def compile(self) -> CompiledFunction:
        """The filter's machine code."""
        return self.filter.compile_states(self.system, self.moment)

    def results(self) -> list[Variable]:
        """Three matrices and two vectors."""
        return [pt.dmatrix(), pt.dmatrix(), pt.dmatrix(), pt.dvector(), pt.dvector()]
