"""Any rank but the first: it runs the chains that the first one assigns; see `scheduler`."""

import time
from collections.abc import Mapping, Sequence
from enum import StrEnum, auto
from queue import SimpleQueue
from typing import Any

from ...errors import ParallelError
from ...parallel.communicator import ABORT_GRACE_SECONDS, Communicator, describe_error
from ..checkpoint.arrays import Arrays, decoded, encoded, joined
from .chain_task import ChainTask
from .model_task import ModelTask, key_of_chain
from .thread_pool import ChainPool

LISTENING_SECONDS = 0.02
_PROGRESS_SECONDS = 0.25
_ANSWER_SECONDS = 10.0


class Kind(StrEnum):
    """Kinds of messages between rank 0 and another one."""

    # To rank 0, ...
    IDLE = auto()
    PROGRESS = auto()
    RECORD = auto()  # to be stored
    RESULT = auto()
    FAILED = auto()
    LEAVING = auto()
    # ... and from it.
    STORED = auto()  # a part of what is stored of the next chain
    CHAIN = auto()
    GO_ON = auto()
    NO_MORE = auto()
    STOP = auto()
    OVER = auto()


def place_of(tasks: Sequence[ModelTask], number: int) -> tuple[ModelTask, int]:
    """The model of a chain, and its number there; chains are numbered through all models."""
    model, chain = divmod(number, tasks[0].request.chains)
    return tasks[model], chain


class _StoppedByOthers(Exception):
    """Another rank has failed; the message names it and its error."""


class Worker:
    """Any other rank."""

    def __init__(self, tasks: Sequence[ModelTask], comm: Communicator, pool: ChainPool):
        self._tasks, self._comm, self._pool = tasks, comm, pool
        self._expects_more = True
        self._has_asked = self._has_left = self._is_over = False
        self._stored: list[bytes] = []  # of the next chain
        self._records: SimpleQueue[tuple[int, bytes]] = SimpleQueue()  # to be sent
        self._reported_at = time.monotonic()

    def run(self) -> None:
        """Run the chains that rank 0 assigns, until the run is over."""
        try:
            while not self._is_over:
                self._continue()
                has_chains = self._pool.running or self._pool.ended
                if not (self._expects_more or has_chains or self._has_left):
                    self._comm.send(0, Kind.LEAVING)
                    self._has_left = True
        except _StoppedByOthers as stopped:
            self._pool.stop()
            time.sleep(ABORT_GRACE_SECONDS)
            raise ParallelError(str(stopped)) from None
        except BaseException as error:
            self._pool.stop()
            self._send_records()
            self._comm.send(0, Kind.FAILED, describe_error(error))
            self._wait_for_answer()
            error.add_note(f"on rank {self._comm.rank} of {self._comm.size}")
            raise

    def _continue(self) -> None:
        if self._expects_more and not self._has_asked and self._pool.is_idle:
            self._comm.send(0, Kind.IDLE)
            self._has_asked = True
        finished = self._pool.finished(LISTENING_SECONDS)
        self._send_records()
        for number, task in finished:
            self._report({number: task})
            self._send_result(number, task)
            self._pool.ended[number] = task
        if time.monotonic() - self._reported_at > _PROGRESS_SECONDS:
            self._report(self._pool.running)
            self._reported_at = time.monotonic()
        while (message := self._comm.receive()) is not None:
            self._handle(message.kind, message.value)

    def _handle(self, kind: str, value: Any) -> None:
        if kind == Kind.STORED:
            self._stored.append(value)
        elif kind == Kind.CHAIN:
            self._has_asked = False
            self._start(*value)
        elif kind == Kind.GO_ON:
            self._pool.go_on(*value)
        elif kind == Kind.NO_MORE:
            self._expects_more = False
        elif kind == Kind.OVER and isinstance(value, str):
            raise _StoppedByOthers(value)
        elif kind == Kind.OVER:
            self._is_over = True
        elif kind == Kind.STOP:  # the user has interrupted
            self._expects_more = False
            self._pool.stop()
            self._pool.ended.clear()
            self._send_records()
            while self._pool.running:
                self._send_result(*self._pool.running.popitem())

    def _start(self, number: int, is_kept: bool) -> None:
        """Start a chain from what is stored of it; ``is_kept``: whether to store its draws."""
        task, chain = place_of(self._tasks, number)
        content = b"".join(self._stored)
        stored = joined([decoded(content)[1]]) if content else None
        self._stored.clear()

        def store(draws: Arrays, state: Arrays) -> None:
            self._records.put((number, encoded(key_of_chain(chain), draws, state)))

        self._pool.start(number, task.chain_task(chain, stored, store if is_kept else None))

    def _send_records(self) -> None:
        """Send rank 0 what chains have to store."""
        while not self._records.empty():
            self._comm.send(0, Kind.RECORD, self._records.get())

    def _report(self, tasks: Mapping[int, ChainTask]) -> None:
        progress = [
            (number, task.n_done, task.progress(), task.seconds)
            for number, task in tasks.items()
            if task.n_done > 0
        ]
        if progress:
            self._comm.send(0, Kind.PROGRESS, progress)

    def _send_result(self, number: int, task: ChainTask) -> None:
        draws, state = task.result()
        layout = {name: (a.shape, a.dtype.str) for name, a in draws._asdict().items()}
        self._comm.send(0, Kind.RESULT, (number, layout, state))
        self._comm.send_arrays(0, draws)

    def _wait_for_answer(self) -> None:
        """Wait until rank 0 has received the error: the first rank to end may end the job."""
        until = time.monotonic() + _ANSWER_SECONDS
        while time.monotonic() < until:
            message = self._comm.receive()
            if message is not None and message.kind == Kind.OVER:
                return
            time.sleep(LISTENING_SECONDS)
