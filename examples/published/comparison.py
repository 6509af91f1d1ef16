"""A number that others published beside ours."""

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

LARGEST_Z = 3.0


class Comparison(NamedTuple):
    """A quantity, with the Monte Carlo error of both numbers; zero is exact."""

    quantity: str
    published: float
    published_error: float
    ours: float
    our_error: float = 0.0

    @property
    def z(self) -> float:
        """The difference in standard errors of the difference."""
        return (self.ours - self.published) / np.hypot(self.published_error, self.our_error)


class Study(NamedTuple):
    """Comparisons with one source, and the CPU seconds that ours took, compilation included."""

    title: str
    source: str
    comparisons: list[Comparison]
    seconds: float
    notes: str


@contextmanager
def cpu_seconds() -> Iterator[list[float]]:
    """Append the CPU seconds of a block to a list."""
    seconds: list[float] = []
    start = time.process_time()
    yield seconds
    seconds.append(time.process_time() - start)


def table(studies: Iterable[Study]) -> str:
    """Markdown: a row for each number, and what is to be said of each study."""
    lines = ["| what | published | error | ours | error | z | CPU s |", "| --- " * 7 + "|"]
    for study in studies:
        title, seconds = f"{study.title}: ", f"{study.seconds:.0f}"
        for c in study.comparisons:
            ours = f"{c.ours:.3f}" if abs(c.ours) > 100.0 else f"{c.ours:.5g}"
            cells = f"{c.published:.7g}", f"{c.published_error:.2g}", ours, f"{c.our_error:.2g}"
            lines.append(f"| {title}{c.quantity} | {' | '.join(cells)} | {c.z:+.2f} | {seconds} |")
            title = seconds = ""
    notes = [f"- {study.title}: {study.source}. {study.notes}" for study in studies]
    return "\n".join([*lines, "", *notes]) + "\n"
