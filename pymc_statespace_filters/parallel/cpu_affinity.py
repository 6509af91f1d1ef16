"""The processor cores that this process may use."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from fractions import Fraction

_chosen: ContextVar[int | None] = ContextVar("chosen cores", default=None)


def allowed_cores() -> set[int]:
    """Numbers of the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return os.sched_getaffinity(0)
    return set(range(os.cpu_count() or 1))


def available_cores() -> int:
    """Number of cores that this process may use, or the number set by `cores_set_to`."""
    return _chosen.get() or len(allowed_cores())


@contextmanager
def cores_set_to(cores: int | None) -> Iterator[None]:
    """Set the number that `available_cores` returns inside the block; None leaves it as it is.

    Examples
    --------
    >>> with cores_set_to(3):
    ...     available_cores()
    3
    """
    token = _chosen.set(cores or _chosen.get())
    try:
        yield
    finally:
        _chosen.reset(token)


def cores_per_process(process: int, allowed: Sequence[set[int]]) -> int:
    """Number of cores for one of several processes on a computer, at least 1.

    A launcher may bind each process to different cores, or let all use all of them: ``allowed`` has
    the numbers of the cores of every process.

    Examples
    --------
    >>> cores_per_process(0, [{0, 1, 2, 3}, {4, 5, 6, 7}])
    4
    >>> cores_per_process(0, [{0, 1, 2, 3}] * 2)
    2
    """
    fractions = (Fraction(1, sum(core in cores for cores in allowed)) for core in allowed[process])
    return max(1, int(sum(fractions)))
