"""Values of scalar expressions at many points of which only some inputs are known."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytensor.scalar as ps

from ..codegen.expressions import Expression, Opaque, Value, in_order


class Known(NamedTuple):
    """Values at all points, and where they are known; elsewhere they mean nothing."""

    value: np.ndarray
    is_known: np.ndarray

    @property
    def everywhere(self) -> bool:
        """Whether it is known at all points."""
        return bool(self.is_known.all())


def known_values(
    values: Sequence[Value], given: Mapping[str, np.ndarray], size: int
) -> list[Known]:
    """What is known of expressions where some inputs are ``given``, at ``size`` points.

    A product with zero is known, and so is a choice between equal values.
    """
    found: dict[Expression, Known] = {}

    def look_up(value: Value) -> Known:
        if isinstance(value, Expression):
            return found[value]
        return Known(np.full(size, value), np.ones(size, bool))

    with np.errstate(all="ignore"):
        for e in in_order(values, {}):
            if e.op is None:
                name = str(e.args[0])
                column = given.get(name, np.zeros(size))
                found[e] = Known(column, np.full(size, name in given))
            else:
                found[e] = _applied(e.op, [look_up(a) for a in e.args], size)
    return [look_up(value) for value in values]


def _applied(op: ps.ScalarOp | Opaque, arguments: list[Known], size: int) -> Known:
    if isinstance(op, Opaque):
        return Known(np.zeros(size), np.zeros(size, bool))
    if isinstance(op, ps.Switch):
        return _chosen(*arguments)
    all_known = np.logical_and.reduce([a.is_known for a in arguments])
    value = np.asarray(_function_of(op)(*(a.value for a in arguments)))
    if isinstance(op, ps.Mul | ps.AND):
        vanishes = np.logical_or.reduce([a.is_known & (a.value == 0) for a in arguments])
        return Known(np.where(vanishes, 0, value), all_known | vanishes)
    if isinstance(op, ps.OR):
        holds = np.logical_or.reduce([a.is_known & (a.value != 0) for a in arguments])
        return Known(np.where(holds, True, value), all_known | holds)
    return Known(np.broadcast_to(value, (size,)), all_known)


def _chosen(condition: Known, yes: Known, no: Known) -> Known:
    holds = condition.value.astype(bool)
    either = yes.is_known & no.is_known & (yes.value == no.value)
    chosen = np.where(holds, yes.is_known, no.is_known)
    return Known(
        np.where(holds | ~condition.is_known, yes.value, no.value),
        np.where(condition.is_known, chosen, either),
    )


def _function_of(op: ps.ScalarOp) -> Any:
    """The operation on arrays."""
    if isinstance(op, ps.Cast):
        return lambda a: a.astype(op.o_type.dtype)
    name = op.nfunc_spec[0] if getattr(op, "nfunc_spec", None) else ""
    return getattr(np, name, None) or np.vectorize(op.impl, otypes=[float])
