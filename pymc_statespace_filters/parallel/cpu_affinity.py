"""The processor cores that this process may use."""

import os
from collections.abc import Sequence
from fractions import Fraction


def allowed_cores() -> set[int]:
    """Numbers of the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return os.sched_getaffinity(0)
    return set(range(os.cpu_count() or 1))


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(allowed_cores())


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
