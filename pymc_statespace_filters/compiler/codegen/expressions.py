"""Scalar expressions, interned and simplified as they are built.

An expression is a PyTensor scalar operation applied to expressions and Python constants. Equal
expressions are one object, constants are folded, and products with zero vanish. This removes most
of the cost of Jacobians and identity matrices, which are mostly zeros and ones.
"""

import operator
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import pytensor.scalar as ps

type Value = "Expression | float | int | bool"

FLOAT, INTEGER, BOOLEAN = "f", "i", "b"


@dataclass(frozen=True, eq=False, slots=True)
class Expression:
    """One scalar: an input (``op`` is None, ``args`` its name) or an operation on other scalars."""

    op: Any
    args: tuple
    kind: str
    number: int


class Opaque:
    """An operation on arrays: an element of its result is not written out, but what it depends on.

    Expressions of it are for questions; no code is made of them.
    """

    def __init__(self, op: object) -> None:
        self.op = op


_COMPARISONS = (ps.LT, ps.GT, ps.LE, ps.GE, ps.EQ, ps.NEQ, ps.IsNan, ps.IsInf)
_LOGICAL = (ps.AND, ps.OR, ps.XOR, ps.Invert)
_CLOSED_ON_INTEGERS = (ps.Add, ps.Sub, ps.Mul, ps.Neg, ps.Abs, ps.IntDiv, ps.Mod, ps.Sqr,
                       ps.ScalarMaximum, ps.ScalarMinimum, ps.Sign, *_LOGICAL)  # fmt: skip


_CASTS = {FLOAT: ps.Cast(ps.float64), INTEGER: ps.Cast(ps.int64), BOOLEAN: ps.Cast(ps.bool)}


def is_constant(value: Value) -> bool:
    """Whether a value is a Python number."""
    return not isinstance(value, Expression)


def kind_of(value: Value) -> str:
    """Float, integer or boolean."""
    if isinstance(value, Expression):
        return value.kind
    if isinstance(value, bool):
        return BOOLEAN
    return INTEGER if isinstance(value, int) else FLOAT


_PLAIN = {ps.Add: operator.add, ps.Sub: operator.sub, ps.Mul: operator.mul}


def _is(value: Value, number: float) -> bool:
    return is_constant(value) and value == number


class Arena:
    """Builds and interns the expressions of one lowered function."""

    def __init__(self) -> None:
        self._interned: dict[tuple, Expression] = {}
        self._rules: dict[type, Callable[..., Value | None]] = {
            ps.Add: self._add, ps.Mul: self._mul, ps.Sub: self._sub, ps.TrueDiv: self._true_div,
            ps.Neg: self._neg, ps.Pow: self._pow, ps.Switch: self._switch, ps.Cast: self._cast,
            ps.Sqr: lambda op, a: self.apply(ps.mul, a, a),
            ps.Reciprocal: lambda op, a: self.apply(ps.true_div, 1.0, a),
            ps.Identity: lambda op, a: a,
            ps.Second: lambda op, a, b: b,
        }  # fmt: skip

    def __len__(self) -> int:
        return len(self._interned)

    def input(self, name: str) -> Expression:
        """The scalar that stands for a named input."""
        return self._intern(None, (name,), FLOAT)

    def apply(self, op: ps.ScalarOp, *args: Value) -> Value:
        """The simplest expression equal to ``op`` applied to ``args``."""
        if all(map(is_constant, args)):
            return _fold(op, args)
        rule = self._rules.get(type(op))
        simplified, kind = rule(op, *args) if rule else None, _result_kind(op, args)
        if simplified is None:
            return self._intern(op, args, kind)
        # Dropping a neutral element may leave a boolean where a number is expected.
        same = kind_of(simplified) == kind
        return simplified if same else self.apply(_CASTS[kind], simplified)

    def opaque(self, op: Opaque, args: tuple, element: int) -> Expression:
        """An element of the result of an operation that is not written out."""
        return self._intern(op, (*args, element), FLOAT)

    def _intern(self, op: ps.ScalarOp | Opaque | None, args: tuple, kind: str) -> Expression:
        key = (op, kind, *((a.number if isinstance(a, Expression) else (type(a), repr(a)))
                           for a in args))  # fmt: skip
        if key not in self._interned:
            self._interned[key] = Expression(op, args, kind, len(self._interned))
        return self._interned[key]

    def _reduced(self, op: ps.ScalarOp, args: tuple) -> Value:
        return reduce(lambda a, b: self.apply(op, a, b), args)

    # Rules return None to keep the operation as it is.

    def _add(self, op: ps.ScalarOp, *args: Value) -> Value | None:
        if _all_boolean(args):
            return self._reduced(ps.or_, args)
        kept = [a for a in args if not _is(a, 0)]
        if not kept:
            return 0.0
        total = kept[0]
        for term in kept[1:]:
            if is_constant(total) and is_constant(term):
                total = _fold(ps.add, (total, term))
            else:
                total = self._intern(ps.add, (total, term), _result_kind(ps.add, (total, term)))
        return total

    def _mul(self, op: ps.ScalarOp, *args: Value) -> Value | None:
        if _all_boolean(args):
            return self._reduced(ps.and_, args)
        if any(_is(a, 0) for a in args):
            return 0.0
        kept = [a for a in args if not _is(a, 1)]
        if not kept:
            return 1.0
        product = kept[0]
        for factor in kept[1:]:
            if is_constant(product) and is_constant(factor):
                product = _fold(ps.mul, (product, factor))
            elif _is(factor, -1) or _is(product, -1):
                product = self.apply(ps.neg, product if _is(factor, -1) else factor)
            else:
                pair = (product, factor)
                product = self._intern(ps.mul, pair, _result_kind(ps.mul, pair))
        return product

    def _sub(self, op: ps.ScalarOp, a: Value, b: Value) -> Value | None:
        if _is(b, 0):
            return a
        if a is b:
            return 0.0
        return self.apply(ps.neg, b) if _is(a, 0) else None

    def _true_div(self, op: ps.ScalarOp, a: Value, b: Value) -> Value | None:
        return a if _is(b, 1) else 0.0 if _is(a, 0) else None

    def _neg(self, op: ps.ScalarOp, a: Value) -> Value | None:
        return a.args[0] if isinstance(a, Expression) and isinstance(a.op, ps.Neg) else None

    def _pow(self, op: ps.ScalarOp, base: Value, exponent: Value) -> Value | None:
        """Small integer powers become products, which vectorise; libm's ``pow`` does not."""
        if isinstance(exponent, Expression):
            return None
        if exponent == 0:
            return 1.0
        if exponent == 0.5:
            return self.apply(ps.sqrt, base)
        if exponent != int(exponent) or abs(exponent) > 16:
            return None
        if exponent < 0:
            return self.apply(ps.true_div, 1.0, self._integer_power(base, -int(exponent)))
        return self._integer_power(base, int(exponent))

    def _integer_power(self, base: Value, exponent: int) -> Value:
        if exponent == 1:
            return base
        half = self._integer_power(base, exponent // 2)
        square = self.apply(ps.mul, half, half)
        return self.apply(ps.mul, square, base) if exponent % 2 else square

    def _switch(self, op: ps.ScalarOp, condition: Value, yes: Value, no: Value) -> Value | None:
        if is_constant(condition):
            return yes if condition else no
        return yes if yes is no or (is_constant(yes) and is_constant(no) and yes == no) else None

    def _cast(self, op: ps.Cast, a: Value) -> Value | None:
        return a if kind_of(a) == _kind_of_dtype(op.o_type.dtype) else None


def _all_boolean(args: tuple) -> bool:
    """Whether all are boolean: their sums and products are then boolean too, as in NumPy."""
    return all(kind_of(a) == BOOLEAN for a in args)


def _kind_of_dtype(dtype: str) -> str:
    return BOOLEAN if dtype == "bool" else INTEGER if "int" in dtype else FLOAT


def _result_kind(op: ps.ScalarOp, args: tuple) -> str:
    if isinstance(op, _COMPARISONS):
        return BOOLEAN
    if isinstance(op, ps.Cast):
        return _kind_of_dtype(op.o_type.dtype)
    if isinstance(op, ps.Identity | ps.Second):
        return kind_of(args[-1])
    kinds = {kind_of(a) for a in (args[1:] if isinstance(op, ps.Switch) else args)}
    if kinds == {BOOLEAN} and isinstance(op, (*_LOGICAL, ps.Switch, ps.Add, ps.Mul)):
        return BOOLEAN
    whole = FLOAT not in kinds and isinstance(op, (*_CLOSED_ON_INTEGERS, ps.Switch))
    return INTEGER if whole else FLOAT


def plain(value) -> Value:
    """A numpy scalar as the Python scalar of the same kind."""
    kind = value.dtype.kind if hasattr(value, "dtype") else None
    if kind == "b":
        return bool(value)
    if kind in ("i", "u"):
        return int(value)
    return float(value) if kind == "f" else value


def _fold(op: ps.ScalarOp, args: tuple) -> Value:
    """Evaluate an operation on constants in double precision."""
    plain_op = _PLAIN.get(type(op))
    if plain_op is not None and all(type(a) is float for a in args):  # forty times as fast
        return reduce(plain_op, args)
    python_type = {FLOAT: float, INTEGER: int, BOOLEAN: bool}[_result_kind(op, args)]
    if isinstance(op, ps.Cast):
        return python_type(args[0])
    with np.errstate(all="ignore"):
        # PyTensor's implementations follow the dtypes of their arguments.
        return python_type(op.impl(*(np.float64(a) if kind_of(a) == FLOAT else a for a in args)))


def in_order(values: Iterable[Value], written: Collection[Value]) -> list[Expression]:
    """Expressions that ``values`` depend on, arguments first; not recursive, for deep graphs."""
    order: list[Expression] = []
    seen = set(written)
    for root in values:
        stack = [(root, False)]
        while stack:
            value, arguments_done = stack.pop()
            if not isinstance(value, Expression) or value in seen:
                continue
            if arguments_done or value.op is None:
                seen.add(value)
                order.append(value)
            else:
                stack.append((value, True))
                stack.extend((a, False) for a in reversed(value.args))
    return order
