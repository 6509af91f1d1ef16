"""One comparison: several contenders on the same task, timed in turn, their answers compared."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.peers.client import Peer, PeerError, RemoteTask
from benchmarks.timing import Contender, Timing, in_turn

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "out" / "benchmarks"
N_SEEDS = 16  # number of estimates to average where an answer is random


@dataclass(frozen=True)
class Row:
    """One line of the table: contender, task, CPU seconds, and the answer."""

    work: str
    who: str
    timing: Timing | None
    answer: str = ""
    note: str = ""

    @classmethod
    def of_json(cls, row: dict) -> "Row":
        timing = Timing(**row["timing"]) if row["timing"] else None
        return cls(**(row | {"timing": timing}))


class Peers:
    """The processes of other packages, started on first use."""

    def __init__(self) -> None:
        self.open: dict[str, Peer] = {}
        self.versions: dict[str, str] = {}

    def task(self, file: str, task: str, environment: str = ".venv-bench") -> RemoteTask:
        if file not in self.open:
            self.open[file] = Peer(file, ROOT / environment, FOLDER / "records.npz")
            self.versions |= self.open[file].versions
        return RemoteTask(self.open[file], task)

    def close(self) -> None:
        for peer in self.open.values():
            peer.close()
        self.open.clear()


def compare(
    work: str,
    makers: dict[str, Callable[[], Contender]],
    *,
    rounds: int = 9,
    n_seeds: int = 1,
    notes: dict[str, str] | None = None,
    without_answer: tuple[str, ...] = (),
) -> list[Row]:
    """Return the rows of one task; a contender that cannot do it has a row with the reason.

    ``without_answer`` names contenders that do not compute the likelihood.
    """
    contenders, answers, reasons = {}, {}, {}
    for who, make in makers.items():
        try:
            contender = make()
            contender.warm_up()
            if who not in without_answer:
                answers[who] = as_text(contender.values(n_seeds))
            contenders[who] = contender
        except (NotImplementedError, PeerError) as reason:
            reasons[who] = str(reason)
    timings = in_turn(contenders, rounds)
    return [
        Row(
            work,
            who,
            timings.get(who),
            answers.get(who, ""),
            reasons.get(who) or (notes or {}).get(who, ""),
        )
        for who in makers
    ]


def as_text(values: list[float]) -> str:
    """Return the log-likelihood to 1e-6, or its mean and the standard error of the mean."""
    if len(values) == 1:
        return f"{values[0]:.6f}"
    error = statistics.stdev(values) / len(values) ** 0.5
    return f"{statistics.mean(values):.2f} ± {error:.2f}"
