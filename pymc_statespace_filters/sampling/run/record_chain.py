"""A Markov chain on a panel that moves every record by itself."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...errors import ModelError
from ...filters.outcomes import Failure
from ..kernel.independence import no_mixture
from ..kernel.record_arrays import (
    FIRST_ACCEPTED,
    FIRST_ESTIMATE,
    RecordEvaluation,
    RecordRandomBlock,
    write_standard,
)
from ..kernel.record_moves import advance_records
from ..kernel.state import (
    LOG_DENSITY,
    N_COMMON_BLOCKS,
    N_EFFECTIVE,
    ChainState,
    Draws,
    PhaseSettings,
    draw_seeds,
)
from ..output.likelihood_variance import SeedSpread, spread_of
from ..target.initial_points import N_COMPARED
from ..target.record_target import RecordTarget
from ..target.target import Target
from .chain import Chain
from .chain_arrays import ChainArrays
from .thinned_draws import Thinning

# Draws of the prior of which each record starts at the likeliest.
N_TRIED = 50
APART = 0.1  # relative sd over records, of values that would be the same at the start


class _Terms(NamedTuple):
    """Terms by record (G + 1,) at a position, as `kernel.record_moves` has them."""

    position: np.ndarray
    seeds: np.ndarray  # of the evaluation
    estimates: np.ndarray
    priors: np.ndarray

    @property
    def is_finite(self) -> np.ndarray:
        """Whether each term is, (G + 1,)."""
        return np.isfinite(self.estimates + self.priors)


def _apart(position: np.ndarray, own: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A position of the model, whose records have not all the same value of their own (G, k).

    Values that a user leaves out are PyMC's default, which often is the same for all records. Where
    all are at the mean of their prior, the density of its scale has no integral: the scale would go
    to zero, and not come back.
    """
    values = position[own]
    sizes = np.where(values == 0.0, 1.0, np.abs(values))
    moved = position.copy()
    moved[own] += np.where(
        (np.ptp(values, axis=0) == 0.0) & (len(own) > 1),
        APART * sizes * rng.standard_normal(values.shape),
        0.0,
    )
    return moved


class RecordChain(ChainArrays):
    """A Markov chain of a prepared target with records; its arguments are those of `Chain`."""

    _target: RecordTarget

    def __init__(
        self,
        target: RecordTarget,
        key: np.ndarray,
        n_rows: int,
        thinning: Thinning | None = None,
    ):
        self._densities = target.densities.bind()
        layout, dim = target.layout, target.raveled.dim
        numbers = np.zeros(FIRST_ESTIMATE + layout.n_records + 1)
        numbers[N_EFFECTIVE] = np.inf
        state = ChainState(
            np.empty(dim),
            np.zeros(layout.columns.size, dtype=np.int64),
            numbers,
            target.first_adaptation.copy(),
            no_mixture(0),
            np.empty(0),
            np.array(key),
        )
        n_counts = FIRST_ACCEPTED + layout.n_records + N_COMMON_BLOCKS
        super().__init__(target, state, n_rows, n_counts, np.empty((0, dim, dim)), thinning)

    def start(
        self,
        candidates: Sequence[np.ndarray],
        others: Sequence[np.ndarray],
        rng: np.random.Generator,
    ) -> tuple[int, ...]:
        """Move to the best of the candidates, chosen by every record for itself.

        The shared parameters and the population are those of the candidate of highest density;
        every record takes its own from the candidate at which it is likeliest. Returns 0 or the
        failure code of the evaluations of all records. Raises as `Chain.start`, and `ModelError` if
        the density of a record is zero at all candidates.
        """
        failures: list[int] = []
        layout = self._target.layout
        candidates = [
            self._densities.centred(_apart(position, layout.own, rng), layout)
            for position in candidates
        ]

        def evaluate(position: np.ndarray) -> _Terms:
            self._check_pause()
            seeds = draw_seeds(rng, (self._target.n_noisy,))
            if not self._target.settings.refresh_noise:
                seeds = self._target.fixed_seeds
            estimates, found = self._densities.estimate(position, seeds)
            failures.extend(_codes(found, estimates.size))
            return _Terms(position, seeds, estimates, self._densities.priors(position))

        whole = [evaluate(position) for position in candidates[-N_COMPARED:]]
        best = max(whole, key=_rank)
        self._take(best, best.is_finite[:-1])
        is_found = best.is_finite[:-1]
        likeliest = np.where(is_found, best.estimates[:-1], -np.inf)
        for position in candidates[: N_TRIED if len(candidates) > 1 else 0]:
            mixed = best.position.copy()
            mixed[self._target.layout.own] = position[self._target.layout.own]
            tried = evaluate(mixed)
            better = tried.is_finite[:-1] & (tried.estimates[:-1] > likeliest)
            self._take(tried, better)
            likeliest[better] = tried.estimates[:-1][better]
            is_found = is_found | better
        self._check_found(is_found & best.is_finite[-1], failures, len(candidates))
        priors = self._densities.priors(self.state.position)
        self.state.numbers[LOG_DENSITY] = self._estimates.sum() + priors.sum()
        return tuple(failures)

    @property
    def position(self) -> np.ndarray:
        """Where the chain is, in the coordinates of the model."""
        position = np.empty_like(self.state.position)
        layout = self._target.layout
        write_standard(self._densities.native, layout, self.state, position, layout.n_standard)
        return position

    @property
    def _estimates(self) -> np.ndarray:
        return self.state.numbers[FIRST_ESTIMATE:]

    def _take(self, terms: _Terms, chosen: np.ndarray) -> None:
        """Take what all share, and the own parameters and estimates of the chosen records."""
        layout, state = self._target.layout, self.state
        for block in (layout.shared, layout.population, layout.own[chosen].ravel()):
            state.position[block] = terms.position[block]
        self._estimates[:-1][chosen] = terms.estimates[:-1][chosen]
        self._estimates[-1] = terms.estimates[-1]
        is_of_record = np.isin(np.arange(state.seeds.size), layout.seeds)
        places = np.concatenate([np.flatnonzero(~is_of_record), layout.seeds[chosen].ravel()])
        state.seeds[places] = terms.seeds[layout.columns[places]]

    def _check_found(self, is_found: np.ndarray, failures: Sequence[int], n_tried: int) -> None:
        if is_found.all():
            return
        label = self._target.labels[int(np.argmin(is_found))]
        reasons = [code for code in failures if code]
        failure = Failure.of(reasons[-1]) if reasons else Failure.NONE
        because = f" ({failure.message})" if reasons else ""
        cure = f". {failure.cure}" if failure.cure else ""
        tried = f", nor at {n_tried - 1} draws from the prior" if n_tried > 1 else ""
        raise ModelError(
            f"the log-density of record {label!r} is not finite at the start{because}{tried}: give "
            f"a start of finite log-density by initvals{cure}"
        )

    def seed_spread(self, position: np.ndarray, seeds: np.ndarray) -> SeedSpread:
        """Measure the spread of each record's estimates over seeds (R, noisy); the widest one."""
        estimates = []
        position = self._densities.centred(position, self._target.layout)
        for row in seeds:
            self._check_pause()
            estimates.append(self._densities.estimate(position, row)[0][:-1])
        spreads = [spread_of(of_record) for of_record in np.transpose(estimates)]
        widest = int(np.argmax([spread.variance for spread in spreads]))
        of = f" of record {self._target.labels[widest]!r}"
        return spreads[widest]._replace(of=of)

    def _iterate(
        self,
        settings: PhaseSettings,
        random: RecordRandomBlock,
        first: int,
        draws: Draws,
        row: int,
        n: int,
    ) -> int:
        return advance_records(
            settings,
            self._densities.native,
            self._target.layout,
            self.state,
            random,
            first,
            draws,
            row,
            n,
            self.control,
        )

    def _raise_error(self) -> None:
        self._densities.raise_error()


def _codes(found: RecordEvaluation, n_terms: int) -> list[int]:
    """0 or the failure code of each record of an evaluation."""
    n_failed = min(found.n_failed, n_terms - 1)
    return [found.failure] * n_failed + [0] * (n_terms - 1 - n_failed)


def _rank(terms: _Terms) -> tuple[int, float]:
    """More records with a finite density come first, then a higher one."""
    finite = terms.is_finite
    return int(finite.sum()), float((terms.estimates + terms.priors)[finite].sum())


def chain_of(
    target: Target | RecordTarget,
    key: np.ndarray,
    n_rows: int,
    n_covs: int,
    proposal_cov: np.ndarray | None = None,
    thinning: Thinning | None = None,
) -> Chain | RecordChain:
    """The chain of a target, with arguments as of `Chain`."""
    if isinstance(target, RecordTarget):
        return RecordChain(target, key, n_rows, thinning)
    return Chain(target, key, n_rows, n_covs, proposal_cov, thinning)
