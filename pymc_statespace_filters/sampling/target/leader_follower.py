"""Several ranks that evaluate a chain's likelihoods together: one leads, the others follow.

The leader runs the chain. Where its log-density comes to a noisy likelihood, machine code calls the
leader's delegate, which sends parameters and seed to the followers, and then all of them run the
filter, each over its own members. The rest of the log-density, and every decision of the chain, is
the leader's alone: there is nothing on which ranks could come to differ.
"""

import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from pymc.model import Model

from pymc_statespace_filters.errors import ModelError, ParallelError
from pymc_statespace_filters.evaluation.log_likelihood import check_ranks, distributed_evaluator
from pymc_statespace_filters.parallel.communicator import (
    LAST_WORDS_SECONDS,
    Communicator,
    Message,
    describe_error,
)
from pymc_statespace_filters.parallel.signals import (
    interrupts_left_to_another_rank,
    noticed_interrupts,
)
from pymc_statespace_filters.pymc_model.graph_rewrites import PythonCallback
from pymc_statespace_filters.pymc_model.inspection import noisy_filters
from pymc_statespace_filters.sampling.target.settings import DRAMSettings

# What the leader sends: what is to be evaluated, that it is, that all is over.
_RECORD, _EVALUATE, _END = "record", "evaluate", "end"
# What followers answer to the first and to the last.
_READY, _FAILED, _HEARD = "ready", "failed", "heard"

# A follower looks for the next message all the time, but between chains only now and then: looking
# takes a core, sleeping up to a millisecond for each evaluation.
_PATIENCE_SECONDS = 0.02
_NAP_SECONDS = 0.001
# Whoever has not answered by then is in an evaluation that will never end.
_ANSWER_SECONDS = 10.0

_leader_numbers = count()


class _Record(NamedTuple):
    """A record as the filters read it."""

    steps: np.ndarray
    observed: np.ndarray
    inputs: np.ndarray
    t0: float


def check_group(model: Model, settings: DRAMSettings, n_ranks: int) -> None:
    """Check that several ranks can evaluate a model's likelihoods together.

    Raises
    ------
    ModelError
        If there is no noisy likelihood, more ranks than its filter has blocks of members, or the
        noise is moved.
    """
    if settings.correlation is not None:
        raise ModelError(
            f"correlation={settings.correlation!r}: noise is moved by one rank alone, "
            "use ranks_per_chain=1"
        )
    filters = noisy_filters(model)
    if not filters:
        raise ModelError(
            f"ranks_per_chain={n_ranks}: the model has no StateSpace variable whose filter moves "
            "members, so there is nothing to spread over ranks; use ranks_per_chain=1"
        )
    for filter in filters.values():
        check_ranks(filter, n_ranks)


class Leader:
    """The rank of a group that runs its chains.

    Parameters
    ----------
    ranks : Ranks
        The group. The others `follow`.
    likelihoods : sequence of (StateSpaceModel, filter)
        What is evaluated together, by number, see `inspection.delegable_likelihoods`.
    """

    def __init__(self, ranks: Communicator, likelihoods: Sequence[tuple[Any, Any]]):
        self._ranks = ranks
        self._name = next(_leader_numbers)  # a group may have several leaders, one for each model
        self._likelihoods = likelihoods
        self._evaluators = [distributed_evaluator(*of, ranks) for of in likelihoods]
        self._sent: dict[int, bytes] = {}
        self._delegate = PythonCallback(self._evaluate)

    @property
    def address(self) -> np.ndarray:
        """Of the delegate, shape ()."""
        return self._delegate.address

    @property
    def error(self) -> BaseException | None:
        """What was met in an evaluation; there is no other after it."""
        return self._delegate.error

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
        record = _Record(steps, observed, inputs, t0)
        content = pickle.dumps(record)
        if self._sent.get(number) != content:  # once, unless the record is itself sampled
            self._send_record(number, record)
            self._sent[number] = content
        with noticed_interrupts() as interrupted:  # the followers wait in every exchange
            _tell(self._ranks, _EVALUATE, ((self._name, number), theta, seed))
            values = self._evaluators[number](theta, *record, seed)
        if interrupted.is_set():
            raise KeyboardInterrupt
        return values

    def _send_record(self, number: int, record: _Record) -> None:
        """Make the followers ready; they all answer, so that none is waited for in vain."""
        of_all = (self._name, number), *self._likelihoods[number], record
        _tell(self._ranks, _RECORD, of_all)
        answers = [_next(self._ranks) for _ in range(1, self._ranks.size)]
        for answer in answers:
            if answer.kind == _FAILED:
                raise ParallelError(
                    f"rank {answer.source} of the {self._ranks.size} that share a chain cannot "
                    f"evaluate its likelihood: {answer.value}"
                )


@contextmanager
def own_errors(leader: Leader | None) -> Iterator[None]:
    """Raise what a leader met, where machine code only says that there was something."""
    try:
        yield
    except Exception:
        if leader is not None and leader.error is not None:
            raise leader.error from None
        raise


@contextmanager
def leading(ranks: Communicator) -> Iterator[None]:
    """Whatever becomes of the leader, the first of the ranks: let the followers go in the end."""
    try:
        yield
    except BaseException as error:
        _tell(ranks, _END, f"the leader of the chain has stopped: {describe_error(error)}")
        if not _is_heard(ranks):
            ranks.abort(error)
        raise
    _tell(ranks, _END)


def follow(ranks: Communicator) -> None:
    """Evaluate with the leader, rank 0, whatever it comes to, until it says that it is over.

    Parameters
    ----------
    ranks : Ranks
        The group.

    Raises
    ------
    ParallelError
        If the leader was stopped by an error.
    Exception
        What was met here. In the midst of an evaluation that ends the whole job, as the others
        wait for this rank.
    """
    failure = None
    known: dict[Any, tuple[Callable, _Record]] = {}
    with interrupts_left_to_another_rank():
        while (message := _next(ranks)).kind != _END:
            if message.kind == _EVALUATE:
                name, theta, seed = message.value
                evaluate, record = known[name]
                _evaluate_or_abort(ranks, evaluate, theta, *record, seed)
                continue
            name, system, filter, record = message.value
            try:
                known[name] = distributed_evaluator(system, filter, ranks), record
                ranks.send(message.source, _READY)
            except Exception as error:
                failure = error
                ranks.send(message.source, _FAILED, describe_error(error))
    if message.value is None:
        return
    ranks.send(message.source, _HEARD)
    if failure is not None:
        raise failure
    time.sleep(LAST_WORDS_SECONDS)
    raise ParallelError(message.value)


def _evaluate_or_abort(ranks: Communicator, evaluate: Callable, *arguments: Any) -> None:
    try:
        evaluate(*arguments)
    except BaseException as error:
        error.add_note(f"on rank {ranks.rank} of the {ranks.size} that share a chain")
        ranks.abort(error)
        raise


def _is_heard(ranks: Communicator) -> bool:
    """Wait until all followers have heard that it is over; False if they do not."""
    until = time.monotonic() + _ANSWER_SECONDS
    missing = ranks.size - 1
    while missing and time.monotonic() < until:
        message = ranks.receive()
        missing -= message is not None and message.kind == _HEARD
        time.sleep(0.0 if message else _NAP_SECONDS)
    return not missing


def _tell(ranks: Communicator, kind: str, value: Any = None) -> None:
    """Send to all followers."""
    for rank in range(1, ranks.size):
        ranks.send(rank, kind, value)


def _next(ranks: Communicator) -> Message:
    """Wait for a message."""
    began = time.monotonic()
    while (message := ranks.receive()) is None:
        time.sleep(_NAP_SECONDS if time.monotonic() - began > _PATIENCE_SECONDS else 0.0)
    return message
