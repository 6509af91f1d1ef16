"""One run of a filter with all that it knew: an operation without a derivative."""

import pytensor.tensor as pt
from pytensor.graph.basic import Variable

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.ops.base import RECORD_INPUTS, FilterOp


class FilterRun(FilterOp):
    """Terms (J,) and health (3,) of the likelihood, and the filtered state at ``rows``.

    The latter as mean (R, n), covariance (R, n, n), members (R, N, n) and weights (R, N); N is 0
    without members.
    """

    input_types = (*RECORD_INPUTS, ("rows", "int64", 1))

    def compile(self) -> CompiledFunction:
        """The filter's machine code."""
        return self.filter.compile_run(self.system)

    def results(self) -> list[Variable]:
        """Two vectors, and an array for each property of the state."""
        return [
            pt.dvector(),
            pt.dvector(),
            pt.dmatrix(),
            pt.dtensor3(),
            pt.dtensor3(),
            pt.dmatrix(),
        ]
