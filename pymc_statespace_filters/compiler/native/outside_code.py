"""What a numba function of a user's own file is: its bytecode, and all that it refers to.

Numba compiles the values of globals and closures into a function. So they belong to its identity,
and so do the functions among them, with what they refer to in turn.
"""

import dis
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher

type Known = Callable[[Any], str | None]

# Of fixed meaning with the versions of numba and Python.
_FIXED = {"builtins", "cmath", "llvmlite", "math", "numba", "numpy"}


class UnknownValueError(Exception):
    """A function refers to something whose content cannot be told."""


def identity_of(function: Any, known: Known) -> tuple:
    """A tuple that is equal for functions that numba compiles to the same code, in any process.

    ``known`` returns the key of a function that has one by its module; None if it has not. Raises
    `UnknownValueError` if the function refers to what is neither a number, a text, an array, a
    tuple of these, a module, a class of named tuples nor a numba function.
    """
    return _Described(known).value(function)


class _Described:
    """Values that a function refers to, as nested tuples of texts and numbers."""

    def __init__(self, known: Known) -> None:
        self._known = known
        self._seen: dict[Any, int] = {}  # functions may call each other

    def value(self, value: Any, attributes: frozenset[str] = frozenset()) -> tuple:
        """Describe a value, of which a function reads some of these attributes."""
        kind = type(value).__name__
        match value:
            case None | bool() | int() | float() | complex() | str() | bytes():
                return kind, repr(value)
            case np.ndarray() | np.generic() if value.dtype.kind in "biufc":
                array = np.asarray(value)
                return kind, array.dtype.str, array.shape, array.strides, array.tobytes()
            case tuple() | frozenset() | set() | dict():
                parts = [self.value(one) for one in getattr(value, "items", lambda: value)()]
                return kind, *(parts if isinstance(value, tuple) else sorted(parts, key=repr))
            case CodeType():
                return self._code(value)
            case ModuleType():
                return self._module(value, attributes)
            case Dispatcher():
                options = value.targetoptions, value._compiler.pipeline_class.__name__  # type: ignore[attr-defined]
                return self._function(value.py_func, self.value(options))
            case FunctionType():
                return self._function(value)
            case type() if issubclass(value, tuple) and hasattr(value, "_fields"):
                return kind, value.__name__, value._fields
        return _named(value)

    def _function(self, function: FunctionType, *options: tuple) -> tuple:
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        if key := self._known(function):
            return "known", key, *map(self.value, cells)
        if _is_fixed(function.__module__):
            return _named(function)
        if (number := self._seen.get(function)) is not None:
            return "seen", number
        self._seen[function] = len(self._seen)
        code, given = function.__code__, function.__globals__
        names = frozenset(_names(code))
        read = {name: given[name] for name in _globals_read(code) if name in given}
        defaults = function.__defaults__, function.__kwdefaults__
        return (
            "function", self._code(code), self.value(defaults), *options, *map(self.value, cells),
            *((name, self.value(read[name], names)) for name in sorted(read)),
        )  # fmt: skip

    def _code(self, code: CodeType) -> tuple:
        names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
        return (
            "code", code.co_code, code.co_flags, code.co_argcount, names, code.co_exceptiontable,
            *map(self.value, code.co_consts),
        )  # fmt: skip

    def _module(self, module: ModuleType, attributes: frozenset[str]) -> tuple:
        if _is_fixed(module.__name__):
            return "module", module.__name__
        if (number := self._seen.get((module, attributes))) is not None:
            return "seen", number
        self._seen[module, attributes] = len(self._seen)
        read = sorted(name for name in attributes if hasattr(module, name))
        return "module", *((name, self.value(getattr(module, name), attributes)) for name in read)


def _named(value: Any) -> tuple:
    """What is known by its name, such as `math.sqrt`."""
    owner = getattr(value, "__module__", None) or type(value).__module__
    if not (callable(value) and _is_fixed(owner)):
        raise UnknownValueError(repr(value))
    return "named", owner, getattr(value, "__qualname__", repr(value))


def _is_fixed(module: str) -> bool:
    return module.partition(".")[0] in _FIXED


def _names(code: CodeType) -> Iterator[str]:
    """The attributes that a function may read, those in functions inside it too."""
    yield from code.co_names
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _names(inner)


def _globals_read(code: CodeType) -> set[str]:
    """The names of the globals that a function reads, those in functions inside it too."""
    read = {i.argval for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL"}
    return read.union(*(_globals_read(c) for c in code.co_consts if isinstance(c, CodeType)))
