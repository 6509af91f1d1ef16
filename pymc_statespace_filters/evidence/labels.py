"""Labels in variables of a model, and whether their exchange leaves its density the same."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from scipy.special import gammaln

from ..pymc_model.density import ConstrainedDensity, ModelDensity
from ..pymc_model.posterior_draws import unconstrained

N_POINTS, N_SEEDS = 4, 8  # draws at which densities are compared; estimates of a noisy one
ROUNDING, MAX_ERROR = 1e-7, 1.0  # relative; in nats, of a noisy difference

Array = NDArray[np.float64]
Key = str | tuple[str, ...]


@dataclass(frozen=True)
class Labels:
    """K labels in some variables of a model.

    ``axes`` has the axes of arrays along which they are; none of the share w of the first of two
    labels, of which the other one has 1 - w. In ``scalars`` each variable has a label.
    """

    count: int
    axes: Mapping[str, tuple[int, ...]]
    scalars: tuple[tuple[str, ...], ...]

    @property
    def keys(self) -> list[Key]:
        """How they are declared."""
        return [*self.axes, *self.scalars]

    def sorted_by(self, model: pm.Model) -> list[Key]:
        """What tells the order of labels: on the unconstrained space it is the same."""
        return [
            key
            for key in self.keys
            if isinstance(key, tuple)
            or (len(self.axes[key]) == 1 and model[key].owner.op.ndim_supp == 0)
        ]

    @property
    def names(self) -> set[str]:
        """The variables."""
        return {name for names in self.scalars for name in names} | set(self.axes)

    @property
    def log_orders(self) -> float:
        """The logarithm of K!."""
        return float(gammaln(self.count + 1))

    def permuted(self, values: Mapping[str, Array], order: NDArray[np.int64]) -> dict[str, Array]:
        """Values (n, ...) of variables with the labels in orders (n, K)."""
        found = dict(values)
        for name, axes in self.axes.items():
            if not axes:
                found[name] = np.where(order[:, 0] == 0, found[name], 1.0 - found[name])
            for axis in axes:
                shape = [self.count if i == axis else 1 for i in range(found[name].ndim - 1)]
                index = order.reshape(-1, *shape)
                found[name] = np.take_along_axis(found[name], index, axis + 1)
        for names in self.scalars:
            each = np.take_along_axis(np.stack([found[name] for name in names], 1), order, 1)
            found |= dict(zip(names, each.T, strict=True))
        return found

    def of_labels(self, key: Key, values: Mapping[str, Array]) -> Array:
        """A value of each label (n, K): the first of several, the diagonal of a matrix."""
        if isinstance(key, tuple):
            return np.stack([values[name] for name in key], axis=1)
        if not self.axes[key]:
            return np.stack([values[key], 1.0 - values[key]], axis=1)
        label = np.arange(self.count)
        index = [label if i in self.axes[key] else 0 for i in range(values[key].ndim - 1)]
        return np.asarray(values[key][(slice(None), *index)])


def placements(
    keys: Sequence[Key], count: int, model: pm.Model, values: Mapping[str, Array]
) -> Iterator[Labels]:
    """What so many labels of all of these may be; their order is told by one of them.

    The values (n, ...) of the variables have their shapes.
    """
    scalars = tuple(key for key in keys if isinstance(key, tuple))
    arrays = [key for key in keys if isinstance(key, str)]
    if any(len(names) != count for names in scalars):
        return
    for axes in product(*(_axes(values[name].shape[1:], count) for name in arrays)):
        labels = Labels(count, dict(zip(arrays, axes, strict=True)), scalars)
        if labels.sorted_by(model):
            yield labels


def _axes(shape: Sequence[int], count: int) -> list[tuple[int, ...]]:
    along = [i for i, length in enumerate(shape) if length == count]
    if len(shape) == 0 and count == 2:
        return [()]
    return [some for size in range(len(along), 0, -1) for some in combinations(along, size)]


def are_symmetric(
    tried: Sequence[Labels],
    density: ModelDensity,
    values: Mapping[str, Array],
    rng: np.random.Generator,
    *,
    as_they_are: bool = False,
) -> NDArray[np.bool_]:
    """Whether the density of some draws is the same with labels exchanged.

    By an exchange of the first two and a rotation of all, which generate all orders. The density is
    that of the variables ``as_they_are`` where a transform would keep an order of them.
    """
    n_seeds = N_SEEDS if density.seed_names else 1
    chosen = np.tile(rng.integers(len(next(iter(values.values()))), size=N_POINTS), n_seeds)
    points = {name: of_name[chosen] for name, of_name in values.items()}
    moved, of = [points], list[int]()
    for i, one in enumerate(tried):
        labels = range(one.count)
        for order in dict.fromkeys([(1, 0, *labels[2:]), (*labels[1:], 0)]):  # the same of two
            moved.append(one.permuted(points, np.tile(order, (len(chosen), 1))))
            of.append(i)
    joined = {name: np.concatenate([one[name] for one in moved]) for name in points}
    if as_they_are:
        example = {name: of_name[0] for name, of_name in points.items()}
        evaluate = ConstrainedDensity(density.model, example).evaluate
        x = np.concatenate([one.reshape(len(one), -1) for one in joined.values()], axis=1)
    else:
        evaluate, x = density.evaluate, unconstrained(density.model, joined)
    at, inside = np.full(len(x), np.nan), np.isfinite(x).all(axis=1)
    seeds = density.fresh_seeds(len(x), rng)
    at[inside] = evaluate(x[inside], seeds[inside])
    before, after = np.split(at.reshape(-1, n_seeds, N_POINTS), [1])
    with np.errstate(invalid="ignore"):  # of infinities, which tell nothing
        change = after - before
        error = change.std(axis=1, ddof=1) / n_seeds**0.5 if n_seeds > 1 else 0.0
        rounding = ROUNDING * (10.0 + np.abs(before).max())
        is_same = (np.abs(change.mean(axis=1)) <= rounding + 4.0 * error) & (error <= MAX_ERROR)
    found = np.ones(len(tried), dtype=bool)
    np.logical_and.at(found, of, is_same.all(axis=1))
    return found
