"""Log-likelihoods that several ranks evaluate together.

`DistributedLogLikelihood` is called by all ranks at once. Where several ranks evaluate one chain,
one of them runs the sampler: there the log-likelihood is a `CallbackLogLikelihood`, which calls a
Python function, a `PythonCallback`, that makes all ranks evaluate. The address of the callback is
an argument, so that the surrounding machine code, and every bit of its numbers, are the same
with and without it.
"""

import ctypes
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction, jit
from pymc_statespace_filters.compiler.lowering.compiled_system import CompiledSystem
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.compiler.native.entry_point import call_address
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.protocol import EnsembleFilter, Filter
from pymc_statespace_filters.filters.recommendation import short_form
from pymc_statespace_filters.ops.base import HEALTH_SIZE, RECORD_INPUTS, evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from pymc_statespace_filters.parallel.communicator import Communicator
from pymc_statespace_filters.system.model import StateSpaceModel

Evaluate = Callable[..., tuple[np.ndarray, np.ndarray]]

_CALLBACK = (("number", "int64", 0), ("callback", "int64", 0))


class DistributedLogLikelihood(LogLikelihood):
    """`LogLikelihood` of an ensemble, called by all ranks at once; the same numbers on each.

    Three more inputs: ``rank``, ``n_ranks``, and the address of their ``exchange``.
    """

    filter: EnsembleFilter
    input_types = (
        *RECORD_INPUTS, ("rank", "int64", 0), ("n_ranks", "int64", 0), ("exchange", "int64", 0),
    )  # fmt: skip
    gufunc_signature = "(k),(j),(j,p),(s,u),(),(),(),(),()->(j),(h)"
    argument_code: ClassVar[Mapping[str, str]] = {}
    is_collective = True

    def compile(self, system: CompiledSystem) -> CompiledFunction:
        """The filter's log-likelihood for the members of one rank."""
        return self.filter.compile_distributed(system)


def distributed_evaluator(system: StateSpaceModel, filter: Filter, comm: Communicator) -> Callable:
    """The function (theta, steps, observed, inputs, t0, seed) -> (terms, health) of all ranks.

    All ranks call it with the same arguments. Each moves its local members, and all get the same
    result, bit for bit that of one rank.
    """
    check_ranks(filter, comm.size)
    if comm.size == 1:
        return evaluator(LogLikelihood(system, filter))
    evaluate = evaluator(DistributedLogLikelihood(system, filter))

    def evaluate_together(*record: Any) -> tuple[np.ndarray, np.ndarray]:
        results = evaluate(*record, comm.rank, comm.size, comm.exchange)
        comm.check_exchange()
        return results

    return evaluate_together


def check_ranks(filter: Filter, n_ranks: int) -> None:
    """Raise unless a filter has members for so many ranks."""
    if n_ranks == 1:
        return
    if not isinstance(filter, EnsembleFilter):
        raise ModelError(
            f"{short_form(filter)} has no members to distribute over {n_ranks} ranks; take one "
            f"rank for each evaluation, or a filter with particles or members"
        )
    if n_ranks > (most := filter.max_ranks()):
        raise ModelError(
            f"{short_form(filter)} has members for {most} of {n_ranks} ranks only: a rank takes "
            f"whole blocks of 64 members"
        )


class CallbackLogLikelihood(LogLikelihood):
    """`LogLikelihood` by the filter or, if its address is not 0, by a `PythonCallback`.

    Two more inputs: a ``number``, by which the callback identifies the record, and its address.
    """

    input_types: ClassVar[tuple[tuple[str, str, int], ...]] = (*RECORD_INPUTS, *_CALLBACK)
    gufunc_signature = "(k),(j),(j,p),(s,u),(),(),(),()->(j),(h)"
    argument_code: ClassVar[Mapping[str, str]] = {"seed": "seed.item(), no_normals.copy()"}

    def compile(self, system: CompiledSystem) -> CompiledFunction:
        """The filter's log-likelihood and the call."""
        of_filter = super().compile(system)
        by_filter = of_filter.function

        @jit
        def run(theta, steps, observed, inputs, t0, seed, normals, number, callback):
            if callback == 0:
                return by_filter(theta, steps, observed, inputs, t0, (seed, normals))
            sizes = np.empty(6, np.int64)
            sizes[0], sizes[1] = theta.size, steps.size
            sizes[2], sizes[3] = observed.shape
            sizes[4], sizes[5] = inputs.shape
            terms, health = np.empty(steps.size), np.empty(HEALTH_SIZE)
            raised = np.zeros(1, np.int64)
            call_address(
                callback,
                (number, theta, steps, observed, inputs, t0, seed, sizes, terms, health, raised),
            )
            if raised[0]:
                raise RuntimeError("the callback of a likelihood raised an error")
            return terms, health

        return CompiledFunction(run, key_of("by the filter or a callback", of_filter.key))


class CallbackLogLikelihoodOfNoise(CallbackLogLikelihood):
    """The same with a vector of `StoredNoise`, which replaces the seed unless it is empty.

    The callback receives the seed only.
    """

    input_types = (*RECORD_INPUTS, ("normals", "float64", 1), *_CALLBACK)
    gufunc_signature = "(k),(j),(j,p),(s,u),(),(),(z),(),()->(j),(h)"
    # Not copied: there may be millions.
    argument_code: ClassVar[Mapping[str, str]] = {"normals": "np.ascontiguousarray(normals)"}


class PythonCallback:
    """A Python function that evaluates likelihoods for machine code.

    ``evaluate(number, theta, steps, observed, inputs, t0, seed)`` receives copies and returns terms
    and health. Machine code calls it at ``address``, which is valid while this object lives. What
    it raises is stored in ``error``; from then on it is not called, and every evaluation raises.
    """

    def __init__(self, evaluate: Evaluate):
        self._evaluate = evaluate
        self.error: BaseException | None = None
        pointer, number, real = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
        signature = ctypes.CFUNCTYPE(None, number, *[pointer] * 4, real, number, *[pointer] * 4)
        self._callback = signature(self._called)
        address = ctypes.cast(self._callback, pointer).value
        self.address = np.array(address, dtype=np.int64)

    def _called(self, number: int, *arguments: Any) -> None:
        theta, steps, observed, inputs, t0, seed, sizes, terms, health, raised = arguments
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
