"""The variables that a sampler moves, as one vector on the unconstrained space."""

from collections.abc import Mapping, Sequence

import numpy as np
from pymc.blocking import DictToArrayBijection, RaveledVars
from pymc.model import Model
from pymc.util import get_value_vars_from_user_vars
from pytensor.graph.traversal import ancestors, graph_inputs
from pytensor.tensor.random.type import RandomType
from pytensor.tensor.variable import TensorVariable

from ...errors import ModelError
from ...pymc_model.inspection import log_density_terms


class RaveledVariables:
    """Value variables raveled into one vector, by PyMC's `DictToArrayBijection`.

    The variables are in the order of the vector. Of ``point``, any point of the model, only shapes
    and dtypes are read.
    """

    def __init__(self, variables: Sequence[TensorVariable], point: Mapping[str, np.ndarray]):
        self.variables = tuple(variables)
        self._layout = self._map(point).point_map_info
        self.dim: int = sum(size for _, _, size, _ in self._layout)

    def name_at(self, i: int) -> str:
        """Name of the variable that element i of the vector belongs to."""
        ends = np.cumsum([size for _, _, size, _ in self._layout])
        return self._layout[int(np.searchsorted(ends, i, side="right"))][0]

    def rv_at(self, model: Model, i: int) -> TensorVariable:
        """The free variable of a model that element i of the vector belongs to."""
        name = self.name_at(i)
        return next(model.values_to_rvs[v] for v in self.variables if v.name == name)

    def ravel(self, point: Mapping[str, np.ndarray]) -> np.ndarray:
        """Ravel the values of a point into the vector, shape (d,)."""
        return self._map(point).data.astype(np.float64, copy=False)

    def unravel(self, position: np.ndarray) -> dict[str, np.ndarray]:
        """Split the vector into values by name."""
        return DictToArrayBijection.rmap(RaveledVars(position, self._layout))

    def _map(self, point: Mapping[str, np.ndarray]) -> RaveledVars:
        return DictToArrayBijection.map({v.name: np.asarray(point[v.name]) for v in self.variables})


def continuous_value_vars(
    vars: Sequence[TensorVariable] | None, model: Model
) -> list[TensorVariable]:
    """Give the value variables of ``vars``, by default all; a `ModelError` if one is discrete."""
    if vars is None:
        chosen = list(model.value_vars)
    else:
        chosen = get_value_vars_from_user_vars(vars, model)
    discrete = [model.values_to_rvs[v].name for v in chosen if not v.dtype.startswith("float")]
    if discrete:
        raise ModelError(
            f"vars must be continuous for DRAM, these are discrete: {', '.join(discrete)}. "
            "Name the continuous ones, pm.sample(step=[DRAM([...])]), and PyMC finds a step method "
            "for the rest"
        )
    return chosen


def check_no_generators(model: Model) -> None:
    """Raise a `ModelError` if the log-density draws random numbers, as of `pymc.Minibatch`."""
    for name, term in log_density_terms(model):
        if any(isinstance(v.type, RandomType) for v in graph_inputs([term])):
            raise ModelError(
                f"the log-density of {name!r} draws random numbers from a generator that all "
                "chains would use: the draws would not be a function of random_seed. "
                "pm.sample(step=psf.DRAM()) accepts such a model"
            )


def check_noise_dependencies(
    model: Model, sampled: Sequence[TensorVariable], seeds: Mapping[str, TensorVariable]
) -> None:
    """Check that no other step method moves a variable of an estimated likelihood.

    Raises `ModelError` if a term of the log-density that contains a seed depends on a variable not
    sampled.
    """
    for _, term in log_density_terms(model):
        inputs = set(ancestors([term]))
        noisy = [name for name, seed in seeds.items() if seed in inputs]
        rest = [v for v in model.value_vars if v in inputs and v not in sampled]
        if noisy and rest:
            raise ModelError(
                f"vars must include {', '.join(model.values_to_rvs[v].name for v in rest)}: the "
                f"noisy likelihood of {', '.join(noisy)} depends on them, and other step methods "
                "would redraw the estimate at a point already accepted"
            )
