"""Records of every design and model, and their likelihoods at the draws of all models.

A row is a record of one model under one design. Its noise depends on the seed, the model and the
number of the record alone, so that designs have random numbers in common, and neither threads nor
ranks change a bit.
"""

from collections.abc import Callable, Sequence
from functools import partial
from threading import Event

import numpy as np
from numpy.typing import NDArray

from ..filters.protocol import DifferentiableFilter
from ..ops.base import evaluator
from ..ops.likelihood import LogLikelihood
from ..ops.signatures import POINTS
from ..parallel.cpu_affinity import available_cores
from ..parallel.shared_rows import evaluated_rows
from ..parallel.threads import run_in_threads
from .candidates import Candidate
from .information import group_sums
from .rivals import Rival

_ANY_SEED = np.asarray(0)  # of likelihoods without noise

Array = NDArray[np.float64]


class SimulatedRecords:
    """The records of D designs and M models: log-likelihoods, summed over groups of draws."""

    def __init__(
        self,
        designs: Sequence[Sequence[Candidate]],
        rivals: Sequence[Rival],
        n_groups: int,
        seed: int,
    ) -> None:
        self._designs, self._rivals = designs, rivals
        self._n_groups, self._seed = n_groups, seed
        self._mixed: dict[tuple[int, int], Array] = {}  # theta, by model and draw
        self._n_sums = len(rivals) + any(rival.mixed is not None for rival in rivals)
        for candidates in designs:  # compiles, before there are threads
            for candidate, rival in zip(candidates, rivals, strict=True):
                candidate.simulated(rival.theta[0], np.random.default_rng(0))
                _likelihoods(rival, candidate)

    def n_rows(self, numbers: range) -> int:
        """How many rows records of these numbers are."""
        return len(numbers) * len(self._rivals) * len(self._designs)

    def __call__(self, numbers: range, on_progress: Callable[[int], None]) -> tuple[Array, Array]:
        """The log-likelihoods of records (D, M, R) at their own draws, and sums (D, M, R, M, G).

        ``numbers`` are those of the R records. NaN where a record, or its log-likelihood at the
        draw that made it, is not finite. Where information about some variables is asked for, there
        are sums (D, M, R, M + 1, G), see `information.Records`.
        """
        for m, rival in enumerate(self._rivals):  # PyTensor's functions are not for threads
            for at in {r % len(rival.theta) for r in numbers}:
                if rival.mixed is not None and (m, at) not in self._mixed:
                    self._mixed[m, at] = rival.mixed(at)
        shape = len(numbers), len(self._rivals), len(self._designs)
        rows = np.stack(np.unravel_index(np.arange(np.prod(shape)), shape), axis=1)
        rows[:, 0] += numbers.start

        def evaluate(part: slice) -> list[Array]:
            return self._in_threads(rows[part], on_progress)

        own, sums = evaluated_rows(evaluate, [rows, self._theta_of(rows)], self._empty)
        back = (2, 1, 0)
        return (
            own.reshape(shape).transpose(back),
            sums.reshape(*shape, *sums.shape[1:]).transpose(*back, 3, 4),
        )

    def _theta_of(self, rows: NDArray[np.int64]) -> Array:
        """A number that differs where the draws of ranks do."""
        own = [self._rivals[m].theta for _, m, _ in rows]
        return np.array(
            [theta[r % len(theta)].sum() for theta, (r, _, _) in zip(own, rows, strict=True)]
        )

    def _empty(self, n_rows: int) -> list[Array]:
        return [np.empty(n_rows), np.empty((n_rows, self._n_sums, self._n_groups))]

    def _in_threads(
        self, rows: NDArray[np.int64], on_progress: Callable[[int], None]
    ) -> list[Array]:
        own, sums = self._empty(len(rows))
        n_threads = max(1, min(available_cores(), len(rows)))
        n_done, stopped = np.zeros(n_threads, dtype=int), Event()

        def run(thread: int) -> None:
            for i in range(thread, len(rows), n_threads):
                if stopped.is_set():
                    return
                own[i], sums[i] = self._row(*rows[i].tolist())
                n_done[thread] += 1

        run_in_threads(
            [partial(run, thread) for thread in range(n_threads)],
            n_threads,
            n_done=lambda: int(n_done.sum()),
            stop=stopped.set,
            on_progress=on_progress,
        )
        return [own, sums]

    def _row(self, r: int, m: int, d: int) -> tuple[float, Array]:
        candidates, theta = self._designs[d], self._rivals[m].theta
        at = r % len(theta)
        observed = candidates[m].simulated(theta[at], np.random.default_rng([self._seed, m, r]))
        own, sums = np.nan, np.full((self._n_sums, self._n_groups), np.nan)
        if not np.isfinite(observed[:, candidates[m].sensors]).all():
            return own, sums
        for i, (rival, candidate) in enumerate(zip(self._rivals, candidates, strict=True)):
            found = _likelihoods(rival, candidate)(rival.theta, observed)
            if i == m:
                own, found[at] = found[at], -np.inf
            sums[i] = group_sums(found, self._n_groups)
        if (mixed := self._mixed.get((m, at))) is not None:
            found = _likelihoods(self._rivals[m], candidates[m])(mixed, observed)
            found[at] = -np.inf
            sums[-1] = group_sums(found, self._n_groups)
        return (own if np.isfinite(own) else np.nan), sums


def _likelihoods(rival: Rival, candidate: Candidate) -> Callable[[Array, Array], Array]:
    """The log-likelihoods (n,) at theta (n, k) of a record (J, p); -inf where there is none."""
    system, filter = candidate.system, rival.filter
    if isinstance(filter, DifferentiableFilter):
        evaluate = evaluator(LogLikelihood(system, filter, POINTS))
    else:
        alone = evaluator(LogLikelihood(system, filter))

        def evaluate(points: Array, *record: object) -> tuple[Array]:
            return (np.array([alone(point, *record)[0] for point in points]),)

    def found(theta: Array, observed: Array) -> Array:
        terms = evaluate(
            theta, candidate.steps, observed, candidate.inputs, candidate.t0, _ANY_SEED
        )[0]
        return np.nan_to_num(terms.sum(axis=1), nan=-np.inf, posinf=-np.inf, neginf=-np.inf)

    return found
