"""Calls of machine code from Python, which an interrupt (Ctrl-C) must be able to end.

Python handles signals between two of its own instructions, so not while machine code runs. And the
first instructions after it may be those by which numba makes the arrays of the result: there an
exception is not expected, and the interpreter reports it as a `SystemError`.
"""

from collections.abc import Callable, Sequence
from threading import Thread, current_thread, main_thread
from time import perf_counter
from typing import Any

# A call of more seconds runs in a thread, whose start and end take a tenth of a millisecond.
_LONG = 0.05
_REFRESH_SECONDS = 0.1


def call_machine_code(function: Callable, *arguments: Any) -> Any:
    """Call a jitted function; what a signal's handler raised meanwhile is raised as it is."""
    try:
        return function(*arguments)
    except SystemError as error:
        cause: BaseException | None = error
        while isinstance(cause, SystemError):
            cause = cause.__cause__
        if cause is None:
            raise
        raise cause from None


class TimedCall:
    """A jitted function that is called in a thread if the call is likely to be long.

    The main thread waits, and an interrupt ends its wait at once. The machine code cannot be
    stopped: its thread keeps the arguments until it ends, and does not keep the process alive.
    """

    def __init__(self, function: Callable):
        self._function = function
        self._pace = float("inf")  # seconds for a unit of work, by the last call

    def __call__(self, arguments: Sequence[Any], work: int) -> Any:
        """Call with these arguments; the time it takes is roughly proportional to ``work``."""
        work = max(work, 1)
        is_long = work * self._pace > _LONG and current_thread() is main_thread()
        began = perf_counter()
        if is_long:
            result = call_in_thread(self._function, *arguments)
        else:
            result = call_machine_code(self._function, *arguments)
        self._pace = (perf_counter() - began) / work
        return result


def call_in_thread(function: Callable, *arguments: Any) -> Any:
    """Call a jitted function in a thread of its own; see `TimedCall`."""
    results: list[Any] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(function(*arguments))
        except BaseException as error:
            errors.append(error)

    thread = Thread(target=run, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(_REFRESH_SECONDS)  # on Windows no signal ends a wait without a limit
    if errors:
        raise errors[0]
    return results[0]
