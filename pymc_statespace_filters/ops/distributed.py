"""The log-likelihood of a record, by the filter or by a Python function in its place.

For what machine code cannot do alone: several processes evaluate together, and talk to each other.
Who evaluates is an argument, so that the machine code around is the same in both cases, and so are
its numbers, to the bit.
"""

import ctypes
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction, jit
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.compiler.native.entry_point import call_address
from pymc_statespace_filters.ops.base import HEALTH_SIZE, RECORD_INPUTS
from pymc_statespace_filters.ops.likelihood import LogLikelihood

Evaluate = Callable[..., tuple[np.ndarray, np.ndarray]]

_DELEGATE = (("number", "int64", 0), ("delegate", "int64", 0))


class CallbackLogLikelihood(LogLikelihood):
    """`LogLikelihood` by the filter or, where its address is not 0, by a `PythonCallback`.

    Two inputs more: a ``number``, by which the delegate knows the record, and the address.
    """

    input_types: ClassVar[tuple[tuple[str, str, int], ...]] = (*RECORD_INPUTS, *_DELEGATE)
    gufunc_signature = "(k),(j),(j,p),(s,u),(),(),(),()->(j),(h)"
    argument_code: ClassVar[Mapping[str, str]] = {"seed": "seed.item(), no_normals.copy()"}

    def compile(self) -> CompiledFunction:
        """The filter's machine code and the call."""
        of_filter = super().compile()
        by_filter = of_filter.function

        @jit
        def run(theta, steps, observed, inputs, t0, seed, normals, number, delegate):
            if delegate == 0:
                return by_filter(theta, steps, observed, inputs, t0, (seed, normals))
            sizes = np.empty(6, np.int64)
            sizes[0], sizes[1] = theta.size, steps.size
            sizes[2], sizes[3] = observed.shape
            sizes[4], sizes[5] = inputs.shape
            terms, health = np.empty(steps.size), np.empty(HEALTH_SIZE)
            raised = np.zeros(1, np.int64)
            call_address(
                delegate,
                (number, theta, steps, observed, inputs, t0, seed, sizes, terms, health, raised),
            )
            if raised[0]:
                raise RuntimeError("the delegate of a likelihood raised an error")
            return terms, health

        return CompiledFunction(run, key_of("by the filter or a delegate", of_filter.key))


class CallbackLogLikelihoodOfNoise(CallbackLogLikelihood):
    """The same with a vector of `StoredNoise` that is read in place of the seed, or is empty.

    A delegate is given the seed alone.
    """

    input_types = (*RECORD_INPUTS, ("normals", "float64", 1), *_DELEGATE)
    gufunc_signature = "(k),(j),(j,p),(s,u),(),(),(z),(),()->(j),(h)"
    # Not copied: they are many.
    argument_code: ClassVar[Mapping[str, str]] = {"normals": "np.ascontiguousarray(normals)"}


class PythonCallback:
    """A Python function that evaluates likelihoods for machine code.

    Parameters
    ----------
    evaluate : callable
        ``(number, theta, steps, observed, inputs, t0, seed) -> (terms, health)``. It is given
        copies.

    Attributes
    ----------
    address : ndarray of int64, shape ()
        Where machine code finds it, while this object lives and no longer.
    error : Exception or None
        What the function raised. It is called no more from then on, and every evaluation raises.
    """

    def __init__(self, evaluate: Evaluate):
        self._evaluate = evaluate
        self.error: BaseException | None = None
        pointer, number, real = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
        signature = ctypes.CFUNCTYPE(None, number, *[pointer] * 4, real, number, *[pointer] * 4)
        self._callback = signature(self._called)
        address = ctypes.cast(self._callback, pointer).value
        self.address = np.array(address, dtype=np.int64)

    def _called(
        self,
        number: int,
        theta: int,
        steps: int,
        observed: int,
        inputs: int,
        t0: float,
        seed: int,
        sizes: int,
        terms: int,
        health: int,
        raised: int,
    ) -> None:
        # An exception cannot pass through machine code.
        try:
            if self.error is None:
                n_theta, n_steps, *shapes = _copied(sizes, (6,), np.int64).tolist()
                values = self._evaluate(
                    number,
                    _copied(theta, (n_theta,)),
                    _copied(steps, (n_steps,), np.int64),
                    _copied(observed, shapes[:2]),
                    _copied(inputs, shapes[2:]),
                    t0,
                    seed,
                )
                for address, value in zip((terms, health), values, strict=True):
                    _write(address, value)
        except BaseException as error:
            self.error = error
        ctypes.c_int64.from_address(raised).value = self.error is not None


def _copied(address: int, shape: Sequence[int], dtype: Any = np.float64) -> np.ndarray:
    values = np.empty(shape, dtype)
    ctypes.memmove(values.ctypes.data, address, values.nbytes)
    return values


def _write(address: int, values: np.ndarray) -> None:
    numbers = np.ascontiguousarray(values, dtype=np.float64)
    ctypes.memmove(address, numbers.ctypes.data, numbers.nbytes)
