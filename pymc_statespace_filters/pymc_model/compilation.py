"""Compilation of a model's log-density, and of its variables from the unconstrained vector."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pymc.pytensorf import compile as compile_pymc
from pymc.pytensorf import join_nonshared_inputs
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from ..compiler.native.compilation import COMPILATION, undamaged_files, warning_filter


def compile_density(inputs: Sequence[Variable], outputs: Sequence[Variable], **options: Any) -> Any:
    """Compile a graph of many scalars by PyMC's compiler, under the lock of compilation.

    Where there is no C++ compiler, PyTensor fuses at most 32 operands, which is a limit of NumPy's
    functions and not of numba's, and warns of a larger set: a model of nine parameters has one.
    """
    with COMPILATION, undamaged_files(), warning_filter("ignore", "Loop fusion failed"):
        return compile_pymc(inputs, outputs, **options)


def compile_raveled(
    point: Mapping[str, np.ndarray],
    outputs: Sequence[Variable],
    variables: Sequence[TensorVariable],
    seeds: Mapping[str, TensorVariable] | None = None,
    further: Sequence[Variable] = (),
    **options: Any,
) -> tuple[Any, NDArray[np.float64]]:
    """Compile graphs over the vector of all variables: the function, and the vector at a point.

    The other arguments of the function are a seed for each shared one, which ``seeds`` has by the
    name of its StateSpace variable, and ``further``.
    """
    inputs = {seed: seed.type(f"{name}_seed_input") for name, seed in (seeds or {}).items()}
    graphs, joined = join_nonshared_inputs(point, outputs, variables, inputs)
    arguments = [joined, *inputs.values(), *further]
    function = compile_density(arguments, graphs, **({"on_unused_input": "ignore"} | options))
    function.trust_input = True
    start = np.concatenate([np.ravel(point[v.name]) for v in variables], dtype=np.float64)
    return function, start


Array = NDArray[np.float64]


class ConstrainedValues:
    """Variables of a model as a function of its unconstrained vector.

    ``variables`` are by default the free ones, in the order of the vector; ``names`` are theirs.
    """

    def __init__(self, model: pm.Model, variables: Sequence[TensorVariable] | None = None) -> None:
        values = [model.rvs_to_values[rv] for rv in model.free_RVs]
        chosen = model.free_RVs if variables is None else variables
        outputs = model.replace_rvs_by_values(chosen)
        # Machine code would take seconds to compile.
        mode = "FAST_COMPILE"
        self._function, _ = compile_raveled(model.initial_point(), outputs, values, mode=mode)
        self.names = [variable.name for variable in chosen]

    def __call__(self, x: Array) -> dict[str, np.ndarray]:
        """Values by name at the unconstrained point x (k,)."""
        return dict(zip(self.names, map(np.asarray, self._function(x)), strict=True))
