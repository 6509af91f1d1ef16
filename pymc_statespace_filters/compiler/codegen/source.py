"""Scalar expressions as Python source that numba compiles, and the functions that it may call.

The source text is canonical: equal expressions give equal text, in every process. The text
therefore identifies a lowered function, and is part of the key under which its machine code is
cached.
"""

import operator
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pytensor.scalar as ps
from pytensor.scalar.math import Log1mexp, Sigmoid, Softplus

from pymc_statespace_filters.compiler.codegen.expressions import (
    BOOLEAN,
    FLOAT,
    INTEGER,
    Expression,
    Value,
    is_constant,
    kind_of,
)
from pymc_statespace_filters.compiler.numerics import (
    exponential,
    hyperbolic,
    intrinsics,
    trigonometric,
)
from pymc_statespace_filters.compiler.numerics.quantiles.binomial import (
    bernoulli_quantile,
    binomial_block,
    binomial_quantile,
)
from pymc_statespace_filters.compiler.numerics.quantiles.gamma import gamma_block, gamma_quantile
from pymc_statespace_filters.compiler.numerics.quantiles.normal import normal_probability
from pymc_statespace_filters.compiler.numerics.quantiles.poisson import (
    poisson_block,
    poisson_quantile,
)

_NUMPY = (
    "exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "sqrt", "sin", "cos", "tan", "arcsin",
    "arccos", "arctan", "arctan2", "sinh", "cosh", "tanh", "floor", "ceil", "trunc", "rint",
)  # fmt: skip

QUANTILES = {
    function.py_func.__name__: function
    for function in (
        poisson_quantile, binomial_quantile, bernoulli_quantile, gamma_quantile, normal_probability,
    )
}  # fmt: skip
"""By the names that operations have as ``machine_code``."""

# The same for a block of members, as vector code: functions of rows of a buffer.
BLOCKS = {
    "poisson_quantile": poisson_block,
    "binomial_quantile": binomial_block,
    "gamma_quantile": gamma_block,
}

# For single numbers, where the tables of the system's library are faster.
SCALAR_NAMESPACE = {
    "np": np, "inf": np.inf, "nan": np.nan, "power": operator.pow,
    "floor_divide": operator.floordiv, "modulo": operator.mod,
    **{name: getattr(np, name) for name in _NUMPY}, **QUANTILES,
}  # fmt: skip

_VECTORIZABLE = (
    exponential.exp, exponential.exp2, exponential.expm1, exponential.log, exponential.log2,
    exponential.log10, exponential.log1p, exponential.power, hyperbolic.sinh,
    hyperbolic.cosh, hyperbolic.tanh, trigonometric.sin, trigonometric.cos, trigonometric.tan,
    trigonometric.arctan, trigonometric.arctan2, trigonometric.floor_divide, trigonometric.modulo,
)  # fmt: skip

# For loops over members, which LLVM vectorises only if they call no function of the library.
VECTOR_NAMESPACE = (
    SCALAR_NAMESPACE
    | {"sqrt": intrinsics.sqrt}
    | {function.py_func.__name__: function for function in (*_VECTORIZABLE, *BLOCKS.values())}
)
_INFIX: dict[type, str] = {
    ps.Add: "+", ps.Sub: "-", ps.Mul: "*", ps.TrueDiv: "/", ps.LT: "<", ps.GT: ">", ps.LE: "<=",
    ps.GE: ">=", ps.EQ: "==", ps.NEQ: "!=", ps.IntDiv: "//", ps.Mod: "%",
}  # fmt: skip

_CALLS: dict[type, str] = {
    ps.Exp: "exp", ps.Log: "log", ps.Log1p: "log1p", ps.Expm1: "expm1", ps.Sqrt: "sqrt",
    ps.Sin: "sin", ps.Cos: "cos", ps.Tan: "tan", ps.ArcTan: "arctan", ps.Tanh: "tanh",
    ps.Sinh: "sinh", ps.Cosh: "cosh", ps.Abs: "abs", ps.Floor: "floor", ps.Ceil: "ceil",
    ps.Exp2: "exp2", ps.Log2: "log2", ps.Log10: "log10", ps.ArcSin: "arcsin", ps.ArcCos: "arccos",
    ps.Trunc: "trunc", ps.RoundHalfToEven: "rint",
    ps.Pow: "power", ps.ArcTan2: "arctan2", ps.IntDiv: "floor_divide", ps.Mod: "modulo",
}  # fmt: skip

# Branch-free forms that LLVM turns into selects; a NaN argument stays NaN.
_TEMPLATES: dict[type, str] = {
    ps.Neg: "-{0}",
    ps.Switch: "({1} if {0} else {2})",
    ps.ScalarMaximum: "({0} if ({0} >= {1} or {0} != {0}) else {1})",
    ps.ScalarMinimum: "({0} if ({0} <= {1} or {0} != {0}) else {1})",
    ps.Clip: "({1} if {0} < {1} else ({2} if {0} > {2} else {0}))",
    ps.Sign: "(1.0 if {0} > 0.0 else (-1.0 if {0} < 0.0 else {0}))",
    ps.IsNan: "({0} != {0})",
    ps.IsInf: "(abs({0}) == inf)",
    Sigmoid: "1.0 / (1.0 + exp(-{0}))",
    Softplus: "({0} if {0} > 0.0 else 0.0) + log1p(exp(-abs({0})))",
    Log1mexp: "(log1p(-exp({0})) if {0} < -0.6931471805599453 else log(-expm1({0})))",
}


class Writer:
    """Writes the statements that compute some expressions, each at most once.

    ``namespace`` holds the functions that the source may call by name; ``known`` holds the code of
    expressions that were computed before.
    """

    def __init__(
        self,
        input_code: dict[str, str],
        namespace: Mapping[str, Any] = SCALAR_NAMESPACE,
        known: Mapping[Value, str] | None = None,
    ) -> None:
        self.namespace = namespace
        self._input_code = input_code
        self._names: dict[Value, str] = dict(known or {})
        self._n_names = len(self._names)
        self.fallbacks: dict[str, tuple[ps.ScalarOp, int]] = {}

    def statements(self, values: Iterable[Value]) -> list[str]:
        """Statements for everything that ``values`` depend on and that is not written yet."""
        lines: list[str] = []
        for expression in _in_order(values, self._names):
            code = self._code(expression)
            lines.append(f"{self._new_name(expression)} = {code}")
        return lines

    def name(self, value: Value) -> str:
        """The name in the source of a written expression, or the literal of a constant."""
        return self._names[value] if isinstance(value, Expression) else _literal(value)

    def keep_only(self, expressions: Iterable[Value]) -> None:
        """Forget what is written, except these: later statements are in another scope."""
        self._names = {e: self._names[e] for e in expressions}

    def read(self, expression: Value, code: str) -> str:
        """The statement that reads an expression that another scope has written."""
        return f"{self._new_name(expression)} = {code}"

    def _new_name(self, expression: Value) -> str:
        name = self._names[expression] = f"v{self._n_names}"
        self._n_names += 1
        return name

    def as_float(self, value: Value) -> str:
        """The same, as a double-precision number."""
        if not isinstance(value, Expression):
            return _literal(float(value))
        kind, name = value.kind, self.name(value)
        return name if kind == FLOAT else _cast(name, kind, FLOAT)

    def _code(self, expression: Expression) -> str:
        op, args = expression.op, expression.args
        if op is None:
            return self._input_code[args[0]]
        kind, names = type(op), [self.name(a) for a in args]
        if isinstance(op, ps.Pow) and is_constant(args[1]) and args[1] == int(args[1]):
            return f"{names[0]} ** {_literal(int(args[1]))}"
        if kind in _INFIX and not (kind in _CALLS and expression.kind == FLOAT):
            return f" {_INFIX[kind]} ".join(names)
        if kind in _CALLS:
            floats = names if expression.kind != FLOAT else [self.as_float(a) for a in args]
            return f"{_CALLS[kind]}({', '.join(floats)})"
        if kind in _TEMPLATES:
            return _TEMPLATES[kind].format(*names)
        if hasattr(op, "machine_code"):
            return f"{op.machine_code}({', '.join(self.as_float(a) for a in args)})"
        if isinstance(op, ps.Cast):
            return _cast(names[0], kind_of(args[0]), expression.kind)
        if isinstance(op, ps.AND | ps.OR | ps.XOR | ps.Invert):
            return _logical(op, expression.kind, names)
        return self._fallback(op, args)

    def _fallback(self, op: ps.ScalarOp, args: tuple) -> str:
        """A call of PyTensor's compiled function, for the less common operations."""
        key = (op, len(args))
        known = {kept: name for name, kept in self.fallbacks.items()}
        # Operations of one type may differ in their properties.
        name = known.get(key, f"{type(op).__name__.lower()}_{len(known)}")
        self.fallbacks[name] = key
        return f"{name}({', '.join(self.as_float(a) for a in args)})"


def _in_order(values: Iterable[Value], written: Mapping[Value, str]) -> list[Expression]:
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


def _literal(value: float | int | bool) -> str:
    if isinstance(value, float) and value != value:
        return "nan"
    if isinstance(value, float) and value in (float("inf"), float("-inf")):
        return "inf" if value > 0 else "(-inf)"
    return f"({value!r})" if value < 0 else repr(value)


def _cast(name: str, source: str, target: str) -> str:
    if target == FLOAT:
        return f"(1.0 if {name} else 0.0)" if source == BOOLEAN else f"float({name})"
    if target == INTEGER:
        return f"(1 if {name} else 0)" if source == BOOLEAN else f"int({name})"
    return f"({name} != 0)"


def _logical(op: ps.ScalarOp, kind: str, names: Sequence[str]) -> str:
    symbol = {ps.AND: ("and", "&"), ps.OR: ("or", "|"), ps.XOR: ("!=", "^")}.get(type(op))
    if symbol is None:
        return f"(not {names[0]})" if kind == BOOLEAN else f"(~{names[0]})"
    return "(" + f" {symbol[kind != BOOLEAN]} ".join(names) + ")"


def depends_on(values: Iterable[Value], inputs: frozenset[str]) -> set[Expression]:
    """The expressions under ``values`` that depend on any of the named inputs."""
    dependent: set[Expression] = set()
    for expression in _in_order(values, {}):
        if expression.op is None:
            if expression.args[0] in inputs:
                dependent.add(expression)
        elif any(isinstance(a, Expression) and a in dependent for a in expression.args):
            dependent.add(expression)
    return dependent


def n_operations(values: Iterable[Value]) -> int:
    """The number of operations under ``values``."""
    return sum(expression.op is not None for expression in _in_order(values, {}))
