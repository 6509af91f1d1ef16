"""Who runs which chain: rank 0 deals them out while it runs some itself, a free rank asks for more.

All that is sent goes between rank 0 and one other, from the main thread of each; chains are in
threads and know nothing of it. What a chain draws depends on its model and its number alone, so
that it does not matter where and when it runs.

Nobody leaves before rank 0 has said that all is over, which is its last message: so all ranks hear
of an error of any of them, and no message is left for who uses the communicator next. Interrupts
are for rank 0 to heed.
"""

import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import NamedTuple

import numpy as np

from pymc_statespace_filters.errors import ParallelError
from pymc_statespace_filters.parallel.communicator import (
    LAST_WORDS_SECONDS,
    Communicator,
    describe_error,
)
from pymc_statespace_filters.parallel.signals import (
    interrupts_left_to_another_rank,
    noticed_interrupts,
)
from pymc_statespace_filters.progress import ChainProgress
from pymc_statespace_filters.sampling.kernel.state import Draws
from pymc_statespace_filters.sampling.run.chain_task import ChainResult, ChainRun
from pymc_statespace_filters.sampling.run.model_task import ModelRun
from pymc_statespace_filters.sampling.run.thread_pool import Crew, Job

# Kinds of messages: to rank 0, ...
_FREE, _PROGRESS, _RESULT, _FAILED, _LEFT = "free", "progress", "result", "failed", "left"
# ... and from it.
_JOB, _NO_MORE, _HALT, _OVER = "job", "no more", "halt", "over"

_ALONE_SECONDS = 0.1
_LISTENING_SECONDS = 0.02
_PROGRESS_SECONDS = 0.25
_ANSWER_SECONDS = 10.0


class Outcome(NamedTuple):
    """All chains of a model, and the seconds from the start of the first to the end of the last."""

    chains: list[ChainResult]
    seconds: float


def run_chains(
    models: Sequence[ModelRun], ranks: Communicator, *, n_threads: int, progressbar: bool | str
) -> "list[Outcome]":
    """Run all chains of all models to their end, or until the user interrupts.

    Parameters
    ----------
    models : sequence of ModelRun
        The same on all ranks, prepared on rank 0. They have the same numbers of iterations.
    ranks : Ranks
    n_threads : int
        Chains that this rank runs at a time.
    progressbar : bool or str
        As in ``pm.sample``; shown by rank 0.

    Returns
    -------
    list of Outcome
        One for each model; empty on all ranks but rank 0. After an interruption (Ctrl-C) some
        chains have made fewer iterations, or none.

    Raises
    ------
    Exception
        What a model raised on this rank, with a note that names the chain.
    ParallelError
        If it raised on another rank; the chains of this one are halted.
    """
    with Crew(n_threads) as crew:
        if ranks.rank > 0:
            with interrupts_left_to_another_rank():
                _Player(models, ranks, crew).play()
            return []
        with _dismissing(ranks):
            dealer = _Dealer(models, ranks, crew, progressbar)
            dealer.deal()
            return dealer.outcomes()


@contextmanager
def _dismissing(ranks: Communicator) -> Iterator[None]:
    """Whatever becomes of rank 0: let the others go in the end."""
    try:
        yield
    except BaseException as error:
        own = f"rank 0 of {ranks.size} has stopped the run: {describe_error(error)}"
        _tell_all(ranks, _OVER, str(error) if isinstance(error, ParallelError) else own)
        raise
    _tell_all(ranks, _OVER)


def _tell_all(ranks: Communicator, kind: str, value: str | None = None) -> None:
    for rank in range(1, ranks.size):
        ranks.send(rank, kind, value)


class _Dealer:
    """Rank 0."""

    def __init__(
        self, models: Sequence[ModelRun], ranks: Communicator, crew: Crew, progressbar: bool | str
    ):
        self._models, self._ranks, self._crew = models, ranks, crew
        self._places = {
            Job(i, chain): place
            for place, (i, chain) in enumerate(
                (i, chain) for i, model in enumerate(models) for chain in range(model.n_chains)
            )
        }
        costs = [model.cost() if len(models) > 1 else 0.0 for model in models]
        # The longest first, so that none is left over when all others have ended.
        self._waiting = deque(sorted(self._places, key=lambda job: -costs[job.model]))
        self._results: dict[Job, ChainResult] = {}
        self._began: dict[int, float] = {}
        self._ended: dict[int, float] = {}
        self._others = set(range(1, ranks.size))
        asked = models[0].asked
        self._bars = ChainProgress(len(self._places), asked.draws, asked.tune, progressbar)

    def deal(self) -> None:
        """Have all chains run, here and elsewhere."""
        with noticed_interrupts() as interrupted:
            with self._bars, suppress(KeyboardInterrupt):
                while len(self._results) < len(self._places) and not interrupted.is_set():
                    self._go_on()
            self._crew.halt()
            for job, run in self._crew.at_work.items():
                self._keep(job, run.result())
            self._waiting.clear()
            if len(self._results) < len(self._places):
                _tell_all(self._ranks, _HALT)
            while self._others:
                time.sleep(_LISTENING_SECONDS)
                self._listen()

    def outcomes(self) -> list[Outcome]:
        """By model and chain; of a chain that never ran, what its checkpoint holds."""
        seconds = [
            self._ended.get(i, 0.0) - self._began.get(i, 0.0) for i in range(len(self._models))
        ]
        for i, model in enumerate(self._models):
            for chain in range(model.n_chains):
                if Job(i, chain) not in self._results:
                    self._results[Job(i, chain)] = model.chain(chain).result()
        results = [
            [self._results.pop(Job(i, chain)) for chain in range(model.n_chains)]
            for i, model in enumerate(self._models)
        ]
        return [Outcome(*pair) for pair in zip(results, seconds, strict=True)]

    def _next(self) -> Job | None:
        """The chain that is dealt next."""
        if not self._waiting:
            return None
        job = self._waiting.popleft()
        self._began.setdefault(job.model, time.monotonic())
        self._bars.begin(self._places[job])
        return job

    def _keep(self, job: Job, result: ChainResult) -> None:
        self._results[job] = result
        self._ended[job.model] = time.monotonic()

    def _go_on(self) -> None:
        while self._crew.has_room and (job := self._next()) is not None:
            self._crew.start(job, self._models[job.model].chain(job.chain))
        seconds = _LISTENING_SECONDS if self._others else _ALONE_SECONDS
        for job, run in self._crew.ended(seconds):
            self._show(job, run)
            self._keep(job, run.result())
        for job, run in self._crew.at_work.items():
            self._show(job, run)
        self._listen()

    def _show(self, job: Job, run: ChainRun) -> None:
        if run.done > 0:
            self._bars.update(self._places[job], run.done, run.progress(), run.seconds)

    def _listen(self) -> None:
        """Take in what the others say."""
        while (message := self._ranks.receive()) is not None:
            source, kind, value = message
            if kind == _FREE:
                job = self._next()
                self._ranks.send(source, _NO_MORE if job is None else _JOB, job)
            elif kind == _PROGRESS:
                for job, done, stats, seconds in value:
                    self._bars.update(self._places[job], done, stats, seconds)
            elif kind == _RESULT:
                job, outlines, *rest = value
                draws = Draws(**{name: np.empty(*outline) for name, outline in outlines.items()})
                self._ranks.receive_arrays(source, draws)
                self._keep(job, ChainResult(draws, *rest))
            elif kind == _LEFT:
                self._others.discard(source)
            elif kind == _FAILED:
                self._others.discard(source)
                raise ParallelError(
                    f"rank {source} of {self._ranks.size} has stopped the run: {value}"
                )


class _StoppedByOthers(Exception):
    """Another rank has failed; the text says which and why."""


class _Player:
    """Any other rank."""

    def __init__(self, models: Sequence[ModelRun], ranks: Communicator, crew: Crew):
        self._models, self._ranks, self._crew = models, ranks, crew
        self._there_is_more = True
        self._has_asked = self._has_left = self._is_over = False
        self._reported_at = time.monotonic()

    def play(self) -> None:
        """Run what is dealt, until all is over."""
        try:
            while not self._is_over:
                self._go_on()
                if not (self._there_is_more or self._crew.at_work or self._has_left):
                    self._ranks.send(0, _LEFT)
                    self._has_left = True
        except _StoppedByOthers as stopped:
            self._crew.halt()
            time.sleep(LAST_WORDS_SECONDS)
            raise ParallelError(str(stopped)) from None
        except BaseException as error:
            self._crew.halt()
            self._ranks.send(0, _FAILED, describe_error(error))
            self._wait_for_answer()
            error.add_note(f"on rank {self._ranks.rank} of {self._ranks.size}")
            raise

    def _go_on(self) -> None:
        if self._there_is_more and not self._has_asked and self._crew.has_room:
            self._ranks.send(0, _FREE)
            self._has_asked = True
        for job, run in self._crew.ended(_LISTENING_SECONDS):
            self._report({job: run})
            self._hand_in(job, run)
        if time.monotonic() - self._reported_at > _PROGRESS_SECONDS:
            self._report(self._crew.at_work)
            self._reported_at = time.monotonic()
        while (message := self._ranks.receive()) is not None:
            self._obey(message.kind, message.value)

    def _obey(self, kind: str, value: Job | str | None) -> None:
        if kind == _JOB and isinstance(value, Job):
            self._has_asked = False
            self._crew.start(value, self._models[value.model].chain(value.chain))
        elif kind == _NO_MORE:
            self._there_is_more = False
        elif kind == _OVER and value is not None:
            raise _StoppedByOthers(value)
        elif kind == _OVER:
            self._is_over = True
        elif kind == _HALT:  # the user's wish
            self._there_is_more = False
            self._crew.halt()
            while self._crew.at_work:
                self._hand_in(*self._crew.at_work.popitem())

    def _report(self, runs: dict[Job, ChainRun]) -> None:
        shown = [
            (job, run.done, run.progress(), run.seconds)
            for job, run in runs.items()
            if run.done > 0
        ]
        if shown:
            self._ranks.send(0, _PROGRESS, shown)

    def _hand_in(self, job: Job, run: ChainRun) -> None:
        result = run.result()
        outlines = {name: (a.shape, a.dtype.str) for name, a in result.draws._asdict().items()}
        self._ranks.send(0, _RESULT, (job, outlines, *result[1:]))
        self._ranks.send_arrays(0, result.draws)

    def _wait_for_answer(self) -> None:
        """Stay until rank 0 knows: whoever ends first ends the whole job."""
        until = time.monotonic() + _ANSWER_SECONDS
        while time.monotonic() < until:
            message = self._ranks.receive()
            if message is not None and message.kind == _OVER:
                return
            time.sleep(_LISTENING_SECONDS)
