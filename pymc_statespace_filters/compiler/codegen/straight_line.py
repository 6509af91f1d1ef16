"""Compilation of straight-line code: assignments to variables and to elements of arrays.

Numba's front end takes about 3 ms for a statement, ten times as long as LLVM does for all that it
makes of it. Its passes serve branches, loops and types that are not known, of which straight-line
code has none. So the statements are translated to LLVM's instructions here, in one pass. Functions
that they call are resolved and compiled by numba.
"""

import ast
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing import signature
from numba.extending import intrinsic
from numba.np.arrayobj import load_item, make_array, store_item

_OPERATORS: dict[type, Callable] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod, ast.Pow: operator.pow,
    ast.BitAnd: operator.and_, ast.BitOr: operator.or_, ast.BitXor: operator.xor,
    ast.Lt: operator.lt, ast.Gt: operator.gt, ast.LtE: operator.le, ast.GtE: operator.ge,
    ast.Eq: operator.eq, ast.NotEq: operator.ne, ast.USub: operator.neg,
    ast.Invert: operator.invert,
}  # fmt: skip

# On two double-precision numbers; numba would emit the same instruction.
_ARITHMETIC = {
    operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv",
}  # fmt: skip
_ORDERED = {
    operator.lt: "<", operator.gt: ">", operator.le: "<=", operator.ge: ">=", operator.eq: "==",
}  # fmt: skip

_BUILTINS = {"abs": abs, "float": float, "int": int}


def straight_line(arguments: str, lines: Sequence[str], namespace: Mapping[str, Any]) -> Any:
    """A function of these arguments that consists of straight-line code, for compiled callers.

    Its code is inserted into the caller's. Arguments are numbers, arrays, addresses of numbers and
    tuples; the last line may return numbers in nested tuples. Indices count from zero and are not
    checked. Numbers at different addresses must not overlap, which spares a loop the checks.
    """
    statements = ast.parse("\n".join(lines)).body
    names = [argument.strip() for argument in arguments.split(",")]

    def typed(typing: Any, kinds: tuple) -> tuple:
        reader = _Reader(typing, namespace, dict(zip(names, kinds, strict=True)))
        steps = [reader.statement(statement) for statement in statements]
        of_address = zip(names, kinds, strict=True)
        addresses = [name for name, kind in of_address if isinstance(kind, types.CPointer)]

        def generate(context: Any, builder: Any, _: Any, values: Sequence) -> Any:
            frame = _Frame(context, builder, dict(zip(names, values, strict=True)), addresses)
            result = None
            for step in steps:
                result = step(frame)
            return context.get_dummy_value() if reader.returned is None else result

        returned = types.void if reader.returned is None else reader.returned
        return signature(returned, *kinds), generate

    scope = {"typed": typed}
    exec(f"def code(typing, {arguments}): return typed(typing, ({arguments},))", scope)
    return intrinsic(scope["code"])


@dataclass
class _Frame:
    """One translation: the values of the names so far, arrays and functions that it made."""

    context: Any
    builder: Any
    values: dict[str, Any]
    addresses: Sequence[str]
    arrays: dict[str, Any] = field(default_factory=dict)
    functions: dict[Any, Any] = field(default_factory=dict)

    def call(self, function: Any, sig: Any, arguments: Sequence) -> Any:
        """Call a function that numba resolved."""
        if (function, sig) not in self.functions:
            self.functions[function, sig] = self.context.get_function(function, sig)
        code = self.functions[function, sig]
        result = code(self.builder, arguments)
        self.context.add_linking_libs(getattr(code, "libs", ()))
        return result

    def element(self, name: str, kind: Any, indices: Sequence) -> Any:
        """The address of an element."""
        if name not in self.arrays:
            self.arrays[name] = make_array(kind)(self.context, self.builder, self.values[name])
        return cgutils.get_item_pointer(
            self.context, self.builder, kind, self.arrays[name], indices, wraparound=False
        )

    def access(self, name: str, kind: Any, indices: Sequence, value: Any = None) -> Any:
        """Read an element, or set it to a value."""
        if isinstance(kind, types.CPointer):
            address = self.builder.gep(self.values[name], list(indices))
            read = value is None
            made = self.builder.load(address) if read else self.builder.store(value, address)
            self._mark(made, name)
            return made
        address = self.element(name, kind, indices)
        if value is None:
            return load_item(self.context, self.builder, kind, address)
        return store_item(self.context, self.builder, kind, value, address)

    def _mark(self, instruction: Any, name: str) -> None:
        """Tell LLVM that what is at one address overlaps with nothing at the others."""
        module = self.builder.module
        domain = module.add_metadata(["addresses"])
        scopes = {other: module.add_metadata([other, domain]) for other in self.addresses}
        own = scopes.pop(name)
        instruction.set_metadata("alias.scope", module.add_metadata([own]))
        if scopes:
            instruction.set_metadata("noalias", module.add_metadata(list(scopes.values())))


Emit = Callable[[_Frame], Any]


@dataclass(frozen=True)
class _Term:
    """An expression: its type, and how it is emitted."""

    type: Any
    emit: Emit


class _Reader:
    """Reads statements one after the other; knows the types of the names so far."""

    def __init__(self, typing: Any, namespace: Mapping[str, Any], names: dict[str, Any]) -> None:
        self._typing, self._namespace, self._types = typing, namespace, names
        self._signatures: dict[tuple, tuple] = {}
        self.returned: Any = None

    def statement(self, node: Any) -> Emit:
        """How a statement is emitted."""
        term = self._term(node.value)
        if isinstance(node, ast.Return):
            self.returned = term.type
            return term.emit
        (target,) = node.targets
        if isinstance(target, ast.Name):
            self._types[target.id] = term.type
            return lambda frame: frame.values.__setitem__(target.id, term.emit(frame))
        return self._store(target, term)

    def _store(self, target: ast.Subscript, term: _Term) -> Emit:
        name, kind, indices = self._place(target)
        value = self._cast(term, kind.dtype)

        def emit(frame: _Frame) -> None:
            places = [index.emit(frame) for index in indices]
            frame.access(name, kind, places, value.emit(frame))

        return emit

    def _term(self, node: Any) -> _Term:
        return getattr(self, f"_{type(node).__name__.lower()}")(node)

    def _name(self, node: ast.Name) -> _Term:
        name = node.id
        if name not in self._types:
            return self._number(self._namespace[name])
        return _Term(self._types[name], lambda frame: frame.values[name])

    def _constant(self, node: ast.Constant) -> _Term:
        return self._number(node.value)

    def _number(self, value: Any) -> _Term:
        kinds = {bool: types.boolean, int: types.int64, float: types.float64}
        kind = kinds[type(value)]
        return _Term(kind, lambda frame: frame.context.get_constant(kind, value))

    def _tuple(self, node: ast.Tuple) -> _Term:
        terms = [self._term(element) for element in node.elts]
        kind = types.Tuple([term.type for term in terms])

        def emit(frame: _Frame) -> Any:
            return frame.context.make_tuple(
                frame.builder, kind, [term.emit(frame) for term in terms]
            )

        return _Term(kind, emit)

    def _unaryop(self, node: ast.UnaryOp) -> _Term:
        if isinstance(node.op, ast.USub) and isinstance(node.operand, ast.Constant):
            value: Any = node.operand.value
            return self._number(-value)
        term = self._term(node.operand)
        if isinstance(node.op, ast.Not):
            return _Term(types.boolean, lambda frame: frame.builder.not_(term.emit(frame)))
        return self._called(_OPERATORS[type(node.op)], term)

    def _binop(self, node: ast.BinOp) -> _Term:
        function, left = _OPERATORS[type(node.op)], self._term(node.left)
        exponent = _whole(node.right)
        if function is operator.pow and exponent and left.type == types.float64:
            return _Term(types.float64, lambda frame: _power(frame, left.emit(frame), exponent))
        return self._called(function, left, self._term(node.right))

    def _compare(self, node: ast.Compare) -> _Term:
        (op,), (right,) = node.ops, node.comparators
        return self._called(_OPERATORS[type(op)], self._term(node.left), self._term(right))

    def _boolop(self, node: ast.BoolOp) -> _Term:
        first, *others = (self._cast(self._term(value), types.boolean) for value in node.values)
        name = "and_" if isinstance(node.op, ast.And) else "or_"

        def emit(frame: _Frame) -> Any:
            result = first.emit(frame)
            for other in others:
                result = getattr(frame.builder, name)(result, other.emit(frame))
            return result

        return _Term(types.boolean, emit)

    def _ifexp(self, node: ast.IfExp) -> _Term:
        condition = self._cast(self._term(node.test), types.boolean)
        yes, no = self._term(node.body), self._term(node.orelse)
        kind = self._typing.unify_types(yes.type, no.type)
        yes, no = self._cast(yes, kind), self._cast(no, kind)
        return _Term(
            kind,
            lambda frame: frame.builder.select(
                condition.emit(frame), yes.emit(frame), no.emit(frame)
            ),
        )

    def _call(self, node: ast.Call) -> _Term:
        assert isinstance(node.func, ast.Name)
        function = self._namespace.get(node.func.id, _BUILTINS.get(node.func.id))
        return self._called(function, *(self._term(argument) for argument in node.args))

    def _subscript(self, node: ast.Subscript) -> _Term:
        name, kind, indices = self._place(node)
        if isinstance(kind, types.BaseTuple):
            assert isinstance(node.slice, ast.Constant)
            i: Any = node.slice.value
            return _Term(kind[i], lambda f: f.builder.extract_value(f.values[name], i))

        def emit(frame: _Frame) -> Any:
            return frame.access(name, kind, [index.emit(frame) for index in indices])

        return _Term(kind.dtype, emit)

    def _place(self, node: ast.Subscript) -> tuple[str, Any, list[_Term]]:
        """The name and type of what is indexed, and the indices."""
        assert isinstance(node.value, ast.Name)
        indices = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        return node.value.id, self._types[node.value.id], [self._term(index) for index in indices]

    def _called(self, function: Any, *terms: _Term) -> _Term:
        """A call of a function or operator."""
        kinds = tuple(term.type for term in terms)
        if kinds == (types.float64, types.float64):
            if (instruction := _instruction(function)) is not None:
                a, b = terms
                kind = types.float64 if function in _ARITHMETIC else types.boolean
                return _Term(kind, lambda f: instruction(f.builder, a.emit(f), b.emit(f)))
        resolved, sig = self._resolved(function, kinds)
        arguments = self._arguments(terms, sig.args)
        return _Term(
            sig.return_type, lambda f: f.call(resolved, sig, [a.emit(f) for a in arguments])
        )

    def _arguments(self, terms: Sequence[_Term], kinds: Sequence) -> list[_Term]:
        """Terms of the types of a signature, which takes those of ``*args`` as one tuple."""
        n = len(kinds)
        if kinds and isinstance(kinds[-1], types.StarArgTuple | types.StarArgUniTuple):
            n -= 1
            rest = [self._cast(t, k) for t, k in zip(terms[n:], kinds[-1], strict=True)]
            packed = _Term(
                kinds[-1],
                lambda f: f.context.make_tuple(f.builder, kinds[-1], [t.emit(f) for t in rest]),
            )
            terms = [*terms[:n], packed]
        return [self._cast(t, k) for t, k in zip(terms, kinds, strict=True)]

    def _resolved(self, function: Any, kinds: tuple) -> tuple:
        key = (id(function), kinds)
        if key not in self._signatures:
            resolved = self._typing.resolve_value_type(function)
            self._signatures[key] = resolved, resolved.get_call_type(self._typing, kinds, {})
        return self._signatures[key]

    def _cast(self, term: _Term, kind: Any) -> _Term:
        if term.type == kind:
            return term
        return _Term(kind, lambda f: f.context.cast(f.builder, term.emit(f), term.type, kind))


def _power(frame: _Frame, base: Any, exponent: int) -> Any:
    """A whole power other than 0, as products; of zero a negative one is infinite, as in numpy."""
    result, rest = None, abs(exponent)
    while rest:
        if rest % 2:
            result = base if result is None else frame.builder.fmul(result, base)
        rest //= 2
        base = frame.builder.fmul(base, base)
    one = frame.context.get_constant(types.float64, 1.0)
    return result if exponent > 0 else frame.builder.fdiv(one, result)


def _whole(node: Any) -> int:
    """The whole number that an expression states, 0 if it states none."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return -_whole(node.operand)
    value = getattr(node, "value", None)
    return value if type(value) is int else 0


def _instruction(function: Any) -> Callable[[Any, Any, Any], ir.Value] | None:
    """The instruction for an operator on two double-precision numbers."""
    if function in _ARITHMETIC:
        return lambda builder, a, b: getattr(builder, _ARITHMETIC[function])(a, b)
    if function in _ORDERED:
        return lambda builder, a, b: builder.fcmp_ordered(_ORDERED[function], a, b)
    if function is operator.ne:
        return lambda builder, a, b: builder.fcmp_unordered("!=", a, b)
    return None
