"""Draws of a model's free variables, many in one call where their distributions allow it."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.distributions.continuous import InterpolatedRV
from pymc.pytensorf import collect_default_updates, reseed_rngs
from pymc.pytensorf import compile as compile_pymc
from pytensor.compile.builders import OpFromGraph
from pytensor.graph.basic import Apply, Variable
from pytensor.graph.replace import vectorize_graph
from pytensor.graph.traversal import ancestors, applys_between
from pytensor.scan.op import Scan
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError

_AT_ONCE = 100  # draws, whose covariances, for one, are all in memory
_N_TRIED = 1000  # draws of a variable, of which one may fail
# Where the distributions are defined that draw arrays of any size, from arrays of parameters: all
# but `Interpolated`.
_KNOWN = "pytensor.tensor.random.basic", "pymc.distributions.continuous"

Array = NDArray[np.float64]


class PriorDraws:
    """A function that draws variables of a model, on the unconstrained space.

    Distributions of NumPy draw many points in one call. Others, as those of a user's function, are
    called for each point.
    """

    def __init__(self, model: pm.Model, variables: Sequence[TensorVariable]) -> None:
        mapped = []
        for rv in variables:
            transform = model.rvs_to_transforms[rv]
            mapped.append(rv if transform is None else transform.forward(rv, *rv.owner.inputs))
        self._generators = list(collect_default_updates(inputs=[], outputs=mapped))
        first = _first_parameters(mapped)
        self._is_joint = bool(first)
        zeros = pt.vector("zeros")  # one for each draw
        # Of the type of each, which may be that of an index.
        joint = {x: x + zeros.reshape((-1, *[1] * x.type.ndim)).astype(x.type.dtype) for x in first}
        outputs = vectorize_graph(mapped, joint) if joint else [x[None] for x in mapped]
        # Machine code would take seconds to compile, and save little.
        self._function = compile_pymc(
            [zeros], outputs, mode="FAST_COMPILE", on_unused_input="ignore"
        )

    def __call__(self, count: int, rng: np.random.Generator) -> Array:
        """So many independent draws (count, k)."""
        reseed_rngs(self._generators, int(rng.integers(2**31)))
        size = _AT_ONCE if self._is_joint else 1
        return np.concatenate(
            [self._drawn(np.zeros(min(size, count - i))) for i in range(0, count, size)]
        )

    def _drawn(self, zeros: Array) -> Array:
        columns = [np.reshape(values, (len(zeros), -1)) for values in self._function(zeros)]
        return np.concatenate(columns, axis=1, dtype=np.float64)


@contextmanager
def naming_what_fails(model: pm.Model) -> Iterator[None]:
    """Name the variable whose prior, at values of the others, has a negative scale or such."""
    try:
        yield
    except ValueError as error:
        free = set(model.free_RVs)
        for rv in model.free_RVs:
            made_of = [v.name for v in ancestors([rv], blockers=free - {rv}) if v in free - {rv}]
            if made_of and not _can_be_drawn(rv):
                raise ModelError(
                    f"the prior of {rv.name} cannot be drawn at some values of "
                    f"{', '.join(made_of)} ({str(error).splitlines()[0]}): give these a prior on "
                    "the values that it allows, as pm.HalfNormal for a standard deviation"
                ) from None
        raise


def _can_be_drawn(rv: TensorVariable) -> bool:
    try:
        pm.draw(rv, _N_TRIED, random_seed=0, mode="FAST_COMPILE")
    except ValueError:
        return False
    return True


def _first_parameters(outputs: Sequence[Variable]) -> list[Variable]:
    """The first parameter of every random variable, where it does not depend on another one.

    If these have a value for each draw, so has every first parameter, which PyTensor's
    vectorisation goes by, and all that is drawn. None if a distribution is not known.
    """
    nodes = list(applys_between([], outputs))
    if not all(_is_known(node) for node in nodes):
        return []
    random = [node for node in nodes if isinstance(node.op, RandomVariable)]
    drawn = {output for node in random for output in node.outputs}
    if drawn & set(ancestors([node.op.size_param(node) for node in random])):
        return []  # a vectorised shape has a value for each draw
    first = [node.op.dist_params(node)[0] for node in random]
    return [x for x in first if not drawn & set(ancestors([x]))]


def _is_known(node: Apply) -> bool:
    if isinstance(node.op, RandomVariable):
        is_known = type(node.op).__module__ in _KNOWN and not isinstance(node.op, InterpolatedRV)
        return is_known and bool(node.op.dist_params(node))
    return not isinstance(node.op, OpFromGraph | Scan)
