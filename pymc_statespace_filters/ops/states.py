"""States along a record, and whole runs of a filter: operations without a derivative."""

from typing import ClassVar

import pytensor.tensor as pt
from pytensor.tensor.type import TensorType

from ..compiler.lowering.compiled_system import CompiledSystem
from ..filters.protocol import Compiled, RunFilter, StatesFilter
from ..system.model import StateSpaceModel
from .base import RECORD_INPUTS, FilterOp


class States(FilterOp):
    """Mean, sd and a draw (R, n) of the state at steps ``wanted``, n_effective (R,), health (3,).

    ``moment`` is "predicted" (given the observations at earlier steps than the row's), "filtered"
    (also at the row's) or "smoothed" (all). ``draw_seed`` is the seed of the draw alone.
    """

    __props__ = ("system", "filter", "moment")  # type: ignore[assignment]
    input_types = (*RECORD_INPUTS, ("wanted", "int64", 1), ("draw_seed", "int64", 0))
    output_types = (pt.dmatrix, pt.dmatrix, pt.dmatrix, pt.dvector, pt.dvector)
    result_names = ("mean", "sd", "drawn", "n_effective_wanted", "health")
    filter: StatesFilter

    def __init__(self, system: StateSpaceModel, filter: StatesFilter, moment: str) -> None:
        super().__init__(system, filter)
        self.moment = moment

    def compile(self, system: CompiledSystem) -> Compiled:
        """The filter's states."""
        return self.filter.compile_states(system, self.moment)


class FilterRun(FilterOp):
    """Terms (J,) and health (3,) of the likelihood, and the filtered state at ``wanted`` steps.

    The latter as mean (R, n), covariance (R, n, n), members (R, N, n) and weights (R, N); N is 0
    without members.
    """

    input_types: ClassVar[tuple[tuple[str, str, int], ...]] = (
        *RECORD_INPUTS,
        ("wanted", "int64", 1),
    )
    output_types = (pt.dvector, pt.dvector, pt.dmatrix, pt.dtensor3, pt.dtensor3, pt.dmatrix)
    result_names: ClassVar[tuple[str, ...]] = (
        "terms", "health", "mean", "cov", "members", "weights",
    )  # fmt: skip
    filter: RunFilter

    def compile(self, system: CompiledSystem) -> Compiled:
        """The filter's run."""
        return self.filter.compile_run(system)


class ResumableRun(FilterRun):
    """`FilterRun` from a state of the filter, empty at the start, with the state that it leaves."""

    input_types: ClassVar[tuple[tuple[str, str, int], ...]] = (
        *FilterRun.input_types,
        ("state", "float64", 1),
    )
    output_types: ClassVar[tuple[TensorType, ...]] = (*FilterRun.output_types, pt.dvector)
    result_names: ClassVar[tuple[str, ...]] = (*FilterRun.result_names, "state")
