"""Labels that may be exchanged, as those of regimes, and whether all their orders are counted.

If the density of a model stays the same when K labels are permuted in all parameters that have
them, its posterior has K! equal parts. Draws that stay in one part, and an ordering transform,
which leaves one part of the prior, lack ln K! of the evidence.

S. Chib, "Marginal likelihood from the Gibbs output", J. Am. Stat. Assoc. 90 (1995), whose estimate
was corrected so by R. M. Neal, "Erroneous results in 'Marginal likelihood from the Gibbs output'"
(1999); S. Frühwirth-Schnatter, "Estimating marginal likelihoods for mixture and Markov switching
models", Econometrics Journal 7 (2004).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray
from pytensor.graph.basic import Variable, equal_computations
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.type import RandomType
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components
from scipy.special import gammaln

from ..pymc_model.density import ConstrainedDensity
from ..pymc_model.prior import is_restricted

MOST_LABELS, MOST_PLACES = 8, 6
N_POINTS, N_SEEDS = 4, 8  # draws at which densities are compared; estimates of a noisy one
ROUNDING, MAX_ERROR = 1e-7, 1.0  # relative; in nats, of a noisy difference
N_ORDERED = 400  # draws whose order is found
N_RELABELLED = 5  # rounds in which orders and what labels have in common are found in turn
RARELY = 0.1  # of the share that a label would have if all orders were visited equally

Array = NDArray[np.float64]
Draws = Mapping[str, Array]


class Axis(NamedTuple):
    """Labels along an axis of a free variable."""

    name: str
    number: int

    @property
    def names(self) -> tuple[str, ...]:
        """The variables that have the labels."""
        return (self.name,)

    @property
    def parts(self) -> tuple["Axis", ...]:
        """What no other labels may have."""
        return (self,)

    def permuted(self, points: Draws, order: NDArray[np.int64]) -> Draws:
        """The points with other labels."""
        changed = np.take(points[self.name], order, axis=self.number + 1)
        return {**points, self.name: changed}


class Scalars(NamedTuple):
    """Labels of scalar variables, one for each, in this order."""

    names: tuple[str, ...]

    @property
    def parts(self) -> tuple[str, ...]:
        """What no other labels may have."""
        return self.names

    def permuted(self, points: Draws, order: NDArray[np.int64]) -> Draws:
        """The points with other labels."""
        changed = {name: points[self.names[i]] for name, i in zip(self.names, order, strict=True)}
        return {**points, **changed}


class Share(NamedTuple):
    """The share w of the first of two labels; the other one has 1 - w."""

    name: str

    @property
    def names(self) -> tuple[str, ...]:
        """The variable that has the labels."""
        return (self.name,)

    @property
    def parts(self) -> tuple[str, ...]:
        """What no other labels may have."""
        return (self.name,)

    def permuted(self, points: Draws, order: NDArray[np.int64]) -> Draws:
        """The points with other labels."""
        share = points[self.name]
        return {**points, self.name: share if order[0] == 0 else 1.0 - share}


type Place = Axis | Scalars | Share


@dataclass(frozen=True)
class Labels:
    """K labels that may be exchanged, in these places.

    ``lacking`` is the logarithm of the number of parts of the posterior over those that the draws
    visit; ``ordered`` are the variables of which a transform leaves one part of the prior.
    """

    count: int
    places: tuple[Place, ...]
    lacking: float
    ordered: tuple[str, ...]

    @property
    def names(self) -> list[str]:
        """Names of the variables that have the labels."""
        return list(dict.fromkeys(name for place in self.places for name in place.names))


def exchangeable_labels(
    model: pm.Model, idata: xr.DataTree, log_density: Array, rng: np.random.Generator
) -> list[Labels]:
    """Find the labels of a model by permutations at some draws (chain, draw) of its posterior."""
    posterior = idata["posterior"].to_dataset()
    draws = {
        rv.name: _flat(posterior[rv.name].transpose("chain", "draw", ...).values)
        for rv in model.free_RVs
    }
    by_count = _places_by_count(draws, _alike_scalars(model))
    if not by_count:
        return []
    test = _InvarianceTest(model, draws, rng)
    best, taken, found = int(np.argmax(log_density)), set[Axis | str](), list[Labels]()
    for count in sorted(by_count, reverse=True):  # two of three scalars are no labels of their own
        for places in _invariant_places(test, by_count[count], count, taken):
            found.append(_found(model, draws, count, places, best))
    return found


def uncounted_orders(model: pm.Model, found: Sequence[Labels]) -> Iterator[str]:
    """Yield what the evidence lacks, unless constant Potentials of the model count it."""
    total = sum(one.lacking for one in found)
    if abs(total - _constant_potentials(model)) < 0.01:
        return
    for one in found:
        if one.lacking > 0.0:
            names, orders = ", ".join(one.names), np.exp(one.lacking)
            why = (
                "a transform leaves one order of them in the prior"
                if one.ordered
                else "the draws do not visit all orders of them"
            )
            yield (
                f"the {one.count} labels of {names} may be exchanged and {why}, so that the "
                f"log-evidence lacks ln {orders:.0f} = {one.lacking:.3f}: add it, or give the "
                f"model pm.Potential('orders', pm.math.log({orders:.1f})) before it is sampled"
            )


def _flat(values: Array) -> Array:
    """Draws (chain, draw, ...) one after the other."""
    return values.reshape(-1, *values.shape[2:]).astype(np.float64)


def _alike_scalars(model: pm.Model) -> list[list[str]]:
    """Names of scalar variables of the same prior distribution, at least two."""
    groups: list[list[Variable]] = []
    for rv in model.free_RVs:
        alike = [group for group in groups if _have_one_prior(group[0], rv)]
        if alike:
            alike[0].append(rv)
        elif rv.ndim == 0:
            groups.append([rv])
    return [[str(rv.name) for rv in group] for group in groups if len(group) > 1]


def _have_one_prior(one: Variable, other: Variable) -> bool:
    """Whether the distributions of two variables have the same form and parameters."""
    if one.type != other.type or type(one.owner.op) is not type(other.owner.op):
        return False
    first, second = (
        [x for x in rv.owner.inputs if not isinstance(x.type, RandomType)] for rv in (one, other)
    )
    return len(first) == len(second) and equal_computations(first, second)


def _places_by_count(draws: Draws, alike: Sequence[Sequence[str]]) -> dict[int, list[Place]]:
    """Where labels may be, by their number."""
    found: dict[int, list[Place]] = {}
    for name, values in draws.items():
        for number, length in enumerate(values.shape[1:]):
            if 2 <= length <= MOST_LABELS:
                found.setdefault(length, []).append(Axis(name, number))
    for names in alike:
        for count in range(2, min(len(names), MOST_LABELS) + 1):
            groups = [Scalars(some) for some in combinations(names, count)]
            if len(groups) + len(found.get(count, [])) <= MOST_PLACES:
                found.setdefault(count, []).extend(groups)
    shares = [Share(name) for name, values in draws.items() if _is_share(values)]
    if 2 in found and len(shares) + len(found[2]) <= MOST_PLACES:
        found[2].extend(shares)
    return found


def _is_share(values: Array) -> bool:
    return values.ndim == 1 and bool(((values > 0.0) & (values < 1.0)).all())


def _invariant_places(
    test: "_InvarianceTest", places: Sequence[Place], count: int, taken: set[Axis | str]
) -> Iterator[tuple[Place, ...]]:
    """Yield the smallest disjoint sets of places whose labels may be exchanged, and take them.

    Of many places only all together are tried.
    """
    sizes = range(1, len(places) + 1) if len(places) <= MOST_PLACES else [len(places)]
    for size in sizes:
        for some in combinations(places, size):
            parts = [part for place in some for part in place.parts]
            if len(set(parts)) < len(parts) or taken & set(parts):
                continue
            if test.is_invariant(some, count):
                taken |= set(parts)
                yield some


class _InvarianceTest:
    """Whether permutations leave the density the same at some draws.

    The density is that of the parameters as they are, without transforms: those may keep an order.
    """

    def __init__(self, model: pm.Model, draws: Draws, rng: np.random.Generator) -> None:
        example = {name: values[0] for name, values in draws.items()}
        self._density = ConstrainedDensity(model, example)
        n_draws = len(next(iter(draws.values())))
        chosen = rng.choice(n_draws, N_POINTS, replace=False)
        self._points = {name: values[chosen] for name, values in draws.items()}
        self._rng = rng
        self._before = self._values(self._points)

    def is_invariant(self, places: Sequence[Place], count: int) -> bool:
        """Whether all permutations of the labels do: those of two neighbours generate them."""
        return all(self._is_same_with(places, count, i) for i in range(count - 1))

    def _is_same_with(self, places: Sequence[Place], count: int, label: int) -> bool:
        """Whether the label and the next one may be exchanged."""
        order = np.arange(count)
        order[[label, label + 1]] = label + 1, label
        points: Draws = self._points
        for place in places:
            points = place.permuted(points, order)
        with np.errstate(invalid="ignore"):
            change = self._values(points) - self._before
        if not np.isfinite(change).all():
            return False
        error = change.std(axis=0, ddof=1) / len(change) ** 0.5 if len(change) > 1 else 0.0
        rounding = ROUNDING * (10.0 + np.abs(self._before).max())
        is_small = np.abs(change.mean(axis=0)) <= rounding + 4.0 * error
        return bool(is_small.all() and np.max(error) <= MAX_ERROR)

    def _values(self, points: Draws) -> Array:
        """Log-densities of the points, a row for each noise."""
        x = np.concatenate([values.reshape(N_POINTS, -1) for values in points.values()], axis=1)
        n_noises = len(self._density.seed_names)
        n_rows = N_SEEDS if n_noises else 1
        seeds = self._rng.integers(np.iinfo(np.int64).max, size=(n_rows * N_POINTS, n_noises))
        return self._density.evaluate(np.tile(x, (n_rows, 1)), seeds).reshape(n_rows, N_POINTS)


def _found(
    model: pm.Model, draws: Draws, count: int, places: tuple[Place, ...], best: int
) -> Labels:
    axes = [place for place in places if isinstance(place, Axis)]
    ordered = tuple(axis.name for axis in axes if _keeps_order(model, draws, axis))
    visited = 0.0 if ordered else _log_visited(_features(draws, places), best)
    return Labels(count, places, float(gammaln(count + 1)) - visited, ordered)


def _keeps_order(model: pm.Model, draws: Draws, axis: Axis) -> bool:
    """Whether a transform keeps the draws in ascending order along an axis."""
    is_sorted = (np.diff(draws[axis.name], axis=axis.number + 1) > 0.0).all()
    return bool(is_sorted and is_restricted(model[axis.name], model))


def _features(draws: Draws, places: Sequence[Place]) -> Array:
    """What each draw says of each label, (draw, label, feature): of a matrix the diagonal."""
    axes = [place for place in places if isinstance(place, Axis)]
    columns = [
        np.stack([draws[name] for name in place.names], axis=1)[:, :, np.newaxis]
        for place in places
        if isinstance(place, Scalars)
    ]
    shares = [draws[place.name] for place in places if isinstance(place, Share)]
    columns += [np.stack([share, 1.0 - share], axis=1)[:, :, np.newaxis] for share in shares]
    for name in dict.fromkeys(axis.name for axis in axes):
        numbers = [axis.number + 1 for axis in axes if axis.name == name]
        values = np.moveaxis(draws[name], numbers, range(1, 1 + len(numbers)))
        label = np.arange(values.shape[1])
        diagonal: tuple[Any, ...] = (slice(None), *[label] * len(numbers))
        own = values[diagonal]
        columns.append(own.reshape(*own.shape[:2], -1))
    return np.concatenate(columns, axis=2)


def _log_visited(features: Array, best: int) -> float:
    """Logarithm of the number of orders that the draws visit, told by the draw of most density.

    Labels that ever take each other's place are taken to visit all orders among themselves.
    """
    count, reference = features.shape[1], features[best]
    chosen = features[:: -(-len(features) // N_ORDERED)]
    scale = features.std(axis=(0, 1))
    for _ in range(N_RELABELLED):
        scale = np.where(scale > 0.0, scale, 1.0)
        distances = (((chosen[:, :, None] - reference) / scale) ** 2).sum(axis=-1)
        orders = np.array([linear_sum_assignment(one.T)[1] for one in distances])
        relabelled = np.take_along_axis(chosen, orders[:, :, None], axis=1)
        # A feature tells labels apart if it varies less within them than between them.
        reference, scale = relabelled.mean(axis=0), relabelled.std(axis=0).mean(axis=0)
    share = np.array([(orders == label).mean(axis=0) for label in range(count)])
    _, group = connected_components(share > RARELY / count, directed=False)
    return float(gammaln(np.bincount(group) + 1.0).sum())


def _constant_potentials(model: pm.Model) -> float:
    """The sum of the Potentials that depend on no variable of the model."""
    variables = set(model.basic_RVs)
    constant = [one for one in model.potentials if not variables & set(ancestors([one]))]
    return float(sum(one.sum().eval(mode="FAST_COMPILE") for one in constant))
