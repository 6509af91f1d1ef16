"""A model's log-density with its gradient, over the vector of all its variables."""

import ctypes
from collections.abc import Callable

import numpy as np
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.model import Model

from ...compiler.native.pytensor_function import NativeFunction
from ...pymc_model.density import compile_raveled
from ...pymc_model.inspection import log_density_graph
from ...pymc_model.written_function import native_function
from ..target.variables import RaveledVariables

Array = NDArray[np.float64]


class DensityGradient:
    """The compiled log-density and gradient of a model without noise, by all its variables."""

    def __init__(self, model: Model, raveled: RaveledVariables) -> None:
        values, density = list(raveled.variables), log_density_graph(model)
        gradient = pt.concatenate([pt.flatten(g) for g in pytensor.grad(density, values)])
        point = model.initial_point(random_seed=0)
        function, start = compile_raveled(point, [density, gradient], values)
        self._function: NativeFunction = native_function(function, [start])

    def for_a_thread(self) -> Callable[[Array], tuple[float, Array]]:
        """A function of a position (d,) for one thread."""
        position = self._function.example[0].copy()
        call, repeat = self._function.bind([position])
        run = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(int(call.table[0]))
        table, out = call.table.ctypes.data, call.out.ctypes.data

        def evaluate(x: Array) -> tuple[float, Array]:
            position[:] = x
            run(table, out)
            if call.out[0]:
                repeat()  # raises what the model raised
            return float(call.out[1]), call.out[2:].copy()

        return evaluate
