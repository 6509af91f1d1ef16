"""A model's log-density at many points, evaluated by machine code in threads.

The log-density is PyTensor's compiled function, called by its address. Each point comes with the
noise seeds of its estimate, so that the values depend neither on the order nor on the number of
threads.
"""

from collections.abc import Sequence

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pytensor.tensor.variable import TensorVariable

from ..compiler.native.rows import Rows
from ..errors import ModelError
from .compilation import compile_raveled
from .graph_rewrites import smooth_filters, with_filter
from .inspection import noise_seeds
from .written_function import native_function

Array = NDArray[np.float64]


def check_free_variables(model: pm.Model) -> None:
    """Raise unless a model has free variables, all of them continuous."""
    if model.discrete_value_vars:
        names = [model.values_to_rvs[value].name for value in model.discrete_value_vars]
        raise ModelError(
            f"model must have continuous free variables only, got discrete {names}: "
            "marginalise them out of the likelihood first"
        )
    if not model.free_RVs:
        raise ModelError("model must have at least one free variable, got none")


class RowFunction:
    """A scalar function of a model's free variables, compiled over their flat vector.

    ``output`` is a scalar graph of the model's value variables; the noise seeds become arguments.
    ``extra`` are graphs that `calls` evaluates, too.

    Attributes
    ----------
    seed_names : tuple of str
        Names of the noisy state-space variables, in the order of the columns of a seed array.
    model_seeds : ndarray of int64
        The model's seeds for them.
    calls : Rows
        From points (m, k) and their m seeds of each variable to the results (m, ...).
    """

    def __init__(
        self, model: pm.Model, output: TensorVariable, extra: Sequence[TensorVariable] = ()
    ) -> None:
        shared = noise_seeds(model)
        self.seed_names = tuple(shared)
        self.model_seeds = np.array([seed.get_value() for seed in shared.values()], dtype=np.int64)
        values = [model.rvs_to_values[rv] for rv in model.free_RVs]
        start = model.initial_point()
        function, point = compile_raveled(start, [output, *extra], values, shared)
        example = [point, *self.model_seeds]
        self.calls = Rows(native_function(function, example), len(example))

    def evaluate(self, x: Array, seeds: NDArray[np.int64] | None = None) -> Array:
        """Evaluate points x (m, k), each with its row of seeds (m, n_seeds); NaN becomes -inf.

        Without `seeds` every point gets the seeds of the model.
        """
        if seeds is None:
            seeds = np.broadcast_to(self.model_seeds, (len(x), self.model_seeds.size))
        values = self.calls(x, *seeds.T)[0]
        return np.where(np.isnan(values), -np.inf, values)


class ModelDensity(RowFunction):
    """The compiled log-density of a model.

    ``moved`` is whether the chain moved its noise (``correlation``), with the smooth versions of
    the filters.
    """

    def __init__(self, model: pm.Model, *, moved: bool = False) -> None:
        check_free_variables(model)
        self.model = model
        self.moved = moved
        log_density = model.logp()
        if moved:
            (log_density,) = with_filter([log_density], model, smooth_filters(model))
        super().__init__(model, log_density)
