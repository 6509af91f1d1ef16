"""What an absent term leaves without a use, such as the gap of a spring that is not there.

The distribution of such a variable is its prior, which integrates to one: it is drawn from the
prior, and its density is no part of a weight. That covers the scale of slabs, used by the priors of
absent terms alone, and the constants of a term, used inside the likelihood. Which variables a term
uses is found by changing them: what no term uses alone, and nothing without terms, is taken for
unused, unless the density of the sub-model changes with it.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pytensor.graph.traversal import ancestors

from ..errors import ModelError
from ..pymc_model.prior import ModelPrior, is_improper
from .density import Array, Columns, Point, Sets, SubmodelDensity

N_POINTS = 3  # at which a variable is changed
SAME = 1e-9  # relative, between densities that count as equal
POOL = 1000  # draws of the prior


@dataclass(frozen=True)
class Uses:
    """Which blocks of a model's variables its terms use.

    Attributes
    ----------
    always : ndarray of bool (blocks,)
        Those that matter where all terms are absent, and those of candidates with an effect.
    by_one : ndarray of bool (K, blocks)
        Those that matter where one term alone is present.
    may_be_unused : ndarray of bool (blocks,)
        Those whose prior can be sampled.
    parents : ndarray of bool (blocks, blocks)
        On which others (columns) the prior of a block (row) depends.
    """

    always: NDArray[np.bool_]
    by_one: NDArray[np.bool_]
    may_be_unused: NDArray[np.bool_]
    parents: NDArray[np.bool_]

    def unused(self, present: Sets) -> NDArray[np.bool_]:
        """The blocks (blocks,) that a sub-model does not use."""
        unused = self.may_be_unused & ~self.always & ~self.by_one[present].any(axis=0)
        # Given a parent that is used, a variable has another law than its prior draws.
        while (barred := unused & (self.parents & ~unused).any(axis=1)).any():
            unused = unused & ~barred
        return unused


def find_uses(density: SubmodelDensity, draws: Array, rng: np.random.Generator) -> Uses:
    """Change every block in turn at some draws (n, k), with each term alone and with none.

    Raises
    ------
    ModelError
        If two candidates switch off the same term.
    """
    n = len(density.candidates)
    sets = np.concatenate([np.zeros((1, n), dtype=bool), np.eye(n, dtype=bool)])
    matters = _matters(density, draws, sets, rng)
    always, by_one = matters[0].copy(), matters[1:]
    for own, matter in zip(_own_blocks(density), by_one, strict=True):
        always[own] |= matter[own]
    uses = Uses(always, by_one, *_of_variables(density, always))
    _check_distinct(density, draws, uses, rng)
    return uses


def _own_blocks(density: SubmodelDensity) -> list[Columns]:
    """The blocks of every candidate."""
    return [np.unique(density.blocks[one]) for one in density.candidates.switches.columns]


def _matters(
    density: SubmodelDensity, draws: Array, sets: Sets, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Whether changing a block changes what is left of the density without its prior.

    Of each set of terms (s, K) and block: (s, blocks).
    """
    n_blocks = density.n_blocks
    at, other = draws[rng.integers(len(draws), size=(2, N_POINTS))]
    # Point by point: as it is, and with one block after the other changed.
    changed = np.where(
        (np.arange(-1, n_blocks)[:, None] == density.blocks)[None], other[:, None], at[:, None]
    )
    seeds = density.fresh_seeds(N_POINTS, rng)
    shape = (len(sets), N_POINTS, n_blocks + 1)
    x = np.broadcast_to(changed, (len(sets), *changed.shape))
    present = np.broadcast_to(sets[:, None, None], (*shape, sets.shape[1]))
    noise = np.broadcast_to(seeds[None, :, None], (*shape, seeds.shape[1]))
    found = density.evaluate(Point(_flat(x), _flat(present), _flat(noise)))
    log_density, own = found.total.reshape(shape), found.own.reshape(*shape, n_blocks)
    with np.errstate(invalid="ignore"):  # of infinities, which tell nothing
        before = log_density[..., :1] - own[..., 0, :]
        after = log_density[..., 1:] - np.diagonal(own[..., 1:, :], axis1=-2, axis2=-1)
    return np.asarray((~same(before, after)).any(axis=1))


def _flat(values: NDArray[Any]) -> NDArray[Any]:
    """All axes but the last one together."""
    return values.reshape(math.prod(values.shape[:-1]), values.shape[-1])


def same(a: Array, b: Array) -> NDArray[np.bool_]:
    """Whether log-densities are equal but for rounding."""
    with np.errstate(invalid="ignore"):  # of infinities, which tell nothing
        return np.asarray(np.abs(a - b) <= SAME * (1 + np.abs(a)))


def _of_variables(
    density: SubmodelDensity, matter: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which blocks have a prior that can be sampled, and on which others each of them depends.

    Those that always ``matter`` are not examined.
    """
    model, n_blocks = density.model, density.n_blocks
    blocks = dict(_blocks_by_variable(density))
    sampled = np.zeros(n_blocks, dtype=bool)
    parents = np.zeros((n_blocks, n_blocks), dtype=bool)
    for rv in model.free_RVs:
        if not matter[blocks[rv.name]].all():
            sampled[blocks[rv.name]] = not is_improper(rv, model)
        above = set(ancestors([rv])) & (set(model.free_RVs) - {rv})
        for other in above:
            parents[np.ix_(blocks[rv.name], blocks[other.name])] = True
    return sampled, parents


def _blocks_by_variable(density: SubmodelDensity) -> Iterator[tuple[str, Columns]]:
    start, first = density.model.initial_point(), 0
    for rv in density.model.free_RVs:
        size = start[density.model.rvs_to_values[rv].name].size
        yield rv.name, np.unique(density.blocks[first : first + size])
        first += size


def _check_distinct(
    density: SubmodelDensity, draws: Array, uses: Uses, rng: np.random.Generator
) -> None:
    """Raise if two candidates have an effect together, but neither has one without the other.

    The square of a state that nothing has moved has no effect either, but all terms move it.
    """
    n = len(density.candidates)
    own = _own_blocks(density)
    idle = [j for j in range(n) if not uses.by_one[j, own[j]].any()]
    pairs = [(a, b) for a in idle for b in idle if a < b]
    if not pairs:
        return
    both = np.zeros((len(pairs), n), dtype=bool)
    for row, pair in zip(both, pairs, strict=True):
        row[list(pair)] = True
    together = _matters(density, draws, both, rng)
    pairs = [
        (a, b)
        for (a, b), matters in zip(pairs, together, strict=True)
        if matters[own[a]].any() and matters[own[b]].any()
    ]
    if not pairs:
        return
    without = _matters(density, draws, ~np.eye(n, dtype=bool), rng)
    for a, b in pairs:
        if not (without[b, own[a]].any() or without[a, own[b]].any()):
            first, second = (density.candidates.keys[i] for i in (a, b))
            raise ModelError(
                f"absent must have one candidate for a term: {first!r} and {second!r} switch off "
                "the same one, as neither has an effect without the other. Leave one of them out, "
                f"or give the tuple {(*_names(first), *_names(second))}"
            )


def _names(key: str | tuple[str, ...]) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key


def prior_pool(density: SubmodelDensity, uses: Uses, rng: np.random.Generator) -> Array:
    """Draws (POOL, k) of the prior of the variables that some sub-model does not use.

    Other columns are zero.
    """
    needed = uses.may_be_unused & ~uses.always
    blocks = {name: of for name, of in _blocks_by_variable(density) if needed[of].any()}
    pool = np.zeros((POOL, len(density.blocks)))
    if blocks:
        variables = [rv for rv in density.model.free_RVs if rv.name in blocks]
        chosen = np.isin(density.blocks, np.concatenate(list(blocks.values())))
        pool[:, chosen] = ModelPrior(density.model, variables).sample(POOL, rng)
    return pool
