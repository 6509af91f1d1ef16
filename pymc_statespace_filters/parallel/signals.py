"""Handling of Ctrl-C where an exception could be lost, or leave ranks waiting for each other.

A call that has something to return, such as draws, does not lose it by an interrupt: see
`keeps_what_is_there`.
"""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from threading import Event, current_thread, main_thread
from typing import Any


class _Call:
    """A call that may be interrupted, and returns what it has as soon as there is something."""

    def __init__(self, outer: "_Call | None") -> None:
        self._outer, self._before = outer, signal.getsignal(signal.SIGINT)
        # What is ignored, as in a background job of a shell's script, stays so.
        self._handles = current_thread() is main_thread() and callable(self._before)
        self.has_result = self.may_skip = self.returns = False
        self.is_interrupted = self.was_interrupted = False  # the first until somebody takes it

    def begin(self) -> None:
        if self._handles:
            signal.signal(signal.SIGINT, self._handle)
        if self._outer is not None and self._outer.is_interrupted:
            raise KeyboardInterrupt  # between two calls

    def end(self) -> None:
        """Hand over to the former handler, and to the call that surrounds this one."""
        outer = self._outer or _Call(None)
        keeps = self.returns and self.has_result
        outer.has_result |= keeps
        if self._handles:
            try:
                signal.signal(signal.SIGINT, self._before)
            except KeyboardInterrupt:  # of the former handler, at once
                if not keeps:
                    raise
        if keeps and self.was_interrupted:
            outer.is_interrupted = outer.was_interrupted = True

    def _handle(self, *signal_and_frame: Any) -> None:
        if self.has_result:
            self.is_interrupted = self.was_interrupted = True
            if self.may_skip:
                raise KeyboardInterrupt
        elif callable(self._before):
            self._before(*signal_and_frame)


_call: ContextVar[_Call | None] = ContextVar("call that keeps what is there", default=None)


def keeps_what_is_there[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Let a function return its result in spite of interrupts, however many.

    Until it says by `interrupts_are_noted` that there is something to return, an interrupt raises.
    From then on it is noted alone, for the function to ask for by `takes_interrupt`, and ends no
    more than what `unless_interrupted` runs.
    """

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        own = _Call(_call.get())
        token = _call.set(own)
        try:
            own.begin()
            result = function(*args, **kwargs)
            own.returns = True
        finally:
            _call.reset(token)
            own.end()
        return result

    return call


def interrupts_are_noted() -> None:
    """Say that there is, or will be, something that the function under way is to return."""
    if (call := _call.get()) is not None:
        call.has_result = True


def is_interrupted() -> bool:
    """Whether an interrupt was noted, that nothing has taken."""
    call = _call.get()
    return call is not None and call.is_interrupted


def takes_interrupt() -> bool:
    """The same, for who acts on it: it ends nothing else."""
    call, found = _call.get(), is_interrupted()
    if call is not None and found:
        call.is_interrupted = False
    return found


def unless_interrupted[R](work: Callable[[], R], otherwise: R) -> R:
    """The result of work that can be done without, or ``otherwise`` after an interrupt.

    An interrupt ends this work, and all other that comes after it. Where there is nothing else to
    return it raises.
    """
    call = _call.get()
    if call is None or not call.has_result:
        return work()
    try:
        try:
            call.may_skip = True
            return otherwise if call.is_interrupted else work()
        finally:
            call.may_skip = False
    except BaseException as error:  # by machine code it may be another one than was raised there
        call.may_skip = False
        call.is_interrupted |= isinstance(error, KeyboardInterrupt)
        if not call.is_interrupted:
            raise
        return otherwise


@contextmanager
def deferred_interrupts() -> Iterator[Event]:
    """Set an event at an interrupt instead of raising.

    Python could raise between receiving a message and handling it. Threads other than the main one
    are never interrupted.
    """
    interrupted = Event()
    token = _call.set(None)  # interrupts are not noted there
    try:
        with _handled_by(lambda *_: interrupted.set()):
            yield interrupted
    finally:
        _call.reset(token)


class held_interrupts:
    """Hold an interrupt back until the end of the block.

    In a Python function that machine code calls, an exception would be lost. A class, because it
    surrounds single evaluations: it takes 3 microseconds, two generators would take 8.
    """

    def __enter__(self) -> None:
        self._is_interrupted = False
        self._is_main = current_thread() is main_thread()
        if self._is_main:
            self._before = signal.signal(signal.SIGINT, self._note)

    def __exit__(self, *_: object) -> None:
        if self._is_main:
            signal.signal(signal.SIGINT, self._before)
        if self._is_interrupted:
            signal.raise_signal(signal.SIGINT)

    def _note(self, *_: object) -> None:
        self._is_interrupted = True


@contextmanager
def ignored_interrupts() -> Iterator[None]:
    """Ignore interrupts: they may reach all ranks, and one of them stops the others."""
    with _handled_by(signal.SIG_IGN):
        yield


@contextmanager
def _handled_by(handler: Any) -> Iterator[None]:
    if current_thread() is not main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
