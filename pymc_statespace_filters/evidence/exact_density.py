"""A model's log-density with an unbiased filter in place of its own."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
from numpy.typing import NDArray

from ..errors import ModelError
from ..filters.checks import check_unbiased
from ..filters.protocol import Filter
from ..filters.written import short_form
from ..pymc_model.density import RowFunction, check_free_variables
from ..pymc_model.filter_estimates import VariableAtPoints
from ..pymc_model.inspection import log_density_graph, state_space_nodes

BLOCK = 64  # points between two reports of progress

Array = NDArray[np.float64]
Seeds = NDArray[np.int64]


class ExactDensity:
    """Unbiased estimates of a model's density: its StateSpace variables get another filter.

    ``is_exact`` tells whether the filter is exact in the mean for all of them, which are ``names``,
    and ``n_noisy`` how many seeds an estimate has: one for each variable, or none without noise.
    ``on_progress`` is called with the number of estimates since its last call. Raises `ModelError`
    if there is no such variable, the filter cannot treat its system or is biased, or it is that of
    the model already.
    """

    def __init__(self, model: pm.Model, filter: Filter) -> None:
        check_free_variables(model)
        nodes = _observed_nodes(model)
        self.is_exact = all([_check(name, node.op, filter) for name, node in nodes.items()])
        if all(node.op.filter == filter for node in nodes.values()):
            raise ModelError(
                f"filter must be another one than that of the model, got {short_form(filter)}: the "
                "draws are those of its posterior already"
            )
        self.model, self.filter, self.names = model, filter, tuple(nodes)
        self.n_noisy = len(nodes) if filter.noisy else 0
        self.on_progress: Callable[[int], None] = lambda count: None
        variables = [*model.basic_RVs, *model.potentials]
        others = [variable for variable in variables if variable.name not in nodes]
        self._others = RowFunction(model, log_density_graph(model, others))
        self._variables: list[VariableAtPoints] = []

    def evaluate(self, x: Array, seeds: Seeds) -> Array:
        """Estimates (m, r) of the log-density at points x (m, k), of seeds (m, r, n_noisy)."""
        if not self._variables:
            self._variables = [VariableAtPoints(self.model, name, x[:1]) for name in self.names]
        columns = (
            np.moveaxis(seeds, -1, 0) if self.n_noisy else [seeds.sum(axis=-1)] * len(self.names)
        )
        total = np.repeat(self._others.evaluate(x)[:, None], seeds.shape[1], axis=1)
        possible = np.flatnonzero(np.isfinite(total[:, 0]))
        variables = [variable.moved_to(x[possible]) for variable in self._variables]
        for begin in range(0, len(possible), BLOCK):
            rows = range(begin, min(begin + BLOCK, len(possible)))
            at = possible[rows.start : rows.stop]
            for variable, column in zip(variables, columns, strict=True):
                total[at] += variable.at(rows, self.filter, column[at])
            self.on_progress(len(at) * seeds.shape[1])
        return total

    def evaluate_afresh(self, x: Array, rng: np.random.Generator) -> Array:
        """One estimate (m,) at each of the points, with fresh noise."""
        return self.evaluate(x, fresh_seeds((len(x), 1, self.n_noisy), rng))[:, 0]


def fresh_seeds(shape: tuple[int, ...], rng: np.random.Generator) -> Seeds:
    """Seeds of independent noise."""
    return rng.integers(np.iinfo(np.int64).max, size=shape)


def _observed_nodes(model: pm.Model) -> dict[str, Any]:
    observed = {rv.name for rv in model.observed_RVs}
    nodes = {name: one for name, one in state_space_nodes(model).items() if name in observed}
    if not nodes:
        raise ModelError(
            "model must have an observed StateSpace variable, whose filter is replaced, got "
            f"{sorted(observed)}"
        )
    return nodes


def _check(name: str, op: Any, filter: Filter) -> bool:
    """Raise unless a filter has no bias for a variable, and say whether it is exact."""
    is_exact = check_unbiased(op.system, filter)
    if filter.noisy and op.score_from:
        raise ModelError(
            f"filter must be without noise for {name!r}, whose first {op.score_from} rows are not "
            f"scored, got {short_form(filter)}: its estimate of a part of the record is not "
            "unbiased"
        )
    return is_exact
