"""Likelihoods and gradients at many points, for a caller in Python that brings all of them at once.

Arguments are those of an operation on a record or a panel, each with leading dimensions that
broadcast against those of the others. Points that share a record are evaluated side by side if the
filter can do that, all others in turn.
"""

from collections.abc import Sequence
from math import prod

import numpy as np

from ..filters.protocol import DifferentiableFilter
from ..system.panel_records import rows_of_copies
from .base import FilterOp, evaluator
from .likelihood import LogLikelihood, LogLikelihoodGradient, TapedLogLikelihood, TapePullback
from .signatures import ONE_RECORD, PANEL, POINTS

type Arrays = Sequence[np.ndarray]
type Shape = tuple[int, ...]


def values(op: LogLikelihood, *arguments: np.ndarray) -> list[np.ndarray]:
    """Terms (.., J) and health (.., 3)."""
    shape, cores = _shapes(op, arguments)
    is_one_record = prod(shape) > 1 and type(op) is LogLikelihood
    record = _shared(arguments[1:], cores[1:]) if is_one_record else []
    if not (record and isinstance(op.filter, DifferentiableFilter)):
        return _in_turn(op, arguments, shape, cores)
    thetas = arguments[0].reshape(-1, *cores[0])
    if op.form == ONE_RECORD:
        results = evaluator(LogLikelihood(op.system, op.filter, POINTS))(thetas, *record)
    else:
        evaluate = evaluator(op)
        terms, health = evaluate(*_one_panel(thetas, record))
        terms, health = terms.reshape(len(thetas), -1), np.tile(health, (len(thetas), 1))
        if not np.isfinite(terms).all():  # the health is that of the first record that fails
            health[:] = [evaluate(theta, *record)[1] for theta in thetas]
        results = terms, health
    return [result.reshape(shape + result.shape[1:]) for result in results]


def gradients(op: LogLikelihoodGradient, *arguments: np.ndarray) -> list[np.ndarray]:
    """The cotangent of theta (.., k) or (.., G, k); the last argument is that of the terms."""
    shape, cores = _shapes(op, arguments)
    record = _shared(arguments[1:-1], cores[1:-1]) if prod(shape) > 1 else []
    if record:
        thetas, terms_bar = (
            np.broadcast_to(arguments[i], shape + cores[i]).reshape(-1, *cores[i]) for i in (0, -1)
        )
        return [_side_by_side(op, thetas, record, terms_bar).reshape(shape + cores[0])]
    return _in_turn(op, arguments, shape, cores)


def _side_by_side(
    op: LogLikelihoodGradient, thetas: np.ndarray, record: Arrays, terms_bar: np.ndarray
) -> np.ndarray:
    """The gradients at several points; zero where the filter fails, as at a single one."""
    panel = _one_panel(thetas, record)
    terms, _, tape = evaluator(TapedLogLikelihood(op.system, op.filter, PANEL))(*panel)
    succeeds = np.isfinite(terms.reshape(len(thetas), -1)).all(axis=1)
    if succeeds.all():
        pullback = evaluator(TapePullback(op.system, op.filter, PANEL))
        return pullback(*panel, tape, terms_bar.ravel())[0]
    theta_bar = np.zeros(thetas.shape)
    if succeeds.any():  # a panel with a record that fails has no tape
        theta_bar[succeeds] = _side_by_side(
            op, thetas[succeeds], record, terms_bar[succeeds]
        ).reshape(-1, *thetas.shape[1:])
    return theta_bar


def _shapes(op: FilterOp, arguments: Arrays) -> tuple[Shape, list[Shape]]:
    """The leading shape of all arguments together, and the shape of each without it."""
    n_leading = [a.ndim - n for a, (_, n) in zip(arguments, op.arguments, strict=True)]
    cores = [a.shape[n:] for a, n in zip(arguments, n_leading, strict=True)]
    if not any(n_leading):
        return (), cores
    leading = (a.shape[:n] for a, n in zip(arguments, n_leading, strict=True))
    return np.broadcast_shapes(*leading), cores


def _shared(record: Arrays, cores: Sequence[Shape]) -> list[np.ndarray]:
    """A record of these shapes; empty if it differs between points, or has no rows."""
    if any(value.size != prod(core) for value, core in zip(record, cores, strict=True)):
        return []
    shared = [value.reshape(core) for value, core in zip(record, cores, strict=True)]
    return shared if len(shared[0]) else []


def _one_panel(thetas: np.ndarray, record: Arrays) -> tuple[np.ndarray, ...]:
    """The records of all points below each other, as those of one panel."""
    steps, observed, *others = record
    n_points = len(thetas)
    below = thetas.reshape(-1, thetas.shape[-1])
    return below, rows_of_copies(steps, n_points), np.tile(observed, (n_points, 1)), *others


def _in_turn(op: FilterOp, arguments: Arrays, shape: Shape, cores: list[Shape]) -> list[np.ndarray]:
    evaluate = evaluator(op)
    if prod(shape) == 1:
        results = evaluate(*(a.reshape(core) for a, core in zip(arguments, cores, strict=True)))
        return [result.reshape(shape + result.shape) for result in results]
    each = [np.broadcast_to(a, shape + core) for a, core in zip(arguments, cores, strict=True)]
    points = [evaluate(*(value[i] for value in each)) for i in np.ndindex(shape)]
    return [np.reshape(of_all, shape + of_all[0].shape) for of_all in zip(*points, strict=True)]
