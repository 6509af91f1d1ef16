"""Functions that a user wrote: their signatures, and checks of the symbols that they return."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.graph.basic import Constant, Variable
from pytensor.graph.fg import FunctionGraph
from pytensor.graph.rewriting.utils import rewrite_graph
from pytensor.graph.traversal import graph_inputs
from pytensor.tensor.rewriting.basic import topo_unconditional_constant_folding
from pytensor.tensor.rewriting.shape import ShapeFeature
from pytensor.tensor.variable import TensorVariable

from ..errors import ModelError
from .checks import shortened

RESERVED = {
    "x": "the state",
    "q": "the process noise",
    "e": "the measurement noise",
    "u": "the inputs",
    "t": "the time",
}
FUNCTIONS_OF_STATE = (
    "transition", "drift", "diffusion", "process_dist",
    "observation", "observation_dist", "observation_logp",
)  # fmt: skip
_WITHOUT_STATE = (
    "It has no argument x, the state, and other names than "
    f"{', '.join(f'{name} ({what})' for name, what in RESERVED.items())} are parameters, which are "
    "numbers unless shapes= says otherwise"
)
_HOW_TO_WRITE = (
    "Write it with pytensor.tensor operations: pt.switch instead of if or np.where, pt.stack "
    "instead of np.array"
)
# What has a row for each state, whose number is that of the initial mean.
ROWS_ARE_STATES = ("transition", "drift", "diffusion", "A", "B", "offset")


@dataclass(frozen=True)
class Equation:
    """A user's function: its reserved arguments (``symbols``), parameters and defaults."""

    role: str
    function: Callable
    symbols: tuple[str, ...]
    parameters: tuple[str, ...]
    defaults: tuple[tuple[str, Any], ...]

    def __call__(self, values: Mapping[str, Variable]) -> Any:
        """Call the function with the symbols and parameters that are its arguments, by name."""
        arguments = {name: values[name] for name in (*self.symbols, *self.parameters)}
        try:
            return self.function(**arguments)
        except ModelError:
            raise
        except Exception as error:
            reason = str(error).rstrip(".")
            raise ModelError(
                f"{self.role} could not be traced with symbolic arguments "
                f"({', '.join(arguments)}): {type(error).__name__}: {reason}. "
                + (_WITHOUT_STATE if self._may_lack_state else _HOW_TO_WRITE)
            ) from error

    @property
    def _may_lack_state(self) -> bool:
        """Whether an argument may be the state under another name."""
        has_state = "x" in self.symbols or not self.parameters
        return self.role in FUNCTIONS_OF_STATE and not has_state


def read_equation(role: str, function: Any, symbols: Sequence[str]) -> Equation:
    """Read the signature of a user's function, called ``role`` in messages.

    ``symbols`` are the reserved names that it may have as arguments; others are parameters.
    """
    if not callable(function):
        raise ModelError(f"{role} must be a function, got {function!r}")
    found: list[str] = []
    parameters: list[str] = []
    defaults: list[tuple[str, Any]] = []
    for name, argument in _signature(role, function).items():
        if argument.kind not in (argument.POSITIONAL_OR_KEYWORD, argument.KEYWORD_ONLY):
            raise ModelError(f"{role} must have named arguments only, got {argument}")
        if name in symbols:
            found.append(name)
        elif name in RESERVED:
            raise ModelError(
                f"{role}: the argument name {name!r} is reserved for {RESERVED[name]}; besides "
                f"parameters, {role} may have {', '.join(symbols) or 'no arguments'}"
            )
        else:
            parameters.append(name)
        if argument.default is not argument.empty:
            if name in symbols:
                raise ModelError(
                    f"{role}: the reserved argument {name!r} must have no default, got "
                    f"{argument.default!r}"
                )
            defaults.append((name, _default(role, name, argument.default)))
    return Equation(role, function, tuple(found), tuple(parameters), tuple(defaults))


def _signature(role: str, function: Callable) -> Mapping[str, inspect.Parameter]:
    try:
        return inspect.signature(function).parameters
    except (TypeError, ValueError):  # built-in functions may have none
        raise ModelError(
            f"{role} must have a readable signature, got {function!r}; wrap it in a Python function"
        ) from None


def _default(role: str, name: str, value: Any) -> Any:
    try:
        array = np.asarray(value, dtype="float64")
    except (TypeError, ValueError):
        array = np.asarray(np.nan)
    if value is None or not np.isfinite(array).all():
        # The usual wish behind an infinite default is the model without a term.
        remedy = (
            f"; write the equations with the reciprocal, inverse_{name} = 1 / {name}, and the "
            f"default 0"
            if np.isinf(array).any()
            else ""
        )
        raise ModelError(
            f"{role}: the default of {name!r} must be a finite number, got {value!r}{remedy}"
        )
    # Nested tuples, because a system is hashable.
    return float(array) if array.ndim == 0 else _nested_tuple(array.tolist())


def _nested_tuple(value: Any) -> Any:
    return tuple(map(_nested_tuple, value)) if isinstance(value, list) else value


def as_symbol(role: str, value: Any) -> TensorVariable:
    """A number, symbol, array or nested list of these as a double-precision symbol."""
    if isinstance(value, list | tuple):
        parts = [as_symbol(role, part) for part in value]
        if not parts:
            return pt.as_tensor(np.zeros(0))
        if len({part.type.ndim for part in parts}) > 1:
            raise ModelError(f"{role} must return entries of one shape, got several")
        return pt.stack(parts)
    if isinstance(value, Variable):
        symbol = value if isinstance(value, TensorVariable) else pt.as_tensor(value)
        if symbol.type.dtype.startswith("complex"):
            raise ModelError(f"{role} must return real numbers, got {symbol.type.dtype}")
        return symbol if symbol.type.dtype == "float64" else pt.cast(symbol, "float64")
    if value is None:
        raise ModelError(f"{role} must return one expression per component, got None")
    if isinstance(value, np.ndarray) and value.dtype == object:
        raise ModelError(
            f"{role} must return a list or a symbol, got a numpy array of symbols: "
            f"{shortened(value)}. Use pytensor.tensor (pt.roll, pt.stack, @) instead of numpy"
        )
    try:
        # A 64-bit array: PyTensor would store a bare 0.5 in single precision.
        return pt.as_tensor(np.asarray(value, dtype="float64"))
    except (TypeError, ValueError):
        raise ModelError(f"{role} must return symbols or numbers, got {value!r}") from None


def as_vector(role: str, value: Any, length: int | None = None) -> TensorVariable:
    """What a function returned as a vector, of the given length unless it is None.

    One component may be a scalar.
    """
    symbol = as_symbol(role, value)
    if symbol.type.ndim == 0 and length in (None, 1):
        symbol = as_symbol(role, [value])
    if symbol.type.ndim != 1:
        raise ModelError(
            f"{role} must return one expression per component (a list or a vector), "
            f"got {symbol.type.ndim} dimensions"
        )
    return _of_length(role, symbol, (length,))


def as_matrix(
    role: str, value: Any, rows: int | None = None, columns: int | None = None
) -> TensorVariable:
    """What a function returned as a matrix, of the given numbers of rows and columns.

    A matrix of one row and column may be a scalar.
    """
    symbol = as_symbol(role, value)
    if symbol.type.ndim == 0 and rows in (None, 1) and columns in (None, 1):
        symbol = as_symbol(role, [[value]])
    if symbol.type.ndim != 2:
        raise ModelError(
            f"{role} must be a matrix (nested lists or pt.stack of rows), "
            f"got {symbol.type.ndim} dimensions"
        )
    return _of_length(role, symbol, (rows, columns))


def _of_length(role: str, symbol: TensorVariable, expected: Sequence[int | None]) -> TensorVariable:
    shape = static_shape(symbol)
    if None in shape:
        if None in expected:
            raise ModelError(f"{role} must return arrays of static shape, got shape {shape}")
        return pt.specify_shape(symbol, tuple(expected))
    wanted = tuple(s if e is None else e for e, s in zip(expected, shape, strict=True))
    if shape != wanted:
        states = f"; initial_mean has {wanted[0]} states" if role in ROWS_ARE_STATES else ""
        raise ModelError(f"{role} must have shape {wanted}, got {shape}{states}")
    return symbol if symbol.type.shape == shape else pt.specify_shape(symbol, shape)


def static_shape(symbol: TensorVariable) -> tuple[int | None, ...]:
    """The static shape, which some operations (pt.roll) do not infer by themselves."""
    if None not in symbol.type.shape:
        return symbol.type.shape
    lengths = folded_constants([symbol.shape[i] for i in range(symbol.type.ndim)])
    return tuple(None if isinstance(s, Variable) else int(s) for s in lengths)


def folded_constants(symbols: Sequence[Variable]) -> list[Any]:
    """The values of those that are constant, and what the others have become."""
    graph = FunctionGraph(outputs=list(symbols), features=[ShapeFeature()], copy_inputs=False)
    rewrite_graph(graph)  # may show more of them to be constant
    topo_unconditional_constant_folding.apply(graph)
    return [each.data if isinstance(each, Constant) else each for each in graph.outputs]


def read_covariance(role: str, value: Any, symbols: Sequence[str] = "") -> Any:
    """A covariance as an `Equation` of parameters and these symbols, or as the numbers given."""
    return read_equation(role, value, symbols) if callable(value) else value


def trace_covariance(
    role: str,
    covariance: Any,
    size: int | None,
    values: Mapping[str, Variable],
) -> TensorVariable:
    """The matrix (size, size) of a covariance; numbers are checked."""
    if isinstance(covariance, Equation):
        matrix = as_matrix(role, covariance(values), size, size)
        _check_symmetry(role, matrix)
        return matrix
    return pt.as_tensor(_constant_covariance(role, covariance, size))


def _check_symmetry(role: str, matrix: TensorVariable) -> None:
    """Raise if the matrix of a function is not symmetric at parameters between 0.6 and 0.9.

    Filters use one triangle of it. A matrix that cannot be computed there is not checked.
    """
    if matrix.type.shape == (1, 1):
        return
    inputs = [v for v in graph_inputs([matrix]) if not isinstance(v, Constant)]
    rng = np.random.default_rng(1)
    values = []
    for symbol in inputs:
        if None in symbol.type.shape or symbol.type.dtype != "float64":
            return
        values.append(rng.uniform(0.6, 0.9, symbol.type.shape))
    function = pytensor.function(inputs, matrix, mode="FAST_COMPILE", on_unused_input="ignore")
    try:
        with np.errstate(all="ignore"):
            found = function(*values)
    except (ArithmeticError, AssertionError, ValueError, np.linalg.LinAlgError):
        return
    if found.shape != found.T.shape:
        return  # its size is refused elsewhere
    if np.isfinite(found).all() and np.abs(found - found.T).max() > 1e-8 * np.abs(found).max():
        raise ModelError(
            f"{role} must be symmetric, got {found.round(4).tolist()} at parameters between 0.6 "
            "and 0.9"
        )


def _constant_covariance(role: str, value: Any, size: int | None) -> np.ndarray:
    try:
        matrix = np.array(value, dtype="float64")
    except (TypeError, ValueError):
        raise ModelError(f"{role} must be a matrix of numbers, got {value!r}") from None
    if matrix.ndim == 0 and size in (None, 1):
        matrix = matrix.reshape(1, 1)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ModelError(f"{role} must be a square matrix, got shape {matrix.shape}")
    if size is not None and matrix.shape[0] != size:
        raise ModelError(f"{role} must have shape {(size, size)}, got {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise ModelError(f"{role} must be finite, got {matrix.tolist()}")
    scale = np.abs(matrix).max(initial=0.0)
    if np.abs(matrix - matrix.T).max(initial=0.0) > 1e-10 * scale:
        raise ModelError(f"{role} must be symmetric, got {matrix.tolist()}")
    smallest = np.linalg.eigvalsh(matrix).min(initial=np.inf)
    if smallest < -1e-10 * scale:
        raise ModelError(
            f"{role} must be a covariance (not a standard deviation) without negative eigenvalues, "
            f"got {matrix.tolist()} with the eigenvalue {smallest:.6g}"
        )
    return matrix
