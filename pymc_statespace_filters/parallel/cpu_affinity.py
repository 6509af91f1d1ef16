"""How many threads of machine code this process may run at once."""

import os
from collections.abc import Sequence
from fractions import Fraction


def core_numbers() -> set[int]:
    """Which processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return os.sched_getaffinity(0)
    return set(range(os.cpu_count() or 1))


def available_cores() -> int:
    """How many processors this process may use."""
    return len(core_numbers())


def share_of_cores(process: int, used: Sequence[set[int]]) -> int:
    """How many processors are left to one of several processes of a computer, at least 1.

    A launcher may bind each to processors of its own, or let all use all of them.

    Parameters
    ----------
    process : int
    used : sequence of set of int
        For every process, the numbers of the processors that it may use.

    Examples
    --------
    >>> share_of_cores(0, [{0, 1, 2, 3}, {4, 5, 6, 7}]), share_of_cores(0, [{0, 1, 2, 3}] * 2)
    (4, 2)
    """
    share = sum(Fraction(1, sum(core in others for others in used)) for core in used[process])
    return max(1, int(share))
