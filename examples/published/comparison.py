"""A number that others published beside ours."""

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import arviz as az
import numpy as np
from scipy.stats import chi2, kurtosis

LARGEST_Z = 3.0
LEVEL = 0.999  # of the interval of a mean square z


class Comparison(NamedTuple):
    """A quantity, with the errors of both numbers; zero is exact.

    `by_chance` says that they are Monte Carlo errors. Those of rounding, and of numbers whose
    authors state none, have no known distribution.
    """

    quantity: str
    published: float
    published_error: float
    ours: float
    our_error: float = 0.0
    by_chance: bool = True

    @property
    def z(self) -> float:
        """The difference in standard errors of the difference."""
        return (self.ours - self.published) / np.hypot(self.published_error, self.our_error)


class Study(NamedTuple):
    """Comparisons with one source, and the CPU seconds that ours took, compilation included.

    `correlation` (n, n) is that of the errors of the n comparisons; None says independent.
    """

    title: str
    source: str
    comparisons: list[Comparison]
    seconds: float
    notes: str
    correlation: np.ndarray | None = None


@contextmanager
def cpu_seconds() -> Iterator[list[float]]:
    """Append the CPU seconds of a block to a list."""
    seconds: list[float] = []
    start = time.process_time()
    yield seconds
    seconds.append(time.process_time() - start)


def moments(name: str, draws: np.ndarray, mean: float, sd: float, n: float) -> list[Comparison]:
    """Mean and standard deviation of ``n`` draws of others, beside draws (chain, draw) of ours."""
    # Of a standard deviation, relative to that of a mean: by the kurtosis.
    relative = 0.5 * np.sqrt(kurtosis(draws, axis=None, fisher=False) - 1.0)
    error, ours = sd / n**0.5, float(az.mcse(draws))
    ours_of_sd = float(az.mcse(draws, method="sd"))
    return [
        Comparison(f"mean of {name}", mean, error, draws.mean(), ours),
        Comparison("its standard deviation", sd, relative * error, draws.std(), ours_of_sd),
    ]


def correlation_of_moments(draws: Iterable[np.ndarray]) -> np.ndarray:
    """Of the errors of all that `moments` returns, variable after variable."""
    parts = []
    for x in draws:
        centred = x.ravel() - x.mean()
        parts += [centred, centred**2]
    return np.corrcoef(parts)


class Spread(NamedTuple):
    """The mean square of z, and the interval that holds it at `LEVEL` if the errors are right."""

    what: str
    n: int
    worth: float
    mean_square: float
    low: float
    high: float


def spread(what: str, studies: Iterable[Study]) -> Spread:
    """Of all z whose errors are by chance.

    The sum of squares of n correlated z has the mean n and the variance 2 tr(C C), as has n / m
    times a chi-square with m = n^2 / tr(C C) degrees of freedom, which stands for it. The numbers
    of one posterior are worth fewer than they are.
    """
    z, trace = [], 0.0
    for study in studies:
        by_chance = np.array([c.by_chance for c in study.comparisons])
        c = np.eye(len(by_chance)) if study.correlation is None else study.correlation
        trace += np.sum(c[np.ix_(by_chance, by_chance)] ** 2)
        z += [c.z for c in study.comparisons if c.by_chance]
    worth = len(z) ** 2 / trace
    low, high = np.array(chi2(worth).interval(LEVEL)) / worth
    return Spread(what, len(z), worth, float(np.mean(np.square(z))), low, high)


def spreads(studies: list[Study]) -> list[Spread]:
    """Of each study with at least five such z, and of all studies together."""
    groups = {study.title.split(",")[0]: [study] for study in studies} | {"all": studies}
    n = {
        what: sum(c.by_chance for s in group for c in s.comparisons)
        for what, group in groups.items()
    }
    return [spread(what, group) for what, group in groups.items() if n[what] >= 5]


def shown(value: float, error: float) -> str:
    """To two digits of the error."""
    digits = 1 - int(np.floor(np.log10(error)))
    return np.format_float_positional(round(value, digits), trim="-")


def table(studies: list[Study]) -> str:
    """Markdown: a row for each number, the spread of z, and what is to be said of each study."""
    lines = ["| what | published | error | ours | error | z | CPU s |", "| --- " * 7 + "|"]
    for study in studies:
        title, seconds = f"{study.title}: ", f"{study.seconds:.0f}"
        for c in study.comparisons:
            error = np.hypot(c.published_error, c.our_error)
            numbers = shown(c.published, error), shown(c.ours, error)
            cells = numbers[0], f"{c.published_error:.2g}", numbers[1], f"{c.our_error:.2g}"
            lines.append(f"| {title}{c.quantity} | {' | '.join(cells)} | {c.z:+.2f} | {seconds} |")
            title = seconds = ""
    found = spreads(studies)
    if found:
        interval = f"{100 * LEVEL:g} % interval"
        lines += ["", f"| errors by chance | numbers | worth | mean z² | {interval} |"]
        lines.append("| --- " * 5 + "|")
    for s in found:
        interval = f"{s.low:.2f} to {s.high:.2f}"
        lines.append(f"| {s.what} | {s.n} | {s.worth:.0f} | {s.mean_square:.2f} | {interval} |")
    notes = [f"- {study.title}: {study.source}. {study.notes}" for study in studies]
    return "\n".join([*lines, "", *notes]) + "\n"
