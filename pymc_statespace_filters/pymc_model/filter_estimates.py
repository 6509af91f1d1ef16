"""The log-likelihood of a StateSpace variable at points of its model, under any filter and seeds.

Parameters and inputs at the points are computed once, and each filter is evaluated by its own
machine code, so that another filter compiles what is new about it alone and not the model again.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from typing import Self

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import ancestors

from ..filters.checks import check_system_and_filter
from ..filters.outcomes import Failure
from ..filters.protocol import Filter
from ..filters.signatures import ONE_RECORD, PANEL
from ..ops.base import evaluator
from ..ops.likelihood import LogLikelihood
from ..parallel.cpu_affinity import available_cores
from ..parallel.shared_rows import evaluated_rows
from .density import check_free_variables, compile_raveled
from .inspection import scored_rows, state_space_nodes

Array = NDArray[np.float64]


class VariableAtPoints:
    """An observed StateSpace variable, or all records of a panel, at points of its model.

    Parameters
    ----------
    model : pymc.Model
        With continuous free variables.
    name : str
        Of the variable.
    x : ndarray, shape (m, k)
        Points of the unconstrained space, in the order of `unconstrained_draws`.
    """

    def __init__(self, model: pm.Model, name: str, x: Array) -> None:
        check_free_variables(model)
        node = state_space_nodes(model)[name]
        self.name, self.system, self.filter = name, node.op.system, node.op.filter
        theta, steps, inputs, t0, _ = node.inputs[-5:]
        given = [steps, model.rvs_to_values[node.outputs[1]], inputs, t0]
        free = [model.rvs_to_values[rv] for rv in model.free_RVs]
        graphs = model.replace_rvs_by_values([theta, *given])
        varying = [i for i, graph in enumerate(graphs) if set(ancestors([graph])) & set(free)]
        self._constant = _at_points(model, graphs)(x[:1])[0]
        self._varying, self._evaluate = varying, _at_points(model, [graphs[i] for i in varying])
        self._arguments = self._arguments_at(x)
        self._form = PANEL if steps.type.ndim == 2 else ONE_RECORD
        self._scored = scored_rows(node)

    def moved_to(self, x: Array) -> Self:
        """The same at other points x (m, k), with what has been compiled."""
        moved = copy(self)
        moved._arguments = self._arguments_at(x)
        return moved

    def _arguments_at(self, x: Array) -> list[list[np.ndarray]]:
        found = []
        for values in self._evaluate(x):
            arguments = list(self._constant)
            for i, value in zip(self._varying, values, strict=True):
                arguments[i] = value
            found.append(arguments)
        return found

    def __len__(self) -> int:
        """The number of points."""
        return len(self._arguments)

    @property
    def leaves_rows_out(self) -> bool:
        """Whether the log-density has no term of some rows."""
        return self._scored is not ...

    @property
    def n_steps(self) -> int:
        """Steps of one evaluation, of all records."""
        op = LogLikelihood(self.system, self.filter, self._form)
        return op.n_steps(self._arguments[0]) if self._arguments else 0

    def failures(self) -> list[Failure]:
        """Why the filter of the variable has no likelihood at each point, or that it has one."""
        evaluate = evaluator(LogLikelihood(self.system, self.filter, self._form))
        return [Failure.of(evaluate(*each, np.asarray(0))[1][1]) for each in self._arguments]

    def log_likelihood(self, filter: Filter, seeds: NDArray[np.int64]) -> Array:
        """The log-likelihood by a filter at every point for every seed, (m, r); -inf if it fails.

        ``seeds`` (m, r) are those of the noise, which a deterministic filter ignores: it needs one.

        Raises
        ------
        ModelError
            If the filter cannot treat the system.
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
        rows = self._scored if scored else ...
        check_system_and_filter(self.system, filter)
        evaluate = evaluator(LogLikelihood(self.system, filter, self._form))

        def total(i: int, seed: np.int64) -> float:
            terms = evaluate(*self._arguments[i], np.asarray(seed))[0]
            found = float(terms[rows].sum())
            return -np.inf if np.isnan(found) else found

        calls = [(i, seed) for i, row in zip(points, seeds, strict=True) for seed in row]
        numbers = np.array(calls, dtype=np.int64).reshape(-1, 2)

        def totals(part: slice) -> list[Array]:
            with ThreadPoolExecutor(min(available_cores(), max(1, len(calls)))) as pool:
                try:
                    return [np.array(list(pool.map(lambda call: total(*call), calls[part])))]
                except BaseException:
                    pool.shutdown(cancel_futures=True)
                    raise

        (found,) = evaluated_rows(totals, [numbers], lambda m: [np.empty(m)])
        return np.reshape(found, seeds.shape)


def failures_at(model: pm.Model, x: Array) -> Counter[Failure]:
    """How many evaluations of all filters of a model fail at points (m, k), for each reason."""
    found = (VariableAtPoints(model, name, x).failures() for name in state_space_nodes(model))
    counted = Counter(failure for of_variable in found for failure in of_variable)
    del counted[Failure.NONE]
    return counted


def _at_points(model: pm.Model, graphs: list[Variable]) -> Callable[[Array], list]:
    """A function of points that gives the values of graphs at each of them.

    Machine code would take longer to compile.
    """
    free = [model.rvs_to_values[rv] for rv in model.free_RVs]
    function, _ = compile_raveled(model.initial_point(), graphs, free, mode="FAST_COMPILE")
    return lambda x: [[np.array(value) for value in function(point)] for point in x]
