"""Variances of an estimated likelihood for several numbers of particles, and what they advise.

Also which observations carry the variance.
"""

from collections.abc import Sequence

import numpy as np

from ...filters.protocol import Filter
from ...filters.written import short_form
from ...pymc_model.inspection import resized
from .effort import Effort, OutOfTimeError
from .noisy_likelihood import Estimates, NoisyLikelihood
from .search import Row

# Evaluations at a point: in a first estimate, at the centre, and at each point of the tail.
_FIRST, _CENTRE, _TAIL = 25, 100, 30
# Beyond this factor from the target the first estimate suffices.
_NEAR = 4.0
# Estimates by another filter, and the number of particles from which on it is looked for.
_OTHER, _MANY = 12, 1000

# The observations named carry this share of the variance together, if so many are enough.
_SHARE, _MOST = 0.5, 5
# A variance is concentrated if one in so many observations carries half of it.
_ONE_IN = 50


class Measurement:
    """Rows measured so far, by number of particles, at the centre and tail of a posterior."""

    def __init__(self, likelihood: NoisyLikelihood, effort: Effort, target: tuple[float, float]):
        self.rows: dict[int, Row] = {}
        self._likelihood, self._effort, self._target = likelihood, effort, target
        self._noisiest: dict[int, dict[int, float]] = {}
        self._n_terms = 0

    def find_points(self) -> None:
        """Find the centre and the tail."""
        self._centre, self._tail = self._likelihood.points()

    def measure(self, n_particles: int) -> Row:
        """Measure a number of particles; what has been measured is in ``rows`` at any time."""
        low, high = self._target
        self._likelihood.prepare(resized(self._likelihood.filter, n_particles))
        self._effort.announce(f"{n_particles} particles", _FIRST)
        row = self._at_centre(n_particles, _FIRST)
        self._effort.is_limited = True
        if not low / _NEAR <= row.centre.variance <= high * _NEAR:
            return row
        n = _CENTRE + _TAIL * len(self._tail)
        self._effort.announce(f"{n_particles} particles, in detail", n)
        row = self._at_centre(n_particles, _CENTRE)
        spreads = [self._likelihood.spread(n_particles, point, _TAIL) for point in self._tail]
        n_failed = row.n_failed + sum(s.n_failed for s in spreads)
        row = row._replace(tail=max(s.variance for s in spreads), n_failed=n_failed)
        self.rows[n_particles] = row
        return row

    def noisiest_at(self, row: Row) -> dict[int, float]:
        """The observations that carry the variance, with their shares."""
        return self._noisiest.get(row.n_particles, {})

    def advice(self, row: Row, n_suggested: int, problem: str | None) -> Sequence[str]:
        """Say which observations carry the variance, and which filter has less of it.

        Nothing if all is well: there is no problem, and not many particles serve few observations.
        """
        noisiest = self.noisiest_at(row)
        is_dear = n_suggested >= _MANY and is_concentrated(noisiest, self._n_terms)
        if not noisiest or not (problem or is_dear):
            return []
        return [describe(noisiest), *self._other_filter(row.centre.variance)]

    def _at_centre(self, n_particles: int, n_seeds: int) -> Row:
        filter = resized(self._likelihood.filter, n_particles)
        found = self._likelihood.estimates(filter, self._centre, n_seeds)
        self._n_terms = found.terms.shape[1]
        self._noisiest[n_particles] = noisiest_terms(found.terms)
        spread = found.spread
        row = Row(n_particles, spread, np.nan, spread.n_failed, found.seconds)
        self.rows[n_particles] = row
        return row

    def _other_filter(self, variance: float) -> Sequence[str]:
        """A filter that has been seen to have less variance at the same point, if there is one."""
        filter = self._likelihood.quiet_filter()
        if filter is None or not self._effort.has_left(1.0):
            return (
                []
                if filter is None
                else [f"{short_form(filter)} can treat this system: compare it"]
            )
        self._likelihood.prepare(filter)
        self._effort.announce(f"Comparison with {type(filter).__name__}", _OTHER)
        try:
            found = self._likelihood.estimates(filter, self._centre, _OTHER if filter.noisy else 1)
        except (OutOfTimeError, KeyboardInterrupt):
            return []
        return _comparison(filter, found, variance)


def _comparison(filter: Filter, found: Estimates, variance: float) -> Sequence[str]:
    if not np.isfinite(found.totals).all():
        return []
    if found.totals.size == 1:
        return [f"{short_form(filter)} computes this likelihood without noise"]
    less = found.spread.variance
    return (
        [f"{short_form(filter)} has a variance of {less:.2g} there"]
        if less < 0.5 * variance
        else []
    )


def noisiest_terms(terms: np.ndarray) -> dict[int, float]:
    """The rows of the record with the largest shares of the variance, and these shares.

    Estimates (R, J) of all terms. The share of a term is its covariance with the total, over the
    variance of the total: shares add up to one.
    """
    finite = terms[np.isfinite(terms).all(axis=1)]
    centred = finite - finite.mean(axis=0) if len(finite) else finite
    totals = centred.sum(axis=1)
    variance = float(totals @ totals)
    if not variance > 0.0:
        return {}
    shares = totals @ centred / variance
    order = np.argsort(-shares)[:_MOST]
    n_needed = 1 + int(np.searchsorted(np.cumsum(shares[order]), _SHARE))
    return {int(j): float(shares[j]) for j in order[:n_needed] if shares[j] > 0.0}


def is_concentrated(noisiest: dict[int, float], n_terms: int) -> bool:
    """Whether a fiftieth of the observations, or a single one, carries half of the variance."""
    return len(noisiest) <= max(1, n_terms // _ONE_IN) and sum(noisiest.values()) >= _SHARE


def describe(noisiest: dict[int, float]) -> str:
    """Say which observations carry which share of the variance."""
    rows = ", ".join(f"{j} ({100 * share:.0f} %)" for j, share in noisiest.items())
    return f"By rows of the record, from 0, the largest shares of the variance are {rows}"
