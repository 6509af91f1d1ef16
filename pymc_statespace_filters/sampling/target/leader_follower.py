"""Several ranks that evaluate a chain's likelihoods together: one leads, the others follow.

The leader runs the chain. For a noisy likelihood its machine code calls the leader's callback,
which sends parameters and seed to the followers; then all of them run the filter, each on its local
particles. The leader alone evaluates the rest of the log-density and makes all decisions of the
chain, so that ranks cannot disagree.
"""

import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from pymc.model import Model

from ...errors import ModelError, ParallelError
from ...ops.distributed import PythonCallback, check_ranks, distributed_evaluator
from ...parallel.communicator import ABORT_GRACE_SECONDS, Communicator, Message, describe_error
from ...parallel.signals import deferred_interrupts, held_interrupts, ignored_interrupts
from ...pymc_model.inspection import noisy_filters, panel_variables
from .settings import RandomWalkSettings

# Messages of the leader: a likelihood with its record, an evaluation of it, the end.
_RECORD, _EVALUATE, _END = "record", "evaluate", "end"
# Answers of the followers to the first and to the last.
_READY, _FAILED, _ACKNOWLEDGED = "ready", "failed", "acknowledged"

# A follower polls without a pause for so long, and then, between chains, once in a millisecond:
# polling takes a core, sleeping delays each evaluation.
_BUSY_SECONDS = 0.02
_POLL_SECONDS = 0.001
# A rank that has not answered by then is in an evaluation that will never end.
_ANSWER_SECONDS = 10.0

_leader_numbers = count()


class _RecordArrays(NamedTuple):
    """The arrays of a record that the filters read."""

    steps: np.ndarray
    observed: np.ndarray
    inputs: np.ndarray
    t0: float


def check_group(model: Model, settings: RandomWalkSettings, n_ranks: int) -> None:
    """Check that several ranks can evaluate a model's likelihoods together.

    Raises `ModelError` if there is no noisy likelihood, its filter has fewer blocks of particles
    than there are ranks, or the noise is correlated.
    """
    if settings.correlation is not None:
        raise ModelError(
            f"per_chain of comm must be 1 with correlation={settings.correlation!r}, got "
            f"{n_ranks}: correlated noise is carried by one rank"
        )
    filters = noisy_filters(model)
    if not filters:
        raise ModelError(
            "per_chain of comm must be 1 for a model without a StateSpace variable whose "
            f"filter has particles, got {n_ranks}"
        )
    if panels := [name for name in filters if name in panel_variables(model)]:
        raise ModelError(
            f"per_chain of comm must be 1 for the panel {panels[0]!r}, got {n_ranks}: "
            "every rank evaluates all records of its chains"
        )
    for filter in filters.values():
        check_ranks(filter, n_ranks)


class Leader:
    """The rank of a group that runs its chains; the other ranks call `follow`.

    The likelihoods, pairs of a system and a filter, are identified by their index in the sequence,
    see `graph_rewrites.with_likelihood_callback`.
    """

    def __init__(self, comm: Communicator, likelihoods: Sequence[tuple[Any, Any]]):
        self._comm = comm
        self._name = next(_leader_numbers)  # a group may have a leader for each model
        self._likelihoods = likelihoods
        self._evaluators = [distributed_evaluator(*likelihood, comm) for likelihood in likelihoods]
        self._sent: dict[int, bytes] = {}
        self._callback = PythonCallback(self._evaluate)

    @property
    def address(self) -> np.ndarray:
        """Address of the callback, shape ()."""
        return self._callback.address

    @property
    def error(self) -> BaseException | None:
        """Error of an evaluation, after which there are no further evaluations."""
        return self._callback.error

    def _evaluate(
        self,
        number: int,
        theta: np.ndarray,
        steps: np.ndarray,
        observed: np.ndarray,
        inputs: np.ndarray,
        t0: float,
        seed: int,
    ) -> tuple[np.ndarray, np.ndarray]:
        record = _RecordArrays(steps, observed, inputs, t0)
        content = pickle.dumps(record)
        if self._sent.get(number) != content:  # once, unless it depends on sampled variables
            self._send_record(number, record)
            self._sent[number] = content
        with deferred_interrupts() as interrupted:  # the followers wait in every allgather
            self._comm.send_to_others(_EVALUATE, ((self._name, number), theta, seed))
            values = self._evaluators[number](theta, *record, seed)
        if interrupted.is_set():
            raise KeyboardInterrupt
        return values

    def _send_record(self, number: int, record: _RecordArrays) -> None:
        """Send the followers a likelihood and its record, and wait for the answers of all."""
        likelihood = (self._name, number), *self._likelihoods[number], record
        self._comm.send_to_others(_RECORD, likelihood)
        answers = [_receive(self._comm) for _ in range(1, self._comm.size)]
        for answer in answers:
            if answer.kind == _FAILED:
                raise ParallelError(
                    f"rank {answer.source} of the {self._comm.size} that run a chain together "
                    f"cannot evaluate its likelihood: {answer.value}"
                )


@contextmanager
def leader_errors(leader: Leader) -> Iterator[None]:
    """Raise the error of the leader's callback instead of the machine code's report of one.

    An interrupt, which would be lost in the callback, comes at the end.
    """
    with held_interrupts():
        try:
            yield
        except Exception:
            if leader.error is not None:
                raise leader.error from None
            raise


@contextmanager
def release_followers(comm: Communicator) -> Iterator[None]:
    """Release the followers at the end, also after an error on the leader, the first rank."""
    try:
        yield
    except BaseException as error:
        comm.send_to_others(_END, f"the leader of the chain has stopped: {describe_error(error)}")
        if not _is_acknowledged(comm):
            comm.abort(error)
        raise
    comm.send_to_others(_END)


def follow(comm: Communicator) -> None:
    """Take part in the evaluations of the leader, rank 0 of the group, until it sends the end.

    Raises `ParallelError` if the leader was stopped by an error, and what an evaluation raised
    here, which ends the whole job, as the others wait for this rank.
    """
    failure = None
    evaluators: dict[Any, tuple[Callable, _RecordArrays]] = {}
    with ignored_interrupts():
        while (message := _receive(comm)).kind != _END:
            if message.kind == _EVALUATE:
                name, theta, seed = message.value
                evaluate, record = evaluators[name]
                _evaluate_or_abort(comm, evaluate, theta, *record, seed)
                continue
            name, system, filter, record = message.value
            try:
                evaluators[name] = distributed_evaluator(system, filter, comm), record
                comm.send(message.source, _READY)
            except Exception as error:
                failure = error
                comm.send(message.source, _FAILED, describe_error(error))
    if message.value is None:
        return
    comm.send(message.source, _ACKNOWLEDGED)
    if failure is not None:
        raise failure
    time.sleep(ABORT_GRACE_SECONDS)
    raise ParallelError(message.value)


def _evaluate_or_abort(comm: Communicator, evaluate: Callable, *arguments: Any) -> None:
    try:
        evaluate(*arguments)
    except BaseException as error:
        error.add_note(f"on rank {comm.rank} of the {comm.size} that run a chain together")
        comm.abort(error)
        raise


def _is_acknowledged(comm: Communicator) -> bool:
    """Wait until all followers have acknowledged the end; False if they do not."""
    until = time.monotonic() + _ANSWER_SECONDS
    missing = comm.size - 1
    while missing and time.monotonic() < until:
        message = comm.receive()
        missing -= message is not None and message.kind == _ACKNOWLEDGED
        time.sleep(0.0 if message else _POLL_SECONDS)
    return not missing


def _receive(comm: Communicator) -> Message:
    """Wait for a message."""
    began = time.monotonic()
    while (message := comm.receive()) is None:
        time.sleep(_POLL_SECONDS if time.monotonic() - began > _BUSY_SECONDS else 0.0)
    return message
