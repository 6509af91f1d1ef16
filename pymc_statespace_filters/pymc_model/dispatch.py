"""Registers how `StateSpaceRV` is drawn, in Python and in numba, and its log-density."""

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pymc.logprob.abstract import _logprob
from pytensor.graph.basic import Variable
from pytensor.link.numba.dispatch.basic import numba_njit
from pytensor.link.numba.dispatch.random import numba_core_rv_funcify
from pytensor.raise_op import CheckAndRaise
from pytensor.tensor.variable import TensorVariable

from ..compiler.codegen.function_types import jit
from ..compiler.native.cache_key import key_of
from ..compiler.native.plan import Refusal
from ..errors import ModelError
from ..evaluation.simulate import simulator
from ..filters.calls import status_of_rows
from ..ops.likelihood import LogLikelihood, vectorized
from ..ops.signatures import ONE_RECORD, PANEL
from ..system.panel_records import FIRST_INPUT, RECORD, STEP
from .held_seed import warn_of_held_seed
from .inspection import state_space_nodes
from .random_variable import PanelRV, StateSpaceRV, draw_in_python, inputs_as_seen
from .sequential_terms import warn_of_stored_terms
from .stepped import warn_of_steps
from .unused_priors import warn_of_unused_priors

_TOO_SHORT = "score_from must be less than the number of observations, of which there are too few"


def _refusal() -> Any:
    """A compiled function that raises what a status says."""
    lines = [f"if status == {int(r)}: raise ModelError({r.message!r})" for r in Refusal]
    scope = {"ModelError": ModelError}
    exec("def refuse(status):\n" + "".join(f"    {line}\n" for line in lines), scope)
    return jit(scope["refuse"])


_refuse = _refusal()


# Made once for all systems of one shape: a fresh one would be compiled by the next call.
@cache
def _check_of_rows(n_inputs: int, last_row: int, of_panel: bool) -> Any:
    """A compiled check of theta, the steps or the rows of a panel, and inputs."""

    @jit
    def check(theta, rows, inputs):
        n_records, width = 1, 1
        if of_panel:
            n_records, width = theta.shape[0], rows.shape[rows.ndim - 1]
        n_rows, n_columns = inputs.shape
        table = rows.copy().reshape(rows.size)
        _refuse(status_of_rows(table, width, n_records, n_rows, n_columns, n_inputs, last_row))

    return check


def _shape_of_rows(op: StateSpaceRV) -> tuple[int, int, bool]:
    """What `_check_of_rows` has to know of a system, and whether it is a panel."""
    system = op.system
    return system.n_input_columns, int(system.observation_uses_inputs), isinstance(op, PanelRV)


@draw_in_python.register
def _draw_in_python(op: StateSpaceRV, rng: np.random.Generator, *arguments: Any) -> np.ndarray:
    *params, size = arguments
    theta, steps, inputs, t0, _ = params
    core_ndims = op.ndims_params
    batch = np.broadcast_shapes(
        *(np.shape(p)[: np.ndim(p) - n] for p, n in zip(params, core_ndims, strict=True))
    )
    batch = batch if size is None else tuple(size)
    theta, steps, inputs, t0 = (
        np.broadcast_to(p, batch + np.shape(p)[np.ndim(p) - n :])
        for p, n in zip((theta, steps, inputs, t0), core_ndims, strict=False)
    )
    is_panel = isinstance(op, PanelRV)
    simulate = simulator(op.system, True).function
    check = _check_of_rows(*_shape_of_rows(op))
    draws = np.empty((*batch, steps.shape[len(batch)], op.system.p))
    for i in np.ndindex(batch):
        parts = [np.require(a[i], requirements=("C", "W")) for a in (theta, steps, inputs)]
        check(*parts)
        records = _single_records(*parts) if is_panel else iter([(slice(None), *parts)])
        for rows, *record in records:
            _, draws[(*i, rows)] = simulate(rng, *record, float(t0[i]))
    return draws


def _single_records(
    theta: np.ndarray, rows: np.ndarray, inputs: np.ndarray
) -> Iterator[tuple[slice, np.ndarray, np.ndarray, np.ndarray]]:
    """The rows of every record of a panel, its parameters, steps and inputs."""
    ends = np.flatnonzero(np.diff(rows[:, RECORD], append=rows[-1, RECORD] + 1)) + 1
    for own, first, last in zip(theta, [0, *ends[:-1]], ends, strict=True):
        steps, begin = rows[first:last, STEP].copy(), rows[first, FIRST_INPUT]
        yield slice(first, last), own, steps, inputs[begin:]


@numba_core_rv_funcify.register(StateSpaceRV)
def _draw_in_numba(op: StateSpaceRV, node: Any) -> tuple:
    compiled, shape, p = simulator(op.system, True).jitted, _shape_of_rows(op), op.system.p
    simulate, check = compiled.function, _check_of_rows(*shape)

    @numba_njit
    def draw_record(rng, theta, steps, inputs, t0, seed):
        check(theta, steps, inputs)
        _, observations = simulate(rng, theta.copy(), steps.copy(), inputs.copy(), t0)
        return observations

    @numba_njit
    def draw_panel(rng, theta, rows, inputs, t0, seed):
        check(theta, rows, inputs)
        observations, forces = np.empty((rows.shape[0], p)), inputs.copy()
        first = 0
        for record in range(theta.shape[0]):
            last = first + 1
            while last < rows.shape[0] and rows[last, RECORD] == rows[first, RECORD]:
                last += 1
            steps, pushes = rows[first:last, STEP].copy(), forces[rows[first, FIRST_INPUT] :]
            _, drawn = simulate(rng, theta[record].copy(), steps, pushes, t0)
            for i in range(last - first):  # assigning them as a slice takes a second to compile
                for a in range(p):
                    observations[first + i, a] = drawn[i, a]
            first = last
        return observations

    draw = draw_panel if isinstance(op, PanelRV) else draw_record
    key = key_of(__name__, repr((shape, p)), compiled.key)
    # PyTensor requires an integer as the cache key of a random variable.
    return draw, None if key is None else int(key[:15], 16)


def _warn_about_model(op: StateSpaceRV) -> None:
    """Warn of what may be wrong, where the log-density of the model in context is asked for."""
    warn_of_held_seed(op.filter)
    warn_of_stored_terms(is_panel=isinstance(op, PanelRV))
    model = pm.Model.get_context(error_if_none=False)
    if model is not None and op in [node.op for node in state_space_nodes(model).values()]:
        warn_of_unused_priors(model)


@_logprob.register(StateSpaceRV)
def _log_density(
    op: StateSpaceRV, values: Sequence, rng: Variable, size: Variable, *params: Any, **kwargs: Any
) -> TensorVariable:
    """log p(d_j | d_1 .. d_{j-1}), one term per observation, 0 for those that are not scored."""
    (value,) = values
    theta, steps, inputs, t0, seed = params
    _warn_about_model(op)
    warn_of_steps(op.system, theta)
    inputs = inputs_as_seen(op, inputs, steps, value)
    form = PANEL if isinstance(op, PanelRV) else ONE_RECORD
    likelihood = LogLikelihood(op.system, op.filter, form)
    terms = vectorized(likelihood, theta, steps, value, inputs, t0, seed)[0]
    return terms if op.score_from == 0 else pt.switch(_is_scored(op, steps), terms, 0.0)


def _is_scored(op: StateSpaceRV, steps: TensorVariable) -> TensorVariable:
    """Whether each row counts: the first ones of every record do not."""
    if isinstance(op, PanelRV):
        codes = steps[..., RECORD]
        # A row counts if the row so many rows before it belongs to the same record.
        counts = pt.eq(codes[..., op.score_from :], codes[..., : -op.score_from])
        before = pt.zeros((*codes.shape[:-1], op.score_from), dtype="bool")
        return pt.concatenate([before, counts], axis=-1)
    # The length comes from the steps, which do not depend on the parameters as the terms do.
    n_rows = steps.shape[-1]
    rows = CheckAndRaise(ModelError, _TOO_SHORT)(pt.arange(n_rows), pt.gt(n_rows, op.score_from))
    return pt.ge(rows, op.score_from)
