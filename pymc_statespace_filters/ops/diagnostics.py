"""What diagnostics ask of a likelihood: operations without a derivative."""

import pytensor.tensor as pt

from ..compiler.lowering.compiled_system import CompiledSystem
from ..filters.protocol import Compiled, HealthFilter, PredictionFilter
from .base import FilterOp


class TermHealth(FilterOp):
    """Terms (J,) of the likelihood, the effective number (J,) behind each, and health (3,)."""

    output_types = (pt.dvector, pt.dvector, pt.dvector)
    result_names = ("terms", "n_effective", "health")
    filter: HealthFilter

    def compile(self, system: CompiledSystem) -> Compiled:
        """The filter's health."""
        return self.filter.compile_health(system)


class Predictions(FilterOp):
    """The law of every observation before it is seen: see `protocol.PredictionsFunction`."""

    output_types = (pt.dmatrix, pt.dtensor3, pt.dmatrix, pt.dmatrix)
    result_names = ("predicted", "predicted_cov", "log_below", "log_above")
    filter: PredictionFilter

    def compile(self, system: CompiledSystem) -> Compiled:
        """The filter's predictions."""
        return self.filter.compile_predictions(system)
