"""Log-likelihoods that several ranks evaluate together.

`DistributedLogLikelihood` is called by all ranks at once. Where several ranks evaluate one chain,
one of them runs the sampler: there the log-likelihood is a `CallbackLogLikelihood`, which calls a
Python function, a `PythonCallback`, that makes all ranks evaluate. The address of the callback is
an argument, so that the surrounding machine code, and every bit of its numbers, are the same
with and without it.
"""

import ctypes
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..compiler.native.plan import (
    N_RECORD,
    N_REQUEST,
    N_RESULTS,
    RAISED,
    RECORD,
    REQUEST,
    RESULTS,
    PlanFunction,
)
from ..errors import ModelError
from ..filters.protocol import EnsembleFilter, Filter
from ..filters.written import short_form
from ..parallel.communicator import Communicator
from ..system.model import StateSpaceModel
from .base import evaluator
from .likelihood import LogLikelihood
from .signatures import LIKELIHOOD, SEEDED, Signature

Evaluate = Callable[..., tuple[np.ndarray, np.ndarray]]

_CALLBACK = (("number", 0), ("replacement", 0))


class DistributedLogLikelihood(LogLikelihood):
    """`LogLikelihood` of an ensemble, called by all ranks at once; the same numbers on each.

    Three more inputs: ``rank``, ``n_ranks``, and the address of their ``exchange``.
    """

    filter: EnsembleFilter
    signature = Signature(
        (*SEEDED, ("rank", 0), ("n_ranks", 0), ("exchange", 0)), LIKELIHOOD.results
    )
    is_collective = True


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

    signature = Signature((*SEEDED, *_CALLBACK), LIKELIHOOD.results)


class CallbackLogLikelihoodOfNoise(CallbackLogLikelihood):
    """The same with a vector of `StoredNoise`, which replaces the seed unless it is empty.

    The callback receives the seed only.
    """

    signature = Signature((*SEEDED, ("normals", 1), *_CALLBACK), LIKELIHOOD.results)


class PythonCallback:
    """A Python function that evaluates likelihoods for machine code.

    ``evaluate(number, theta, steps, observed, inputs, t0, seed)`` receives copies and returns terms
    and health. Machine code calls it at ``address`` in place of the function of a plan; it is valid
    while this object lives. What it raises is stored in ``error``; from then on it is not called,
    and every evaluation raises.
    """

    def __init__(self, evaluate: Evaluate):
        self._evaluate = evaluate
        self.error: BaseException | None = None
        self._callback = PlanFunction(self._called)
        address = ctypes.cast(self._callback, ctypes.c_void_p).value
        self.address = np.array(address, dtype=np.int64)

    def _called(self, plan: int, record: int, request: int, results: int) -> int:
        # An exception cannot pass through machine code.
        try:
            if self.error is None:
                given = _copied(record, (N_RECORD,), np.int64)
                asked, to = (
                    _copied(address, (size,), np.int64)
                    for address, size in ((request, N_REQUEST), (results, N_RESULTS))
                )
                observed = given[RECORD.n_observed], given[RECORD.n_observables]
                inputs = given[RECORD.n_input_rows], given[RECORD.n_inputs]
                values = self._evaluate(
                    int(asked[REQUEST.number]),
                    _copied(given[RECORD.theta], (given[RECORD.n_theta],)),
                    _copied(given[RECORD.rows], (given[RECORD.n_rows],), np.int64),
                    _copied(given[RECORD.observed], observed),
                    _copied(given[RECORD.inputs], inputs),
                    float(_copied(given[RECORD.starts], (1,))[0]),
                    int(asked[REQUEST.seed]),
                )
                for address, value in zip(to[[RESULTS.terms, RESULTS.health]], values, strict=True):
                    _write(address, value)
        except BaseException as error:
            self.error = error
        return RAISED if self.error is not None else 0


def _copied(address: int, shape: Sequence[int], dtype: Any = np.float64) -> np.ndarray:
    values = np.empty(shape, dtype)
    ctypes.memmove(values.ctypes.data, int(address), values.nbytes)
    return values


def _write(address: int, values: np.ndarray) -> None:
    numbers = np.ascontiguousarray(values, dtype=np.float64)
    ctypes.memmove(int(address), numbers.ctypes.data, numbers.nbytes)
