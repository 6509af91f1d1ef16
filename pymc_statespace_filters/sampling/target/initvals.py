"""Where the chains of a run may start: what the user gave, or draws from the prior."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from pymc.initial_point import make_initial_point_fns_per_chain
from pymc.model import Model

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling.target.target import Target


def chain_starts(
    model: Model,
    target: Target,
    initvals: Any,
    seeds: Sequence[np.random.SeedSequence],
    *,
    disperse: bool,
) -> list[Callable[[np.random.Generator], Sequence[np.ndarray]]]:
    """For each chain, a function from its generator to the candidates for its start.

    Parameters
    ----------
    model : pymc.Model
    target : Target
    initvals : None, mapping, or sequence of these
        As in ``pm.sample``.
    seeds : sequence of numpy.random.SeedSequence
        Of the chains.
    disperse : bool
        Whether candidates are drawn from the prior where no values were given.

    Raises
    ------
    ModelError
        If the values do not fit the model.
    """
    _check_initvals(model, initvals, len(seeds))
    points = make_initial_point_fns_per_chain(
        model=model, overrides=initvals, jitter_rvs=set(), chains=len(seeds)
    )
    disperse = disperse and initvals is None

    def candidates(start: np.ndarray, rng: np.random.Generator) -> Sequence[np.ndarray]:
        return target.starts.candidates(start, rng) if disperse else [start]

    # Here and now: chains would call PyMC's functions from several threads at once.
    starts = [
        target.held.join(point(int(seed.generate_state(1)[0])))
        for point, seed in zip(points, seeds, strict=True)
    ]
    return [partial(candidates, start) for start in starts]


def _check_initvals(model: Model, initvals: Any, chains: int) -> None:
    one_for_all = initvals is None or isinstance(initvals, Mapping)
    if not one_for_all:
        if not isinstance(initvals, list | tuple):
            raise ModelError(f"initvals={initvals!r}: expected a mapping, or one for each chain")
        if len(initvals) != chains:
            raise ModelError(f"initvals are for {len(initvals)} chains, chains={chains}")
    known = {name for v, rv in model.values_to_rvs.items() for name in (v.name, rv.name)}
    for given in [initvals] if one_for_all else initvals:
        if unknown := [str(name) for name in given or () if str(name) not in known]:
            raise ModelError(
                f"initvals: {unknown[0]!r} is not a free variable of the model, which are "
                f"{', '.join(rv.name for rv in model.free_RVs)}"
            )
