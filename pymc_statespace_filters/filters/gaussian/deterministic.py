"""A system without noise whose start is known: the state is a function of the parameters.

It has no covariance, so a Gaussian filter is a run of the equations. No observation moves the state
and each has the density p(d | x), of any kind: the likelihood is exact. The vector ``s`` of the
filter is the state.
"""

import pytensor.tensor as pt
from pytensor.tensor.variable import TensorVariable

from ...compiler.codegen.function_types import Graph
from ...compiler.lowering.gaussian import differentiable_log_density
from ...compiler.lowering.symbols import call, symbols_of
from ...system.model import StateSpaceModel
from .recursion import GaussianFilterFunctions


def filter_functions(system: StateSpaceModel) -> GaussianFilterFunctions:
    """The three functions of a Gaussian filter for a system without any spread."""
    values = symbols_of(system)
    del values["q"]  # zero
    values["s"] = values.pop("x").type("s")
    state = {**values, "x": values["s"]}

    def function(inputs: str, *outputs: TensorVariable) -> Graph:
        return Graph({name: values[name] for name in inputs.split()}, outputs)

    start = call(system.equations.initial_mean, system, values)
    step = call(system.equations.transition, system, state)
    # A copy: the derivative of the term by s would be lost beside s itself as an output.
    seen = [pt.tensor_copy(values["s"]), pt.atleast_1d(differentiable_log_density(system, state))]
    return GaussianFilterFunctions(
        system,
        # Measured for Runge-Kutta steps: explicit rows take 45 % longer than propagation.
        False,
        function("theta", start),
        function("theta u t s", step),
        function("theta u t d s", *seen),
    )
