"""Proposals of sub-models by their own maxima, where draws of the full model are no guide.

The posterior of a model of many terms may be too complicated to be drawn from, while those of its
sub-models of few terms have a few maxima and a curvature. The maxima of a sub-model are found by
Newton's method from those of another one, which differs from it by a term or two: where a term is
dropped, from the others as they are; where one is added, from several of its values.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..evidence.estimators.newton import BatchFunction, EdgeError, derivatives
from ..statistics.student_mixture import StudentMixture
from .proposals import FIRST, WIDE, Guide, Proposal
from .submodel_density import Array, Columns, SubmodelDensity
from .submodel_evidence import Sampler

STEP = 0.01  # of differences, in standard deviations
N_STEPS = 20  # of Newton's method, at most
LENGTHS = np.array([4.0, 2.0, 1.0, 0.5, 0.25, 0.1, 0.03, 0.0])  # tried, of a step
SETTLED = 0.01  # nats, that a step gains at the end
CURVATURE = 0.1, 1e8  # of a component, least and most in standard deviations of the draws
N_VALUES, N_HALVED = 4, 6  # of a term that is added: draws, and how often they are halved
MOST_MAXIMA = 4  # that are kept of a sub-model, and draws from which the first ones are searched
MOST_SIGNS = 7  # coefficients whose signs are all tried
NEGLIGIBLE = 8.0  # nats below the highest maximum
EVEN = 0.1  # weight that all components share, of a height that is not exact
BULK = 3.0  # standard deviations of a squared distance


@dataclass(frozen=True)
class Maximum:
    """A maximum of a sub-model's density in the coordinates that a proposal draws."""

    point: Array  # (k,), with the other coordinates as they were at first
    drawn: Columns  # (d,), those of these coordinates
    precision: Array  # (d, d), minus the second derivatives
    log_evidence: float  # by Laplace's approximation

    def has_in_bulk(self, point: Array) -> bool:
        """Whether a point (k,) is no farther away than nearly all draws around the maximum are."""
        gap = (point - self.point)[self.drawn]
        d = len(gap)
        return bool(gap @ self.precision @ gap < d + BULK * (2 * d) ** 0.5)


class Maxima:
    """Finds maxima of sub-models, of a likelihood without noise.

    The draws of the guide say of which magnitude a term is.
    """

    def __init__(
        self, density: SubmodelDensity, guide: Guide, sampler: Sampler, rng: np.random.Generator
    ) -> None:
        self._sampler, self._rng = sampler, rng
        self._draws = guide.coordinates.forward(guide.draws)
        self._spread = self._draws.std(axis=0)
        # Coefficients about the value at which they vanish, which a logarithm does not have.
        self._signed = [
            column
            for column in np.concatenate(density.candidates.switches.columns)
            if density.model.rvs_to_transforms[density.variables[column]] is None
        ]
        self._centre = np.median(self._draws, axis=0)
        self._centre[self._signed] = guide.coordinates.centre[self._signed]

    def of(
        self, first: Proposal, known: Sequence[Maximum], least: float = -np.inf
    ) -> list[Maximum]:
        """The maxima of a sub-model, best first; from draws if none is ``known`` of another.

        If the log-evidence is below ``least`` by the first one, there is no search for others.
        """
        function, drawn = self._sampler.log_density_of(first), first.drawn
        found: list[Maximum] = []
        if known:
            starts = [at for one in known for at in self._starts(one, first, function)]
        else:
            chosen = self._rng.integers(len(self._draws), size=MOST_MAXIMA)
            starts = [(self._draws[i], np.diag(self._spread[drawn] ** -2.0)) for i in chosen]
        for start in starts:
            if (one := self._near(start, function, drawn, found)) is not None:
                found.append(one)
                if one.log_evidence < least:
                    break
                for mirrored in self._mirrored(one, function):
                    if (other := self._near(mirrored, function, drawn, found)) is not None:
                        found.append(other)
        found.sort(key=lambda one: -one.log_evidence)
        return [
            one
            for one in found[:MOST_MAXIMA]
            if one.log_evidence > found[0].log_evidence - NEGLIGIBLE
        ]

    def _near(
        self,
        start: tuple[Array, Array],
        function: BatchFunction,
        drawn: Columns,
        found: Sequence[Maximum],
    ) -> Maximum | None:
        """The maximum near a start, a point (k,) with a precision.

        None if the way leads to those that were found, or if the density is zero about it.

        Each step is Newton's with the absolute values of the curvatures, which leads away from
        saddles, such as where the sign of a hidden state is not decided yet.
        """
        point, precision = start[0].copy(), start[1]
        scale, spread = _factor_of_inverse(precision), self._spread[drawn]
        for _ in range(N_STEPS):
            if any(one.has_in_bulk(point) for one in found):
                return None
            at = point[drawn]

            def along(z: Array, centre: Array = at, scale: Array = scale) -> Array:
                return function(centre + z @ scale.T)

            try:
                slope, hessian = derivatives(along, np.zeros(len(drawn)), STEP)
            except EdgeError:
                return None
            back = np.linalg.solve(scale, np.diag(spread))
            values, vectors = np.linalg.eigh(-back.T @ hessian @ back)
            values = np.clip(np.abs(values), *CURVATURE)
            directions = spread[:, None] * vectors / np.sqrt(values)
            step = directions @ (directions.T @ np.linalg.solve(scale.T, slope))
            tried = at + LENGTHS[:, None] * step
            heights = function(tried)
            best = int(np.argmax(heights))
            point[drawn], scale = tried[best], np.linalg.qr(directions.T, mode="r").T
            if heights[best] < heights[-1] + SETTLED:
                break
        precision = (vectors * values) @ vectors.T / np.outer(spread, spread)
        log_det = np.linalg.slogdet(precision)[1]
        log_evidence = heights[best] + 0.5 * (len(drawn) * np.log(2 * np.pi) - log_det)
        return Maximum(point, drawn, precision, float(log_evidence))

    def _mirrored(self, best: Maximum, function: BatchFunction) -> Iterator[tuple[Array, Array]]:
        """Points with other signs of coefficients that are nearly as probable as a maximum.

        The signs of a hidden state are such.
        """
        columns = np.intersect1d(best.drawn, self._signed)
        if not 0 < len(columns) <= MOST_SIGNS:
            return
        signs = 1 - 2.0 * (
            (np.arange(1, 2 ** len(columns))[:, None] >> np.arange(len(columns))) & 1
        )
        points = np.tile(best.point, (len(signs), 1))
        points[:, columns] = self._centre[columns] + signs * (best.point - self._centre)[columns]
        heights = function(points[:, best.drawn])
        least = function(best.point[None, best.drawn])[0] - NEGLIGIBLE
        order = np.argsort(-heights, kind="stable")[:MOST_MAXIMA]
        flips = np.ones((len(signs), len(best.point)))
        flips[:, columns] = signs
        for i in order[heights[order] > least].tolist():
            flip = flips[i, best.drawn]
            yield points[i], best.precision * np.outer(flip, flip)

    def _starts(
        self, known: Maximum, first: Proposal, function: BatchFunction
    ) -> Iterator[tuple[Array, Array]]:
        """Points (k,) with precisions of the coordinates that are drawn.

        Of values of a term that is added, the best one on each side of where the term vanishes.
        """
        drawn = first.drawn
        precision = np.diag(self._spread[drawn] ** -2.0)
        here, there = np.isin(drawn, known.drawn), np.isin(known.drawn, drawn)
        precision[np.ix_(here, here)] = known.precision[np.ix_(there, there)]
        if here.all():
            yield known.point, precision
            return
        new = drawn[~here]
        values = self._draws[self._rng.integers(len(self._draws), size=N_VALUES)]
        halved = 0.5 ** np.arange(N_HALVED)
        shares = np.concatenate([halved, -halved, [0.0]])
        moves = np.concatenate([share * (values - self._centre)[:, new] for share in shares])
        points = np.tile(known.point, (len(moves), 1))
        points[:, new] = self._centre[new] + moves
        heights = function(points[:, drawn])
        sides = [np.where(side * moves[:, 0] > 0, heights, -np.inf) for side in (1, -1)]
        best = [int(np.argmax(one)) for one in sides]
        higher = [i for i in best if heights[i] > heights[-1]]
        for i in higher or [max(best, key=lambda i: heights[i])]:
            if np.isfinite(heights[i]):
                scale = precision.copy()
                scale[~here, ~here] = np.maximum(scale[~here, ~here], 4 / moves[i] ** 2)
                yield points[i], scale


def _factor_of_inverse(precision: Array) -> Array:
    """The lower Cholesky factor of the inverse of a matrix, which may be nearly singular."""
    upper = np.linalg.qr(np.linalg.inv(np.linalg.cholesky(precision)), mode="r")
    return upper.T * np.sign(np.diag(upper))


def proposal_by(maxima: Sequence[Maximum], first: Proposal) -> Proposal:
    """A mixture of components at the maxima, and of the first proposal."""
    if not maxima:
        return first
    heights = np.array([one.log_evidence for one in maxima])
    weights = np.exp(heights - heights.max())
    weights = (1 - EVEN) * weights / weights.sum() + EVEN / len(weights)
    own = StudentMixture(
        weights,
        np.array([one.point[one.drawn] for one in maxima]),
        np.array([_factor_of_inverse(one.precision) for one in maxima]),
    ).with_wide_parts(WIDE)
    mixture = own.mixed_with(first.first, FIRST)
    return replace(first, mixture=mixture, first=mixture)
