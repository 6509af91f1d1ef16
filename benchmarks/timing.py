"""CPU times of several contenders, measured in rounds. Standard library only."""

import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Protocol

SHORTEST = 0.02  # seconds: a faster call is repeated until it takes this long


@dataclass(frozen=True)
class Timing:
    """CPU seconds of a call: the median over the rounds, and the lowest and the highest."""

    median: float
    low: float
    high: float
    rounds: int


class Contender(Protocol):
    """A contender that does the task, returns its answers, and reports its CPU seconds."""

    def warm_up(self) -> None: ...

    def values(self, n_seeds: int) -> list[float]: ...

    def seconds(self) -> float: ...


class Timed:
    """A function of noise, in this process.

    Without ``draw``, the function takes a seed, a new one for every timed call. With ``draw``, it
    takes the result of ``draw`` for a seed, and every timed call uses the same stored noise. A call
    that does ``per`` pieces of work is divided by their number. This class also times the functions
    of other packages, in their own processes.
    """

    def __init__(
        self,
        function: Callable[[Any], float],
        draw: Callable[[int], Any] | None = None,
        per: int = 1,
    ) -> None:
        self.function = function
        self.draw = draw
        self.per = per
        self.held = draw(0) if draw else None
        self.calls = 1
        self.seed = 0

    def warm_up(self) -> None:
        """Call once, to compile, then count the calls that fill the shortest time.

        The second count is used: the first few calls are still cold.
        """
        self.function(self.held if self.draw else 0)
        for _ in range(2):
            each = self.seconds() * self.per
            self.calls = max(1, round(SHORTEST / max(each, 1e-7)))
            if each > SHORTEST:
                return

    def values(self, n_seeds: int) -> list[float]:
        """Return answers for the first seeds, all equal where nothing is random."""
        draw = self.draw or (lambda seed: seed)
        return [float(self.function(draw(seed))) for seed in range(n_seeds)]

    def seconds(self) -> float:
        """Return CPU seconds of one call."""
        start = time.process_time()
        for _ in range(self.calls):
            self.seed += 1
            self.function(self.held if self.draw else self.seed)
        return (time.process_time() - start) / (self.calls * self.per)


def in_turn(contenders: dict[str, Contender], rounds: int) -> dict[str, Timing]:
    """Time every contender once per round, so that a slow minute affects all of them alike."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, contender in contenders.items():
            times[name].append(contender.seconds())
    return {name: summary(seconds) for name, seconds in times.items()}


def summary(seconds: Iterable[float]) -> Timing:
    seconds = list(seconds)
    return Timing(statistics.median(seconds), min(seconds), max(seconds), len(seconds))
