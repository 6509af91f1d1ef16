"""Scalar expressions as LLVM instructions, and the functions that they call.

Scalar code calls the functions of libm. Loops over members call those of `numerics` instead, which
are linked into the module and inlined, because LLVM vectorises no loop that calls a library. Other
operations are machine code of their own, called by symbol: quantile functions, and what only
PyTensor has code for.
"""

import operator
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any

import pytensor.scalar as ps
from llvmlite import ir
from numba import types
from pytensor.link.numba.dispatch.basic import numba_funcify
from pytensor.scalar.math import Log1mexp, Sigmoid, Softplus

from ...errors import LoweringError
from ..native.entry_point import F64_PTR, EntryPoint
from ..numerics import exponential, trigonometric
from ..numerics.quantiles.binomial import bernoulli_quantile, binomial_quantile
from ..numerics.quantiles.gamma import gamma_quantile
from ..numerics.quantiles.normal import normal_probability
from ..numerics.quantiles.normal_below import (
    normal_excess,
    normal_hazard,
    normal_log_probability,
    normal_variance_below,
)
from ..numerics.quantiles.poisson import poisson_quantile
from . import trigamma as trigamma  # of which PyTensor's numba has no machine code
from .expressions import BOOLEAN, FLOAT, INTEGER, Expression, Value, in_order, kind_of
from .function_types import jit
from .machine_code import BOOL, DOUBLE, INT, Module

_NORMAL = (
    normal_probability, normal_log_probability, normal_hazard, normal_excess, normal_variance_below,
)  # fmt: skip

QUANTILES = {
    function.py_func.__name__: function
    for function in (
        poisson_quantile, binomial_quantile, bernoulli_quantile, gamma_quantile, *_NORMAL,
    )
}  # fmt: skip
"""By the names that operations have as ``machine_code``."""

INLINED = {
    function.py_func.__name__: function
    for function in (
        exponential.exp, exponential.exp2, exponential.expm1, exponential.log, exponential.log2,
        exponential.log10, exponential.log1p, exponential.power, exponential.sinh, exponential.cosh,
        exponential.tanh, trigonometric.sin, trigonometric.cos, trigonometric.tan,
        trigonometric.arctan, trigonometric.arctan2, trigonometric.floor_divide,
        trigonometric.modulo, *_NORMAL,
    )
}  # fmt: skip
"""What loops over members call."""

_DIVISIONS = {"floor_divide": operator.floordiv, "modulo": operator.mod}

_LLVM = {
    "exp": "exp", "exp2": "exp2", "log": "log", "log2": "log2", "log10": "log10", "sin": "sin",
    "cos": "cos", "power": "pow", "sqrt": "sqrt", "floor": "floor", "ceil": "ceil",
    "trunc": "trunc", "rint": "rint", "abs": "fabs",
}  # fmt: skip
_LIBM = {
    "expm1": "expm1", "log1p": "log1p", "tan": "tan", "arcsin": "asin", "arccos": "acos",
    "arctan": "atan", "arctan2": "atan2", "sinh": "sinh", "cosh": "cosh", "tanh": "tanh",
}  # fmt: skip

_CALLS: dict[type, str] = {
    ps.Exp: "exp", ps.Log: "log", ps.Log1p: "log1p", ps.Expm1: "expm1", ps.Sqrt: "sqrt",
    ps.Sin: "sin", ps.Cos: "cos", ps.Tan: "tan", ps.ArcTan: "arctan", ps.Tanh: "tanh",
    ps.Sinh: "sinh", ps.Cosh: "cosh", ps.Floor: "floor", ps.Ceil: "ceil", ps.Exp2: "exp2",
    ps.Log2: "log2", ps.Log10: "log10", ps.ArcSin: "arcsin", ps.ArcCos: "arccos",
    ps.Trunc: "trunc", ps.RoundHalfToEven: "rint", ps.Pow: "power", ps.ArcTan2: "arctan2",
    ps.IntDiv: "floor_divide", ps.Mod: "modulo",
}  # fmt: skip

_ARITHMETIC: dict[type, tuple[str, str]] = {
    ps.Add: ("fadd", "add"), ps.Sub: ("fsub", "sub"), ps.Mul: ("fmul", "mul"),
}  # fmt: skip
_COMPARISONS: dict[type, str] = {
    ps.LT: "<", ps.GT: ">", ps.LE: "<=", ps.GE: ">=", ps.EQ: "==", ps.NEQ: "!=",
}  # fmt: skip
_BITWISE: dict[type, str] = {ps.AND: "and_", ps.OR: "or_", ps.XOR: "xor"}

_FAST = ("contract", "nsz", "arcp")  # `FAST_MATH`, in one order: the text of a module is its key

_TYPES = {FLOAT: DOUBLE, INTEGER: INT, BOOLEAN: BOOL}


class Emitter:
    """Emits the instructions that compute expressions, each at most once.

    The functions that they call are declared in the module; the builder stands where they belong.
    ``read`` emits the value of an input, given its name, and ``vector`` tells whether the code is
    inside a loop that must vectorise.
    """

    def __init__(
        self,
        module: Module,
        builder: ir.IRBuilder,
        read: Callable[[str], ir.Value],
        *,
        vector: bool,
    ) -> None:
        self._module, self.builder, self._read, self._vector = module, builder, read, vector
        self._emitted: dict[Value, ir.Value] = {}

    def emit(self, values: Iterable[Value]) -> None:
        """Emit everything that ``values`` depend on and that is not emitted yet."""
        for e in in_order(values, self._emitted):
            self._emitted[e] = self._read(e.args[0]) if e.op is None else self._operation(e)

    def set(self, expression: Value, value: ir.Value) -> None:
        """Take a number that is already there for an expression."""
        self._emitted[expression] = value

    def keep_only(self, expressions: Iterable[Value]) -> None:
        """Forget all others: instructions that follow are in another block."""
        self._emitted = {e: self._emitted[e] for e in expressions}

    def floats(self, values: Iterable[Value]) -> list[ir.Value]:
        """The values as double-precision numbers, emitted before or now."""
        values = list(values)
        self.emit(values)
        return [self._as(v, FLOAT) for v in values]

    def _as(self, value: Value, kind: str) -> ir.Value:
        if not isinstance(value, Expression):
            python_type = {FLOAT: float, INTEGER: int, BOOLEAN: bool}[kind]
            return ir.Constant(_TYPES[kind], python_type(value))
        return self._converted(self._emitted[value], value.kind, kind)

    def _converted(self, value: ir.Value, source: str, target: str) -> ir.Value:
        build = self.builder
        if source == target:
            return value
        if target == FLOAT:
            return (build.uitofp if source == BOOLEAN else build.sitofp)(value, DOUBLE)
        if target == INTEGER:
            return build.zext(value, INT) if source == BOOLEAN else build.fptosi(value, INT)
        if source == FLOAT:
            return self._compared("!=", value, ir.Constant(DOUBLE, 0.0))
        return build.icmp_signed("!=", value, ir.Constant(INT, 0))

    def _operation(self, e: Expression) -> ir.Value:
        op, args = e.op, e.args
        assert op is not None
        if (arithmetic := _ARITHMETIC.get(type(op))) is not None:
            return self._arithmetic(arithmetic, args, e.kind)
        if (comparison := _COMPARISONS.get(type(op))) is not None:
            return self._comparison(comparison, args)
        if (bitwise := _BITWISE.get(type(op))) is not None:
            result, *rest = (self._as(a, e.kind) for a in args)
            for other in rest:
                result = getattr(self.builder, bitwise)(result, other)
            return result
        if isinstance(op, ps.Switch):
            condition, yes, no = args
            given = self._as(condition, BOOLEAN), self._as(yes, e.kind), self._as(no, e.kind)
            return self.builder.select(*given)
        if isinstance(op, ps.Cast):
            return self._as(args[0], e.kind)
        if isinstance(op, ps.Invert):
            return self.builder.not_(self._as(args[0], e.kind))
        if type(op) in (ps.IntDiv, ps.Mod) and e.kind != FLOAT:
            return self._divided(_CALLS[type(op)], [self._as(a, INTEGER) for a in args])
        if isinstance(op, ps.IsNan | ps.IsInf):
            return self._is_special(op, self._as(args[0], FLOAT))
        return self._converted(self._of_floats(op, args), FLOAT, e.kind)

    def _of_floats(self, op: ps.ScalarOp, args: tuple) -> ir.Value:
        """An operation on double-precision numbers."""
        numbers = [self._as(a, FLOAT) for a in args]
        if isinstance(op, ps.Pow) and kind_of(args[1]) != BOOLEAN and _is_whole(args[1]):
            return self._power(numbers[0], int(args[1]))
        if type(op) in _CALLS:
            return self._call(_CALLS[type(op)], numbers)
        if type(op) in _WRITTEN_OUT:
            return _WRITTEN_OUT[type(op)](self, *numbers)
        name = getattr(op, "machine_code", "")
        if name in INLINED:
            return self._inlined(name, numbers)
        entry = _quantile(name, len(args)) if name else _other_operation(op, len(args))
        return self._called(entry, numbers)

    # Instructions

    def arithmetic(self, name: str, a: ir.Value, b: ir.Value) -> ir.Value:
        """An instruction on two double-precision numbers."""
        return getattr(self.builder, name)(a, b, flags=_FAST)

    def _compared(self, operator: str, a: ir.Value, b: ir.Value) -> ir.Value:
        """A comparison of two double-precision numbers."""
        compare = self.builder.fcmp_unordered if operator == "!=" else self.builder.fcmp_ordered
        return compare(operator, a, b, flags=_FAST)

    def _arithmetic(self, names: tuple[str, str], args: tuple, kind: str) -> ir.Value:
        first, *others = (self._as(a, kind) for a in args)
        for other in others:
            if kind == FLOAT:
                first = self.arithmetic(names[0], first, other)
            else:
                first = getattr(self.builder, names[1])(first, other)
        return first

    def _comparison(self, operator: str, args: tuple) -> ir.Value:
        kind = FLOAT if FLOAT in map(kind_of, args) else INTEGER
        a, b = (self._as(v, kind) for v in args)
        if kind == FLOAT:
            return self._compared(operator, a, b)
        return self.builder.icmp_signed(operator, a, b)

    def _is_special(self, op: ps.ScalarOp, x: ir.Value) -> ir.Value:
        if isinstance(op, ps.IsNan):
            return self._compared("!=", x, x)
        return self._compared("==", self._call("abs", [x]), ir.Constant(DOUBLE, float("inf")))

    def _power(self, base: ir.Value, exponent: int) -> ir.Value:
        """A whole power other than 0, as products; a negative one of zero is infinite."""
        result, rest = None, abs(exponent)
        while rest:
            if rest % 2:
                result = base if result is None else self.arithmetic("fmul", result, base)
            rest //= 2
            base = self.arithmetic("fmul", base, base)
        one = ir.Constant(DOUBLE, 1.0)
        return result if exponent > 0 else self.arithmetic("fdiv", one, result)

    # Calls

    def _call(self, name: str, numbers: list[ir.Value]) -> ir.Value:
        if self._vector and name in INLINED:
            return self._inlined(name, numbers)
        if name in _DIVISIONS:
            return self._divided(name, numbers)
        symbol = f"llvm.{_LLVM[name]}.f64" if name in _LLVM else _LIBM[name]
        function = self._module.declared(symbol, [n.type for n in numbers], DOUBLE)
        return self.builder.call(function, numbers, fastmath=_FAST)

    def _inlined(self, name: str, numbers: list[ir.Value]) -> ir.Value:
        function = self._module.inlined(name, INLINED[name], [types.float64] * len(numbers))
        return self.builder.call(function, numbers)

    def _divided(self, name: str, numbers: list[ir.Value]) -> ir.Value:
        """A division with remainder, as numba has it."""
        kind = types.float64 if numbers[0].type == DOUBLE else types.int64
        function = self._module.inlined(f"{name}.{kind}", _division(name), [kind] * 2)
        return self.builder.call(function, numbers)

    def _called(self, entry: EntryPoint, numbers: list[ir.Value]) -> ir.Value:
        """Call an entry point that reads numbers and writes one."""
        build = self.builder
        with build.goto_entry_block():
            given = build.alloca(DOUBLE, size=ir.Constant(INT, len(numbers) + 1))
        for i, number in enumerate(numbers):
            build.store(number, build.gep(given, [ir.Constant(INT, i + 1)]))
        self._module.call(build, entry, [given])
        return build.load(given)


def _is_whole(value: Value) -> bool:
    return not isinstance(value, Expression) and value == int(value)


def _constant(x: float) -> ir.Constant:
    return ir.Constant(DOUBLE, x)


# Branch-free forms that LLVM turns into selects; a NaN argument stays NaN.


def _extremum(comparison: str) -> Callable[..., ir.Value]:
    def extremum(emitter: Emitter, a: ir.Value, b: ir.Value) -> ir.Value:
        first = emitter._compared(comparison, a, b)
        is_first = emitter.builder.or_(first, emitter._compared("!=", a, a))
        return emitter.builder.select(is_first, a, b)

    return extremum


def _clip(emitter: Emitter, x: ir.Value, low: ir.Value, high: ir.Value) -> ir.Value:
    select = emitter.builder.select
    below = select(emitter._compared(">", x, high), high, x)
    return select(emitter._compared("<", x, low), low, below)


def _sign(emitter: Emitter, x: ir.Value) -> ir.Value:
    select, zero = emitter.builder.select, _constant(0.0)
    others = select(emitter._compared("<", x, zero), _constant(-1.0), x)
    return select(emitter._compared(">", x, zero), _constant(1.0), others)


def _negative(emitter: Emitter, x: ir.Value) -> ir.Value:
    return emitter.arithmetic("fsub", _constant(-0.0), x)


def _sigmoid(emitter: Emitter, x: ir.Value) -> ir.Value:
    odds = emitter._call("exp", [_negative(emitter, x)])
    return emitter.arithmetic(
        "fdiv", _constant(1.0), emitter.arithmetic("fadd", _constant(1.0), odds)
    )


def _softplus(emitter: Emitter, x: ir.Value) -> ir.Value:
    zero = _constant(0.0)
    positive = emitter.builder.select(emitter._compared(">", x, zero), x, zero)
    small = emitter._call("exp", [_negative(emitter, emitter._call("abs", [x]))])
    return emitter.arithmetic("fadd", positive, emitter._call("log1p", [small]))


def _log1mexp(emitter: Emitter, x: ir.Value) -> ir.Value:
    far = emitter._call("log1p", [_negative(emitter, emitter._call("exp", [x]))])
    near = emitter._call("log", [_negative(emitter, emitter._call("expm1", [x]))])
    is_far = emitter._compared("<", x, _constant(-0.6931471805599453))
    return emitter.builder.select(is_far, far, near)


_WRITTEN_OUT: dict[type, Callable[..., ir.Value]] = {
    ps.TrueDiv: lambda emitter, a, b: emitter.arithmetic("fdiv", a, b),
    ps.Neg: _negative, ps.Abs: lambda emitter, x: emitter._call("abs", [x]),
    ps.ScalarMaximum: _extremum(">="), ps.ScalarMinimum: _extremum("<="), ps.Clip: _clip,
    ps.Sign: _sign, Sigmoid: _sigmoid, Softplus: _softplus, Log1mexp: _log1mexp,
}  # fmt: skip


@lru_cache
def _division(name: str) -> Any:
    divide = _DIVISIONS[name]
    return jit(lambda a, b: divide(a, b), large=True)


_CALL_ARGUMENTS = {"numbers": F64_PTR}


def _entry(function: Any, n_arguments: int, name: str, *parts: str) -> EntryPoint:
    """A function of numbers as an entry point that reads them behind the place of its result."""
    given = ", ".join(f"numbers[{i + 1}]" for i in range(n_arguments))
    scope: dict[str, Any] = {"function": function}
    exec(f"def call(numbers): numbers[0] = function({given})", scope)
    scope["call"].__module__ = __name__
    return EntryPoint(scope["call"], _CALL_ARGUMENTS, name, (str(n_arguments), *parts))


@lru_cache
def _quantile(name: str, n_arguments: int) -> EntryPoint:
    return _entry(QUANTILES[name], n_arguments, name)


@lru_cache(maxsize=1024)
def _other_operation(op: ps.ScalarOp, n_arguments: int) -> EntryPoint:
    """PyTensor's compiled function, for the less common operations."""
    node = op.make_node(*(ps.float64() for _ in range(n_arguments)))
    try:
        function = numba_funcify(op, node=node)
    except NotImplementedError as error:
        raise LoweringError(
            f"functions of the system must consist of pytensor.tensor operations that numba "
            f"supports, got {op}"
        ) from error
    return _entry(function, n_arguments, type(op).__name__.lower(), repr(op))


def depends_on(values: Iterable[Value], inputs: frozenset[str]) -> set[Expression]:
    """The expressions under ``values`` that depend on any of the named inputs."""
    dependent: set[Expression] = set()
    for expression in in_order(values, {}):
        if expression.op is None:
            if expression.args[0] in inputs:
                dependent.add(expression)
        elif any(isinstance(a, Expression) and a in dependent for a in expression.args):
            dependent.add(expression)
    return dependent


def n_operations(values: Iterable[Value]) -> int:
    """The number of operations under ``values``."""
    return sum(expression.op is not None for expression in in_order(values, {}))
