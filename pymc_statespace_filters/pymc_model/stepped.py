"""Free variables of which the likelihood of a model is a staircase, as the time of a switch.

Such a variable is compared with times or data: in the equations of a StateSpace variable, or on the
way from the free variables to an observed one. Between two steps the likelihood does not change, so
that its gradient says nothing of the variable.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.scalar as ps
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.traversal import ancestors
from pytensor.tensor.basic import Join
from pytensor.tensor.elemwise import Elemwise
from pytensor.tensor.shape import SpecifyShape

from ..compiler.lowering.compiled_system import compile_system
from ..errors import FilterWarning, warn
from ..system.model import StateSpaceModel
from .held_seed import BETWEEN, WITH_GRADIENT, asks_from
from .inspection import state_space_nodes

_COMPARED = (
    ps.LT, ps.GT, ps.LE, ps.GE, ps.Floor, ps.Ceil, ps.Trunc, ps.RoundHalfToEven,
    ps.RoundHalfAwayFromZero, ps.Sign,
)  # fmt: skip
_N_LINES, _N_HALVINGS = 10, 60  # between draws of the prior
_ROUNDING = 1e-6  # of a gap beside 1 and the value itself; rounding leaves far less

Array = NDArray[np.float64]
Evaluate = Callable[[Sequence[Any]], Array]


def stepped_variables(model: pm.Model) -> tuple[str, ...]:
    """The names of the free variables of which the likelihood is known to be a staircase.

    A gradient is no guide to them, neither for NUTS nor for a maximum.

    Examples
    --------
    >>> import pymc as pm
    >>> from pymc_statespace_filters.pymc_model.stepped import stepped_variables
    >>> with pm.Model() as model:
    ...     year = pm.Uniform("year", 0, 10)
    ...     before, after = pm.Normal("before"), pm.Normal("after")
    ...     mean = pm.math.switch(year > range(10), before, after)
    ...     d = pm.Normal("d", mean, 1.0, observed=range(10))
    >>> stepped_variables(model)
    ('year',)
    """
    compared = list(_comparisons(model))
    stepped = list(_stepped_parameters(model))
    if not (compared or stepped) or not model.free_RVs:
        return ()
    try:
        starts = pm.draw(list(model.free_RVs), draws=2 * _N_LINES, random_seed=0)
    except NotImplementedError:  # of a flat prior
        return ()
    points = list(zip(*starts, strict=True))
    parts = [stepped, [v for v, _ in compared], [v for _, outputs in compared for v in outputs]]
    evaluate = [_function(model, graphs) for graphs in parts]
    return tuple(
        rv.name
        for i, rv in enumerate(model.free_RVs)
        if any(
            _differ(evaluate[0], point, moved) or _steps(evaluate[1], evaluate[2], point, moved)
            for point, moved in _lines(points, i)
        )
    )


def warn_of_steps(system: StateSpaceModel, theta: Variable) -> None:
    """Warn if a sampler with gradients asks for a log-density that is a staircase."""
    if not asks_from().startswith((*WITH_GRADIENT, "nutpie.")):
        return
    if names := [n for n in compile_system(system).stepped_parameters if _varies(n, system, theta)]:
        warn(
            f"the likelihood is a staircase of {', '.join(names)}, which a condition of the "
            "equations compares with times or inputs: its gradient says nothing of the steps, and "
            "NUTS does not find its way. Use psf.sample_dram(), or a smooth transition such as "
            "pt.sigmoid((t - tau) / width)",
            FilterWarning,
            *BETWEEN,
        )


def _varies(name: str, system: StateSpaceModel, theta: Variable) -> bool:
    """Whether a parameter may vary; false if it is known to be a number."""
    node = theta.owner
    while node is not None and isinstance(node.op, SpecifyShape):
        node = node.inputs[0].owner
    if node is None or not isinstance(node.op, Join):
        return True
    part = node.inputs[-len(system.parameters) :][system.parameters.index(name)]
    return not all(isinstance(v, Constant) for v in ancestors([part]) if v.owner is None)


def _stepped_parameters(model: pm.Model) -> Iterator[Variable]:
    """The parameters of observed StateSpace variables that their equations compare with times."""
    for node in state_space_nodes(model).values():
        system = node.op.system
        sizes = [int(np.prod(shape)) for shape in system.parameter_shapes]
        ends = np.cumsum(sizes)
        for name in compile_system(system).stepped_parameters:
            i = system.parameters.index(name)
            yield node.inputs[-5][..., ends[i] - sizes[i] : ends[i]]


def _comparisons(model: pm.Model) -> Iterator[tuple[Variable, list[Variable]]]:
    """Comparisons of free variables on the way to observed ones, with the latter's arguments."""
    free = list(model.free_RVs)
    for rv in model.observed_RVs:
        arguments = [v for v in rv.owner.inputs if getattr(v.type, "dtype", "") == "float64"]
        for variable in ancestors(arguments, blockers=free):
            node = variable.owner
            if node is None or variable in free or not isinstance(node.op, Elemwise):
                continue
            if isinstance(node.op.scalar_op, _COMPARED):
                if not set(free).isdisjoint(ancestors(node.inputs, blockers=free)):
                    yield variable, arguments


def _function(model: pm.Model, graphs: Sequence[Variable]) -> Evaluate:
    """The elements of graphs, flat, as a function of the values of the free variables."""
    if not graphs:
        return lambda point: np.empty(0)
    joined = pt.concatenate([pt.cast(graph, "float64").ravel() for graph in graphs])
    function = pytensor.function(
        list(model.free_RVs), joined, mode="FAST_COMPILE", on_unused_input="ignore"
    )
    return lambda point: np.asarray(function(*point))


def _lines(points: Sequence[Sequence[Any]], i: int) -> Iterator[tuple[list[Any], list[Any]]]:
    """Pairs of points that differ in the i-th free variable alone."""
    for one, other in zip(points[::2], points[1::2], strict=True):
        yield list(one), [*one[:i], other[i], *one[i + 1 :]]


def _differ(evaluate: Evaluate, point: list[Any], moved: list[Any]) -> bool:
    return not np.array_equal(evaluate(point), evaluate(moved))


def _steps(steps: Evaluate, values: Evaluate, point: list[Any], moved: list[Any]) -> bool:
    """Whether the values have a gap where the steps change first between two points."""
    first = steps(point)
    if np.array_equal(first, steps(moved)):
        return False

    def between(share: float) -> list[Any]:
        return [a + share * (b - a) for a, b in zip(point, moved, strict=True)]

    low, high = 0.0, 1.0
    for _ in range(_N_HALVINGS):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        low, high = (
            (middle, high) if np.array_equal(steps(between(middle)), first) else (low, middle)
        )
    below, above = values(between(low)), values(between(high))
    return bool((np.abs(above - below) > _ROUNDING * (1.0 + np.abs(below))).any())
