"""The log-likelihood of a StateSpace variable at points of its model, under any filter and seeds.

Parameters and inputs at the points are computed once, and each filter is evaluated by its own
machine code, so that another filter compiles what is new about it alone and not the model again.
"""

from collections import Counter
from collections.abc import Iterable
from copy import copy
from typing import Self

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pytensor.graph.traversal import ancestors

from ..filters.checks import check_system_and_filter
from ..filters.outcomes import Failure
from ..filters.protocol import Filter
from ..ops.at_points import FilterAtPoints
from ..ops.base import kernel
from ..ops.likelihood import LogLikelihood
from ..ops.signatures import ONE_RECORD, PANEL
from .at_points import GraphsAtPoints
from .density import check_free_variables
from .inspection import scored_rows, state_space_nodes

Array = NDArray[np.float64]


class VariableAtPoints:
    """An observed StateSpace variable, or all records of a panel, at points of its model.

    The model has continuous free variables; points x (m, k) are of the unconstrained space, in the
    order of `unconstrained_draws`.
    """

    def __init__(self, model: pm.Model, name: str, x: Array) -> None:
        check_free_variables(model)
        node = state_space_nodes(model)[name]
        self.name, self.system, self.filter = name, node.op.system, node.op.filter
        theta, steps, inputs, t0, _ = node.inputs[-5:]
        data = model.rvs_to_values[node.outputs[1]]
        graphs = {"theta": theta, "steps": steps, "observed": data, "inputs": inputs, "t0": t0}
        free = set(model.free_RVs)
        self._varying = [n for n, graph in graphs.items() if free & set(ancestors([graph]))]
        self._evaluate = GraphsAtPoints(model, [graphs[n] for n in self._varying])
        others = [n for n in graphs if n not in self._varying]
        found = GraphsAtPoints(model, [graphs[n] for n in others])(x[:1])
        found += self._evaluate(x[:1])
        self._constant = {n: v[0] for n, v in zip([*others, *self._varying], found, strict=True)}
        self._form = PANEL if steps.type.ndim == 2 else ONE_RECORD
        self._scored = scored_rows(node)
        self._move(x)

    def _move(self, x: Array) -> None:
        self._arguments = dict(zip(self._varying, self._evaluate(x), strict=True))
        self._n_points = len(x)

    def moved_to(self, x: Array) -> Self:
        """The same at other points x (m, k), with what has been compiled."""
        moved = copy(self)
        moved._move(x)
        return moved

    def __len__(self) -> int:
        """The number of points."""
        return self._n_points

    @property
    def leaves_rows_out(self) -> bool:
        """Whether the log-density has no term of some rows."""
        return self._scored is not ...

    @property
    def n_steps(self) -> int:
        """Steps of one evaluation, of all records."""
        op = LogLikelihood(self.system, self.filter, self._form)
        return op.n_steps([self._constant["theta"], self._constant["steps"]])

    def is_compiled(self, filter: Filter) -> bool:
        """Whether the loops of a filter need no compilation."""
        return kernel(LogLikelihood(self.system, filter, self._form)).plan.is_compiled

    def failures(self) -> list[Failure]:
        """Why the filter of the variable has no likelihood at each point, or that it has one."""
        seeds = np.zeros((len(self), 1), np.int64)
        health = self._results("health", range(len(self)), self.filter, seeds)
        return [Failure.of(code) for code in health[:, 1]]

    def log_likelihood(self, filter: Filter, seeds: NDArray[np.int64]) -> Array:
        """The log-likelihood by a filter at every point for every seed, (m, r); -inf if it fails.

        ``seeds`` (m, r) are those of the noise, which a deterministic filter ignores: it needs one.
        Raises `ModelError` if the filter cannot treat the system.
        """
        return self.at(range(len(self)), filter, seeds)

    def at(
        self,
        points: Iterable[int],
        filter: Filter,
        seeds: NDArray[np.int64],
        *,
        scored: bool = True,
    ) -> Array:
        """The same at the points with these numbers, one for each row of ``seeds``.

        Without ``scored`` the sum has the terms of all rows, those before ``score_from`` too, of
        which the exponential of an unbiased estimate is right in the mean.
        """
        check_system_and_filter(self.system, filter)
        terms = self._results("terms", points, filter, seeds)
        counted = np.ascontiguousarray(terms[:, self._scored if scored else ...])
        total = counted.reshape(len(terms), -1).sum(axis=1)
        return np.where(np.isnan(total), -np.inf, total).reshape(seeds.shape)

    def _results(
        self, name: str, points: Iterable[int], filter: Filter, seeds: NDArray[np.int64]
    ) -> Array:
        """A result of the likelihood at points, (m r, ...), for each of their seeds (m, r)."""
        chosen = np.repeat(np.array(points, np.int64), seeds.shape[1])
        varying = {n: value[chosen] for n, value in self._arguments.items()}
        constant = {n: value for n, value in self._constant.items() if n not in varying}
        operation = LogLikelihood(self.system, filter, self._form)
        evaluate = FilterAtPoints(operation, [name])
        (found,) = evaluate(varying | {"seed": seeds.ravel()}, constant)
        return found


def failures_at(model: pm.Model, x: Array) -> Counter[Failure]:
    """How many evaluations of all filters of a model fail at points (m, k), for each reason."""
    found = (VariableAtPoints(model, name, x).failures() for name in state_space_nodes(model))
    counted = Counter(failure for of_variable in found for failure in of_variable)
    del counted[Failure.NONE]
    return counted
