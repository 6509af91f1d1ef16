"""Labels that may be exchanged, as those of regimes, and an evidence that counts all their orders.

If the density of a model stays the same when K labels are permuted in all variables that have them,
its posterior has K! equal parts. Draws that stay in one part, and an ordering transform, which
leaves one part of the prior, lack ln K! of the evidence. Where labels are declared, every draw is
brought into one order, the density is zero in all others, and ln K! is added: that is the evidence
whichever parts the draws have visited. Where they are not, exchanges of labels at a few draws tell
that they should be.

S. Chib, "Marginal likelihood from the Gibbs output", J. Am. Stat. Assoc. 90 (1995), whose estimate
was corrected so by R. M. Neal, "Erroneous results in 'Marginal likelihood from the Gibbs output'"
(1999); S. Frühwirth-Schnatter, "Estimating marginal likelihoods for mixture and Markov switching
models", Econometrics Journal 7 (2004).
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from pytensor.graph.basic import Variable, equal_computations
from pytensor.tensor.random.type import RandomType

from ..errors import ModelError
from ..pymc_model.density import ModelDensity
from ..pymc_model.elements import places_in_vector
from ..pymc_model.posterior_draws import unconstrained
from ..pymc_model.prior import is_restricted
from .labels import Array, Key, Labels, are_symmetric, placements
from .posterior import Posterior

MOST_LABELS, MOST_PLACES = 8, 6  # of labels that are not declared
RARELY = 0.1  # of the share of an order, if all were visited equally


class OneOrder:
    """Draws and density of declared labels in one order: ascending in the first variable of them.

    ``exchangeable`` is as of `estimate_evidence`; ``ordered`` are the variables that a transform
    keeps in order, so that nothing needs to be sorted. Raises `ModelError` if the argument is
    invalid, or the density changes where labels are exchanged.
    """

    def __init__(
        self, exchangeable: Any, density: ModelDensity, idata: xr.DataTree, rng: np.random.Generator
    ) -> None:
        model, values = density.model, _flat_values(density.model, idata)
        keys = exchangeable if isinstance(exchangeable, list | tuple) else [exchangeable]
        given = [tuple(key) if isinstance(key, list) else key for key in keys]
        tried = _declared(given, model, values)
        self.ordered = [
            name
            for name in tried[0].axes
            if (np.diff(tried[0].of_labels(name, values)) > 0.0).all()
            and is_restricted(model[name], model)
        ]
        is_symmetric = are_symmetric(tried, density, values, rng, as_they_are=bool(self.ordered))
        if not is_symmetric.any():
            raise ModelError(
                f"exchangeable must name labels whose exchange leaves the density as it is, got "
                f"{given}: name all variables that have the labels, and give these one prior"
            )
        self.labels = tried[int(is_symmetric.argmax())]
        self._model, self._values = model, values
        self._key = self.labels.sorted_by(model)[0]

    def sorted_draws(self, posterior: Posterior) -> Posterior:
        """The posterior with every draw in this order."""
        if self.ordered:
            return posterior
        order = np.argsort(self.labels.of_labels(self._key, self._values), axis=1)
        draws = unconstrained(self._model, self.labels.permuted(self._values, order))
        return replace(posterior, draws=draws.reshape(posterior.draws.shape))

    def restricted(self, posterior: Posterior) -> Posterior:
        """The posterior with a density of zero in other orders."""
        if self.ordered:
            return posterior
        places: dict[str, Any] = places_in_vector(self._model)
        numbers = {name: at[None] for name, at in places.items()}
        [columns] = self.labels.of_labels(self._key, numbers)

        def evaluate(x: Array, rng: np.random.Generator) -> Array:
            found = np.full(len(x), -np.inf)
            is_sorted = (np.diff(x[:, columns], axis=1) > 0.0).all(axis=1)
            found[is_sorted] = posterior.evaluate(x[is_sorted], rng)
            return found

        return replace(posterior, evaluate=evaluate)


def undeclared_labels(
    density: ModelDensity, idata: xr.DataTree, rng: np.random.Generator
) -> Iterator[str]:
    """Yield what is doubtful of labels that may be exchanged, unless the draws visit all orders."""
    model, values = density.model, _flat_values(density.model, idata)
    taken: set[str] = set()
    possible = _possible_keys(model, values)
    for count in sorted(possible, reverse=True):  # two of three scalars are no labels of their own
        keys = possible[count]
        sizes = range(1, len(keys) + 1) if len(keys) <= MOST_PLACES else [len(keys)]
        subsets = [some for size in sizes for some in combinations(keys, size)]
        tried = [one for some in subsets for one in placements(some, count, model, values)]
        for i in np.flatnonzero(are_symmetric(tried, density, values, rng)):
            if taken & (one := tried[i]).names:
                continue
            taken |= one.names
            if not all(_has_all_orders(one.of_labels(key, values)) for key in one.keys):
                yield (
                    f"the {count} labels of {', '.join(sorted(one.names))} may be exchanged, and "
                    f"draws that do not visit all orders of them lack up to ln {count}! = "
                    f"{one.log_orders:.3f} of the log-evidence: give exchangeable={one.keys}, "
                    "which counts them all"
                )


def _flat_values(model: pm.Model, idata: xr.DataTree) -> dict[str, Array]:
    """The draws of the free variables, one after the other."""
    posterior = idata["posterior"].to_dataset().transpose("chain", "draw", ...)
    return {rv.name: np.concatenate(posterior[rv.name].values) for rv in model.free_RVs}


def _declared(given: Sequence[Any], model: pm.Model, values: Mapping[str, Array]) -> list[Labels]:
    """All that the names may mean: a matrix may have labels along one axis or both."""
    names = [name for key in given for name in (key if isinstance(key, tuple) else (key,))]
    if unknown := [name for name in names if name not in values]:
        raise ModelError(
            f"exchangeable must name free variables of the model, {list(values)}, got {unknown}"
        )
    counts = {len(key) for key in given if isinstance(key, tuple)}
    counts |= {n for name in names for n in values[name].shape[1:]}
    found = [
        one for count in sorted(counts - {1}) for one in placements(given, count, model, values)
    ]
    if not found:
        raise ModelError(
            "exchangeable must name a vector, or a tuple of scalars in a list, as [('low', 'high')]"
            ", and other variables with as many labels: along an axis, or the share of the first "
            f"of two; got {given}"
        )
    return found


def _possible_keys(model: pm.Model, values: Mapping[str, Array]) -> dict[int, list[Key]]:
    """The variables that may have labels, by the number of these."""
    found: dict[int, list[Key]] = {}
    scalars = [rv for rv in model.free_RVs if rv.ndim == 0]
    for name, of_name in values.items():
        for length in {n for n in of_name.shape[1:] if 2 <= n <= MOST_LABELS}:
            found.setdefault(length, []).append(name)
    while scalars:
        alike = tuple(rv.name for rv in scalars if _have_one_prior(scalars[0], rv))
        scalars = [rv for rv in scalars if rv.name not in alike]
        for count in range(2, min(len(alike), MOST_LABELS) + 1):
            groups = list(combinations(alike, count))
            if len(groups) + len(found.get(count, [])) <= MOST_PLACES:
                found.setdefault(count, []).extend(groups)
    if 2 in found:
        found[2] += [
            name
            for name, of_name in values.items()
            if of_name.ndim == 1 and ((of_name > 0.0) & (of_name < 1.0)).all()
        ][: MOST_PLACES - len(found[2])]
    return found


def _have_one_prior(one: Variable, other: Variable) -> bool:
    """Whether the distributions of two variables have the same form and parameters."""
    if one.type != other.type or type(one.owner.op) is not type(other.owner.op):
        return False
    first, second = (
        [x for x in rv.owner.inputs if not isinstance(x.type, RandomType)] for rv in (one, other)
    )
    return len(first) == len(second) and equal_computations(first, second)


def _has_all_orders(values: Array) -> bool:
    """Whether values (n, K) of labels are in every order, and in none of them rarely.

    Of each three labels, as no draws suffice for all orders of eight.
    """
    n, count = values.shape
    at_once = min(count, 3)
    n_orders = math.factorial(at_once)
    for some in combinations(range(count), at_once):
        order = np.argsort(values[:, some], axis=1)
        _, visits = np.unique(order, axis=0, return_counts=True)
        if len(visits) < n_orders or visits.min() < RARELY * n / n_orders:
            return False
    return True
