"""The log-likelihood of a record as a PyTensor operation."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import pytensor.tensor as pt
from pytensor.gradient import DisconnectedType
from pytensor.graph.basic import Apply, Variable

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.errors import GradientUnavailableError
from pymc_statespace_filters.ops.base import HEALTH_SIZE, FilterOp, theta_cotangent_only
from pymc_statespace_filters.ops.gradient import LogLikelihoodGradient


class LogLikelihood(FilterOp):
    """log p(d_j | d_1 .. d_{j-1}) of every observation, and a record of the filter's health.

    Inputs: ``theta`` (k,), ``steps`` (J,), ``observed`` (J, p), ``inputs`` (steps, n_inputs),
    ``t0``, ``seed``. Outputs: terms (J,), and health (3,): smallest effective number of
    particles, code of the failure, index of the failing observation.
    """

    gufunc_signature = "(k),(j),(j,p),(s,u),(),()->(j),(h)"
    argument_code: ClassVar[Mapping[str, str]] = {"seed": "(seed.item(), no_normals.copy())"}

    def compile(self) -> CompiledFunction:
        """The filter's machine code."""
        return self.filter.compile(self.system)

    def results(self) -> list[Variable]:
        """Terms and health."""
        return [pt.dvector(), pt.dvector()]

    def infer_shape(self, node: Apply, input_shapes: Sequence) -> list[tuple]:
        """As many terms as steps."""
        return [(input_shapes[1][0],), (HEALTH_SIZE,)]

    def pullback(
        self,
        inputs: Sequence[Variable],
        outputs: Sequence[Variable],
        cotangents: Sequence[Variable],
    ) -> list[Variable]:
        """Reverse-mode derivative by theta; raises for a filter whose likelihood has none."""
        if not self.filter.has_gradient:
            what = "is a random estimate without a" if self.filter.noisy else "does not come with a"
            raise GradientUnavailableError(
                f"The likelihood by {self.filter} {what} gradient, so "
                f"NUTS, HMC, nutpie and find_MAP cannot use it. Sample with "
                f"psf.sample_dram() or pm.sample(step=psf.DRAM()), or take psf.EKF() for a "
                f"likelihood with a gradient."
            )
        terms_bar = cotangents[0]
        if isinstance(terms_bar.type, DisconnectedType):
            theta_bar = pt.zeros_like(inputs[0])
        else:
            theta_bar = LogLikelihoodGradient(self.system, self.filter)(*inputs, terms_bar)
        return theta_cotangent_only(self, inputs, theta_bar)
