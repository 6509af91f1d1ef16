"""Likelihoods and gradients at many points, for a caller in Python that brings all of them at once.

Arguments are those of an operation on a record or a panel, each with leading dimensions that
broadcast against those of the others. Points that share a record are evaluated side by side if the
filter can do that, all others in turn.
"""

from collections.abc import Sequence
from math import prod

import numpy as np

from pymc_statespace_filters.filters.outcomes import NONE
from pymc_statespace_filters.filters.protocol import BatchFilter, PanelFilter
from pymc_statespace_filters.ops.base import FilterOp, evaluator
from pymc_statespace_filters.ops.batch import BatchLogLikelihood
from pymc_statespace_filters.ops.likelihood import LogLikelihood, LogLikelihoodGradient
from pymc_statespace_filters.ops.panel import (
    PanelLogLikelihood,
    PanelTapePullback,
    TapedPanelLogLikelihood,
)
from pymc_statespace_filters.system.panel import N_COLUMNS, RECORD, STEP

type Arrays = Sequence[np.ndarray]


def values(op: LogLikelihood, *arguments: np.ndarray) -> list[np.ndarray]:
    """Terms (.., J) and health (.., 3)."""
    shape = _leading_shape(op, arguments)
    theta, record = arguments[0], _shared(op, arguments[1:], shape)
    if record is not None:
        if type(op) is LogLikelihood and isinstance(op.filter, BatchFilter):
            batch = evaluator(BatchLogLikelihood(op.system, op.filter))
            results = batch(theta.reshape(-1, theta.shape[-1]), *record)
            return [result.reshape(*shape, result.shape[-1]) for result in results]
        if isinstance(op, PanelLogLikelihood) and isinstance(op.filter, PanelFilter):
            terms, health = evaluator(op)(*_one_panel(theta, record))
            # The health of a panel is that of its first failing record.
            if health[1] == NONE:
                return [terms.reshape(*shape, -1), np.broadcast_to(health, (*shape, *health.shape))]
    return _in_turn(op, arguments, shape)


def gradients(op: LogLikelihoodGradient, *arguments: np.ndarray) -> list[np.ndarray]:
    """The cotangent of theta; the last argument is that of the terms (.., J)."""
    shape = _leading_shape(op, arguments)
    theta, terms_bar, record = arguments[0], arguments[-1], _shared(op, arguments[1:-1], shape)
    if record is not None and isinstance(op.filter, PanelFilter):
        thetas = np.broadcast_to(theta, shape + _core(op, theta, 0))
        panel = _one_panel(thetas, record)
        _, health, tape = evaluator(TapedPanelLogLikelihood(op.system, op.filter))(*panel)
        # Where one record of a panel fails there is no tape of the others.
        if health[1] == NONE:
            bars = np.broadcast_to(terms_bar, (*shape, terms_bar.shape[-1])).ravel()
            pullback = evaluator(PanelTapePullback(op.system, op.filter))
            return [pullback(*panel, tape, bars)[0].reshape(thetas.shape)]
    return _in_turn(op, arguments, shape)


def _core(op: FilterOp, value: np.ndarray, i: int) -> tuple[int, ...]:
    """The shape of argument ``i`` without its leading dimensions."""
    return value.shape[value.ndim - op.input_types[i][2] :]


def _leading_shape(op: FilterOp, arguments: Arrays) -> tuple[int, ...]:
    ndims = [ndim for _, _, ndim in op.input_types]
    leading = (a.shape[: a.ndim - n] for a, n in zip(arguments, ndims, strict=True))
    return np.broadcast_shapes(*leading)


def _shared(op: FilterOp, record: Arrays, shape: tuple[int, ...]) -> list[np.ndarray] | None:
    """The record of several points without leading dimensions, if they share one with rows."""
    if prod(shape) < 2:
        return None
    cores = [_core(op, value, i) for i, value in enumerate(record, start=1)]
    if not all(value.size == prod(core) for value, core in zip(record, cores, strict=True)):
        return None
    shared = [value.reshape(core) for value, core in zip(record, cores, strict=True)]
    return shared if len(shared[0]) else None


def _one_panel(theta: np.ndarray, record: Arrays) -> tuple[np.ndarray, ...]:
    """The records of all points below each other, as one panel; theta (.., k) or (.., G, k)."""
    steps, observed, *others = record
    rows = steps
    if steps.ndim == 1:
        rows = np.zeros((len(steps), N_COLUMNS), np.int64)
        rows[:, STEP] = steps
    number = np.cumsum(np.diff(rows[:, RECORD], prepend=rows[0, RECORD]) != 0)
    n_records = number[-1] + 1
    thetas = theta.reshape(-1, theta.shape[-1])
    n_points = len(thetas) // n_records
    table = np.tile(rows, (n_points, 1))
    table[:, RECORD] = np.add.outer(np.arange(n_points) * n_records, number).ravel()
    return thetas, table, np.tile(observed, (n_points, 1)), *others


def _in_turn(op: FilterOp, arguments: Arrays, shape: tuple[int, ...]) -> list[np.ndarray]:
    evaluate = evaluator(op)
    if not shape:
        return list(evaluate(*arguments))
    at_points = [
        np.broadcast_to(value, shape + _core(op, value, i)) for i, value in enumerate(arguments)
    ]
    results = [evaluate(*(value[i] for value in at_points)) for i in np.ndindex(shape)]
    return [np.reshape(one, shape + one[0].shape) for one in zip(*results, strict=True)]
