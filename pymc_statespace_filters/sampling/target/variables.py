"""The variables that a sampler moves, as one vector on the unconstrained space."""

from collections.abc import Mapping, Sequence

import numpy as np
from pymc.model import Model
from pymc.util import get_value_vars_from_user_vars
from pytensor.graph.traversal import ancestors, graph_inputs
from pytensor.tensor.random.type import RandomType
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.pymc_model.inspection import log_density_terms


class HeldVariables:
    """Value variables and where each lies in the vector.

    Parameters
    ----------
    variables : sequence of TensorVariable
        Value variables, in the order of the vector.
    point : mapping of str to ndarray
        Any point of the model; only shapes are read.

    Attributes
    ----------
    variables : tuple of TensorVariable
    dim : int
        Length d of the vector.
    """

    def __init__(self, variables: Sequence[TensorVariable], point: Mapping[str, np.ndarray]):
        self.variables = tuple(variables)
        self._layout, end = [], 0
        for v in variables:
            value = point[v.name]
            begin, end = end, end + value.size
            self._layout.append((v.name, slice(begin, end), value.shape, v.dtype))
        self.dim = end

    def name_at(self, i: int) -> str:
        """Name of the variable that element i of the vector belongs to."""
        return next(name for name, part, _, _ in self._layout if i < part.stop)

    def join(self, point: Mapping[str, np.ndarray]) -> np.ndarray:
        """Join a point's values into the vector, shape (d,)."""
        position = np.empty(self.dim)
        for name, part, _, _ in self._layout:
            position[part] = np.ravel(point[name])
        return position

    def split(self, position: np.ndarray) -> dict[str, np.ndarray]:
        """Split the vector into values by name."""
        return {
            name: position[part].reshape(shape).astype(dtype, copy=False)
            for name, part, shape, dtype in self._layout
        }


def continuous_value_vars(
    vars: Sequence[TensorVariable] | None, model: Model
) -> list[TensorVariable]:
    """Give the value variables of what the user named, all of the model's by default.

    Raises
    ------
    ModelError
        If one of them is discrete.
    """
    if vars is None:
        held = list(model.value_vars)
    else:
        held = get_value_vars_from_user_vars(vars, model)
    discrete = [model.values_to_rvs[v].name for v in held if not v.dtype.startswith("float")]
    if discrete:
        raise ModelError(
            f"vars: DRAM samples continuous variables, these are discrete: {', '.join(discrete)}. "
            "Name the continuous ones, pm.sample(step=[DRAM([...])]), and PyMC finds a step method "
            "for the rest"
        )
    return held


def check_no_generators(model: Model) -> None:
    """Check that the log-density draws no random numbers of its own.

    Raises
    ------
    ModelError
        If a term of it does, as `pymc.Minibatch` and `pymc.Simulator` do.
    """
    for name, term in log_density_terms(model):
        if any(isinstance(v.type, RandomType) for v in graph_inputs([term])):
            raise ModelError(
                f"the log-density of {name!r} draws random numbers of its own, from a "
                "generator that all chains would share: the draws would be no function of "
                "random_seed. pm.sample(step=psf.DRAM()) takes such a model"
            )


def check_noise_is_held(
    model: Model, held: Sequence[TensorVariable], seeds: Mapping[str, TensorVariable]
) -> None:
    """Check that no other step method can move what an estimated likelihood depends on.

    Parameters
    ----------
    model : pymc.Model
    held : sequence of TensorVariable
        Value variables that the sampler moves.
    seeds : mapping of str to shared variable
        The noise seeds, by the name of their StateSpace variable.

    Raises
    ------
    ModelError
        If a term of the log-density with a seed in it depends on a variable that is not held.
    """
    for term in model.logp(sum=False):
        behind = set(ancestors([term]))
        noisy = [name for name, seed in seeds.items() if seed in behind]
        rest = [v for v in model.value_vars if v in behind and v not in held]
        if noisy and rest:
            raise ModelError(
                f"vars: the noisy likelihood of {', '.join(noisy)} also depends on "
                f"{', '.join(model.values_to_rvs[v].name for v in rest)}: DRAM must hold these "
                "too, or their moves would redraw the estimate of a point already accepted"
            )
