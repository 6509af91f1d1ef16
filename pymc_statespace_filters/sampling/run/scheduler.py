"""Scheduling of chains over ranks: rank 0 manages them and runs some, the others ask for work.

All messages go between rank 0 and one other rank, from the main thread of each; chains run in
threads and send nothing. Rank 0 alone reads and writes checkpoints: with a chain it sends what is
stored of it, and it is sent what a chain has to store. A chain's draws depend on its model and
number alone, not on the rank that runs it.

Chains end more than once: after each part of the warm-up, and with ``until_ess``. Rank 0 waits for
all chains of a model, fits the mixture that they draw proposals from, and lets them go on, each on
the rank where it ran, or ends the model. What it decides depends on the draws alone.

The last message of rank 0 says that the run is over, and no rank leaves before it. So every rank
learns of an error on any other, and no message is left for the next user of the communicator.
Interrupts are handled by rank 0. The progress bar shows R-hat and the effective sample size.
"""

import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np

from ...errors import ParallelError
from ...parallel.communicator import Communicator, describe_error
from ...parallel.signals import ignored_interrupts, interrupts_are_noted, takes_interrupt
from ..checkpoint.arrays import encoded
from ..kernel.state import ChainState, Draws
from ..output.chain_bars import ChainProgress
from .chain_task import ChainTask
from .model_task import ModelTask, key_of_chain
from .thread_pool import ChainPool
from .worker import LISTENING_SECONDS, Kind, Worker, place_of

_ALONE_SECONDS = 0.1
_MOST_BYTES = 2**28  # of one message

# Seconds between two computations, and the part of the time that they may take.
_SECONDS, _SHARE = 2.0, 0.01


def run_chains(
    tasks: Sequence[ModelTask], comm: Communicator, *, n_threads: int, progressbar: bool | str
) -> None:
    """Run all chains of all models to their end, or until the user interrupts.

    The tasks are the same on all ranks, with the same request, and prepared on rank 0, to whose
    tasks the results are added. After an interruption (Ctrl-C) some chains have made fewer
    iterations, or none. This rank runs ``n_threads`` chains at a time; rank 0 shows the progress.
    Raises what a model raised on this rank, with a note that names the chain; `ParallelError` if it
    raised on another rank, after the chains of this one were stopped.
    """
    with ChainPool(n_threads) as pool:
        if comm.rank > 0:
            with ignored_interrupts():
                Worker(tasks, comm, pool).run()
            return
        with _release_workers(comm):
            _Manager(tasks, comm, pool, progressbar).run()


@contextmanager
def _release_workers(comm: Communicator) -> Iterator[None]:
    """Send the other ranks the last message, also after an error on rank 0."""
    try:
        yield
    except BaseException as error:
        message = f"rank 0 of {comm.size} has stopped the run: {describe_error(error)}"
        comm.send_to_others(Kind.OVER, str(error) if isinstance(error, ParallelError) else message)
        raise
    comm.send_to_others(Kind.OVER)


class _Manager:
    """Rank 0."""

    def __init__(
        self,
        tasks: Sequence[ModelTask],
        comm: Communicator,
        pool: ChainPool,
        progressbar: bool | str,
    ):
        self._tasks, self._comm, self._pool = tasks, comm, pool
        self._n_per_model = tasks[0].request.chains
        costs = [task.cost() if len(tasks) > 1 else 0.0 for task in tasks]
        self._n_unfinished = self._n_per_model * len(tasks)
        self._is_stopping = False
        self._rank_of: dict[int, int] = {}  # other ranks, by the chains that ended there
        # The longest first, so that none runs alone at the end.
        self._schedule = deque(
            sorted(range(self._n_unfinished), key=lambda i: -costs[i // self._n_per_model])
        )
        self._workers = set(range(1, comm.size))
        request = tasks[0].request
        n_draws = request.n_iterations - request.tune
        self._bars = ChainProgress(self._n_unfinished, n_draws, request.tune, progressbar)
        self._display = ConvergenceDisplay(self._bars, self._n_per_model)

    def run(self) -> None:
        """Run all chains, on this rank and the others."""
        interrupts_are_noted()
        with self._bars:
            while self._n_unfinished and not takes_interrupt():
                self._continue()
        self._is_stopping = True
        self._pool.stop()
        for number, task in self._pool.running.items():
            self._add_result(number, *task.result())
        self._schedule.clear()
        if self._n_unfinished:
            self._comm.send_to_others(Kind.STOP)
        while self._workers:
            time.sleep(LISTENING_SECONDS)
            self._receive()
        for model_task in self._tasks:
            model_task.load_missing_results()

    def _next(self) -> int | None:
        """The chain that is to run next."""
        if not self._schedule:
            return None
        number = self._schedule.popleft()
        self._tasks[number // self._n_per_model].start_clock()
        return number

    def _add_result(self, number: int, draws: Draws, state: ChainState) -> None:
        model, chain = divmod(number, self._n_per_model)
        task = self._tasks[model]
        task.add_result(chain, draws, state)
        if task.is_complete and not self._is_stopping:
            self._display.show(model, task, {})
            self._go_on_or_end(model, task)

    def _go_on_or_end(self, model: int, task: ModelTask) -> None:
        """Let all chains of a model make more draws, or none of them."""
        goal = (task.n_iterations, task.thin, task.mixture) if task.extend() else None
        if goal is None:
            self._n_unfinished -= self._n_per_model
        for number in range(model * self._n_per_model, (model + 1) * self._n_per_model):
            if goal is not None:
                self._bars.extend(number, task.n_iterations)
            if number in self._rank_of:
                self._comm.send(self._rank_of[number], Kind.GO_ON, (number, goal))
            else:
                self._pool.go_on(number, goal)

    def _continue(self) -> None:
        while self._pool.is_idle and (number := self._next()) is not None:
            model_task, chain = place_of(self._tasks, number)
            self._pool.start(number, model_task.chain_task(chain))
        seconds = LISTENING_SECONDS if self._workers else _ALONE_SECONDS
        for number, task in self._pool.finished(seconds):
            self._show(number, task)
            self._pool.ended[number] = task
            self._add_result(number, *task.result())
        for number, task in self._pool.running.items():
            self._show(number, task)
        self._display.refresh(self._tasks, self._pool.running)
        self._receive()

    def _show(self, number: int, task: ChainTask) -> None:
        if task.n_done > 0:
            self._bars.update(number, task.n_done, task.progress(), task.seconds)

    def _receive(self) -> None:
        """Handle the messages of the workers."""
        while (message := self._comm.receive()) is not None:
            source, kind, value = message
            if kind == Kind.IDLE:
                self._send_chain(source)
            elif kind == Kind.PROGRESS:
                for progress in value:
                    self._bars.update(*progress)
            elif kind == Kind.RECORD:
                number, content = value
                task, _ = place_of(self._tasks, number)
                if task.checkpoint is not None:
                    task.checkpoint.append_encoded(content)
            elif kind == Kind.RESULT:
                number, layout, state = value
                draws = Draws(**{name: np.empty(*of_array) for name, of_array in layout.items()})
                self._comm.receive_arrays(source, draws)
                self._rank_of[number] = source
                self._add_result(number, draws, state)
            elif kind == Kind.LEAVING:
                self._workers.discard(source)
            elif kind == Kind.FAILED:
                self._workers.discard(source)
                raise ParallelError(
                    f"rank {source} of {self._comm.size} has stopped the run: {value}"
                )

    def _send_chain(self, to: int) -> None:
        """Send the chain that is to run next, with what is stored of it; or that there is none."""
        if (number := self._next()) is None:
            self._comm.send(to, Kind.NO_MORE)
            return
        task, chain = place_of(self._tasks, number)
        if task.checkpoint is not None:
            key = key_of_chain(chain)
            if (stored := task.checkpoint.read(key)) is not None:
                content = encoded(key, *stored)
                for begin in range(0, len(content), _MOST_BYTES):
                    self._comm.send(to, Kind.STORED, content[begin : begin + _MOST_BYTES])
        self._comm.send(to, Kind.CHAIN, (number, task.checkpoint is not None))


class ConvergenceDisplay:
    """Computes the diagnostics of each model that runs, and shows them below the bars.

    They are those of the chains whose draws are on this rank: of those that run here, and of those
    that have ended anywhere. Without a bar nothing is computed. A model has so many ``chains``,
    numbered through all models.
    """

    def __init__(self, bars: ChainProgress, chains: int):
        self._bars, self._n_per_model = bars, chains
        self._next = time.monotonic() + _SECONDS

    def refresh(self, tasks: Sequence[ModelTask], running: Mapping[int, ChainTask]) -> None:
        """Show the diagnostics of the models of running chains, if it is time to."""
        began = time.monotonic()
        if not self._bars.shows_convergence or began < self._next:
            return
        by_model: dict[int, dict[int, ChainTask]] = {}
        for number, task in running.items():
            model, chain = divmod(number, self._n_per_model)
            by_model.setdefault(model, {})[chain] = task
        for model, chains in by_model.items():
            self.show(model, tasks[model], chains)
        now = time.monotonic()
        self._next = now + max(_SECONDS, (now - began) / _SHARE)

    def show(self, model: int, task: ModelTask, running: Mapping[int, ChainTask]) -> None:
        """Show the diagnostics of a model, of its results and of chains that run here."""
        if not self._bars.shows_convergence:
            return
        found = task.convergence_so_far(running)
        if found is not None:
            self._bars.show_convergence(model, float(found.rhat.max()), float(found.ess.min()))
