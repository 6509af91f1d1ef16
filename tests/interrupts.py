"""Ctrl-C by a test, in its own process."""

import contextlib
import os
import signal
import threading

import pytest

from pymc_statespace_filters.sampling.run.chain_task import ChainTask
from pymc_statespace_filters.sampling.run.thread_pool import ChainPool
from tests.waiting import LIMIT, wait_until

MOST = 5


def interrupt():
    """Interrupt this process; on Windows os.kill would end it."""
    if os.name == "nt":
        signal.raise_signal(signal.SIGINT)
    else:
        os.kill(os.getpid(), signal.SIGINT)


def interrupt_chains(monkeypatch, after=1, presses=1):
    """Have a run of chains interrupted when those in its threads have made so many iterations.

    Each waits there until it is to stop, so that nothing depends on which of them is quick. The
    presses beyond the first come when chains have been asked to stop.
    """
    advance, finished, stop = ChainTask._advance, ChainPool.finished, ChainPool.stop
    waiting, stopped = set(), threading.Event()

    def advance_and_wait(task):
        advance(task)
        if task.n_done >= after:
            waiting.add(task)
            stopped.wait(LIMIT)

    def interrupted(pool, *seconds):
        if len(waiting) == min(pool._n_threads, len(pool.running)):
            interrupt()
        return finished(pool, *seconds)

    def stop_all(pool):
        for _ in range(presses - 1):
            interrupt()
        stopped.set()
        stop(pool)

    monkeypatch.setattr(ChainTask, "_advance", advance_and_wait)
    monkeypatch.setattr(ChainPool, "finished", interrupted)
    monkeypatch.setattr(ChainPool, "stop", stop_all)


def repeat_until_interrupted(call, seconds):
    """Repeat a call until an interrupt, sent after so many seconds, ends it; how many it took.

    Python discards what the callback of a weak reference or of the garbage collector raises, so
    one that arrives there is lost: another is sent when two more calls have come to their end.
    """
    n_done, n_sent, raised = 0, 0, threading.Event()

    def send():
        nonlocal n_sent
        raised.wait(seconds)
        while n_sent < MOST and not raised.is_set():
            n_sent, until = n_sent + 1, n_done + 3  # one may end before the signal is there
            interrupt()
            wait_until(lambda until=until: raised.is_set() or n_done >= until)

    sender = threading.Thread(target=send, daemon=True)
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012
        sender.start()
        while sender.is_alive():
            call()
            n_done += 1
    # A further one may have been sent before the first was noticed.
    for _ in range(2):
        with contextlib.suppress(KeyboardInterrupt):
            raised.set()
            sender.join()
    return n_sent
