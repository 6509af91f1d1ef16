"""The derivative of a log-likelihood as a PyTensor operation."""

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.ops.base import RECORD_INPUTS, ThetaDerivative


class LogLikelihoodGradient(ThetaDerivative):
    """Vector-Jacobian product of `LogLikelihood`: inputs and terms_bar (J,) -> theta_bar (k,).

    It runs the filter forwards and then backwards. A graph that holds the likelihood as well needs
    the first only once: see `tape`.
    """

    input_types = (*RECORD_INPUTS, ("terms_bar", "float64", 1))
    gufunc_signature = "(k),(j),(j,p),(s,u),(),(),(j)->(k)"

    def compile(self) -> CompiledFunction:
        """Both passes of the filter."""
        return self.filter.compile_gradient(self.system)  # type: ignore[union-attr]
