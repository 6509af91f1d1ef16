"""The terms of a variable and their scores, for many data sets at once, each at its own point.

A score is the derivative of a term log p(d_j | d_1 .. d_{j-1}) by a parameter.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import ancestors

from ..compiler.lowering.compiled_system import compile_system
from ..compiler.lowering.structure import parameters_after_start
from ..errors import ModelError
from ..facts import in_words
from ..filters.protocol import Filter
from ..filters.written import short_form
from ..ops.base import evaluator
from ..ops.likelihood import LogLikelihood, NoGradient
from ..ops.signatures import PANEL
from ..system.model import StateSpaceModel
from ..system.panel_records import FIRST_INPUT, RECORD, STEP, records_of, rows_of_copies
from ..system.parameters import element_names
from .at_points import GraphsAtPoints
from .density import RowFunction, check_free_variables
from .inspection import log_density_graph, scored_rows, state_space_nodes
from .random_variable import draw_in_python

STEP_OF_X = 1e-5  # of the unconstrained parameters, whose unit is about one
STEP_OF_THETA = 1e-3  # in standard deviations of the posterior

Array = NDArray[np.float64]


class Scores(NamedTuple):
    """Terms and scores of m data sets of J rows.

    ``terms`` (m, J); ``by_theta`` (m, J, k), by the parameters of the row's record, and
    ``curvature`` (m, J, k), minus the second derivatives; ``by_x`` (m, J, k_x), by the
    unconstrained free variables.
    """

    terms: Array
    by_theta: Array
    curvature: Array
    by_x: Array


class ScoredVariable:
    """An observed StateSpace variable, or a panel, with data sets in place of its own.

    Its filter is smooth and without noise. Of the J rows of its data ``observed`` (J, p), there are
    the numbers ``of_rows`` (J,) of their records and the model ``times`` (J,); ``t0`` is that of
    step 0.
    """

    def __init__(self, model: pm.Model, name: str) -> None:
        check_free_variables(model)
        node = state_space_nodes(model)[name]
        self.name, self.system, self.filter = name, node.op.system, node.op.filter
        _check_filter(name, self.system, self.filter)
        self.clock, self._op, self._scored = node.op.clock, node.op, scored_rows(node)
        record = model.replace_rvs_by_values(list(node.inputs[-4:-1]))
        _check_record(name, record, model.value_vars)
        table, self._inputs, self.t0 = (graph.eval(mode="FAST_COMPILE") for graph in record)
        self.is_panel = table.ndim == 2
        self._arguments = table
        self._rows = table if self.is_panel else rows_of_copies(table, 1)
        self.records = records_of(self._rows[:, RECORD])
        self.of_rows = self.records.of_rows()
        observed = model.rvs_to_values[node.outputs[1]]
        self.observed = np.asarray(observed.eval(mode="FAST_COMPILE"), dtype=np.float64)
        self._evaluate = evaluator(LogLikelihood(self.system, self.filter, PANEL))
        self._theta = GraphsAtPoints(model, [node.inputs[-5]])
        self._model = model

    @cached_property
    def _others(self) -> RowFunction:
        model = self._model
        others = [v for v in [*model.basic_RVs, *model.potentials] if v.name != self.name]
        return RowFunction(model, log_density_graph(model, others))

    @property
    def n_records(self) -> int:
        """Number of records of a panel, or one."""
        return len(self.records.labels)

    @property
    def times(self) -> Array:
        """The model time of each row (J,)."""
        system, steps = self.system, self._rows[:, STEP]
        if not system.is_at_any_times:
            return np.asarray(self.t0 + steps * system.dt, dtype=np.float64)
        starts = self._inputs[:, system.n_inputs + 1]
        return np.asarray(starts[self._rows[:, FIRST_INPUT] + steps])

    @property
    def labels(self) -> list[str]:
        """The names of the elements of theta (k,)."""
        return element_names(self.system)

    @property
    def act_after_start(self) -> NDArray[np.bool_]:
        """Which elements of theta (k,) the equations of a step or an observation use."""
        return np.array(parameters_after_start(self.system))

    def theta(self, x: Array) -> Array:
        """The parameters (m, G, k) of every record at points x (m, k_x)."""
        (found,) = self._theta(x)
        return found if self.is_panel else found[:, None]

    def other_density(self, x: Array) -> Array:
        """The log-density (m,) of everything in the model but this variable, at x (m, k_x)."""
        return self._others.evaluate(x)

    def simulate(self, x: Array, count: int, rng: np.random.Generator) -> Array:
        """Data sets (count, J, p) at a point x (k_x,), missing where the data are."""
        theta = self.theta(x[None])[0]
        record = self._arguments, self._inputs, self.t0, 0, None
        own = theta if self.is_panel else theta[0]
        found = np.stack([draw_in_python(self._op, rng, own, *record) for _ in range(count)])
        return np.where(np.isnan(self.observed), np.nan, found)

    def terms(self, theta: Array, observed: Array) -> Array:
        """Terms (m, J) of data sets (m, J, p) at parameters (m, G, k); 0 of rows not scored."""
        m, n_rows = observed.shape[:2]
        table = rows_of_copies(self._rows, m)
        below = theta.reshape(-1, theta.shape[-1]), table, observed.reshape(m * n_rows, -1)
        found = self._evaluate(*below, self._inputs, self.t0, np.asarray(0))[0]
        kept = np.zeros(n_rows)
        kept[self._scored] = 1.0
        return np.asarray(found.reshape(m, n_rows) * kept)

    def scores(self, x: Array, observed: Array, scale: Array) -> Scores:
        """Scores of data sets (m, J, p) at points (m, k_x); ``scale`` (k,) is that of theta."""
        theta, h = self.theta(x), STEP_OF_THETA * scale
        moves = np.concatenate([np.zeros((1, len(h))), np.diag(h), -np.diag(h)])
        points = (theta + moves[:, None, None]).reshape(-1, *theta.shape[1:])
        copies = np.tile(observed, (len(moves), 1, 1))
        terms = self.terms(points, copies).reshape(len(moves), *observed.shape[:2])
        here, up, down = terms[0], *(np.moveaxis(part, 0, -1) for part in np.split(terms[1:], 2))
        by_theta, curvature = (up - down) / (2 * h), (2 * here[..., None] - up - down) / h**2
        jacobian = self.jacobian(x)[:, self.of_rows]
        by_x = np.einsum("mji,mjix->mjx", by_theta, jacobian)
        return Scores(here, by_theta, curvature, by_x)

    def jacobian(self, x: Array) -> Array:
        """The derivatives (m, G, k, k_x) of theta by x."""
        moves = STEP_OF_X * np.eye(x.shape[1])
        up, down = (self.theta((x[:, None] + t * moves).reshape(-1, x.shape[1])) for t in (1, -1))
        difference = (up - down).reshape(len(x), x.shape[1], *up.shape[1:])
        return np.moveaxis(difference, 1, -1) / (2 * STEP_OF_X)


def _check_filter(name: str, system: StateSpaceModel, filter: Filter) -> None:
    if not filter.has_gradient:
        remedy = in_words(NoGradient(compile_system(system)))
        raise ModelError(
            f"the filter of {name!r} must have a gradient, as its terms must be smooth in the "
            f"parameters, got {short_form(filter)}: "
            f"{remedy or 'no filter of the package has one for this system'}"
        )


def _check_record(name: str, record: list[Variable], values: list[Variable]) -> None:
    if set(ancestors(record)) & set(values):
        raise ModelError(
            f"the steps, inputs and t0 of {name!r} must not depend on free variables: give them as "
            "numbers, and what is estimated as parameters of the system"
        )
