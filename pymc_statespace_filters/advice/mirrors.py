"""Mirror images of a posterior: which signs turn together, which chains are where, what helps."""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pymc.model import Model

from ..checks.coverage.mirrors import Density, Mirror, mirrors_of
from ..pymc_model.at_points import ConstrainedValues
from ..pymc_model.elements import Elements, places_in_vector
from ..sampling.output.convergence import convergence
from ..sampling.output.facts import EndedRun
from ..tables import joined
from .signs import sign_text

_MOST_NAMED = 6  # elements
_AT_ONCE = 64  # points, after which the time is looked at
_ALL = 0.95  # of the draws of a chain, that is said to be in an image

Array = NDArray[np.float64]


def mirrors_within(seconds: float, model: Model, draws: Array, evaluate: Density) -> list[Mirror]:
    """The mirrors of draws (chain, draw, k) that are found in so many CPU seconds."""
    end, found = time.process_time() + seconds, list[Mirror]()

    def in_time(x: Array) -> Array:
        parts = list[Array]()
        for first in range(0, len(x), _AT_ONCE):
            if time.process_time() > end:
                raise TimeoutError
            parts.append(evaluate(x[first : first + _AT_ONCE]))
        return np.concatenate(parts)

    with suppress(TimeoutError):
        for mirror in mirrors_of(draws, _have_signs(model, draws[0, -1]), in_time):
            found.append(mirror)
    return found


def _have_signs(model: Model, x: Array) -> NDArray[np.bool_]:
    """The elements (k,) whose sign on the unconstrained space is that of the parameter."""
    at, have_signs = ConstrainedValues(model), np.zeros(len(x), dtype=bool)
    values, opposite = at(x), at(-x)
    for name, columns in places_in_vector(model).items():
        if columns.size == values[name].size:
            have_signs[columns] = np.isclose(values[name], -opposite[name], rtol=1e-9, atol=0.0)
    return have_signs


def mirror_sentence(model: Model, mirror: Mirror) -> str:
    """Say where the chains are, which signs turn, and which prior keeps one image."""
    names, share = Elements.of(model).labels, mirror.share
    first, *others = turned = [names[i] for i in mirror.turned]
    if mirror.is_split and not others:
        return sign_text(first, float(share.mean()))
    where, so = "all chains are in one of", "means, intervals and the evidence lack the other"
    here, there = ([str(i) for i in np.flatnonzero(of > _ALL)] for of in (1 - share, share))
    if mirror.is_split:
        where, so = "the chains pass between", "means say nothing, and longer chains do not help"
        if here and there and len(here) + len(there) == len(share):
            where = f"chains {joined(here)} are in one and {joined(there)} in the other of"
    if len(turned) > _MOST_NAMED:
        turned[_MOST_NAMED:] = [f"{len(turned) - _MOST_NAMED} others"]
    signs = f"signs of {joined(turned)} turned together" if others else f"sign of {first} turned"
    cure = f"give {first}, which is clear of zero, a prior of one sign (pm.HalfNormal)"
    if first.endswith("]"):
        cure = cure.removesuffix("pm.HalfNormal)") + (
            "in a vector pm.TruncatedNormal with lower=0 for it and -np.inf for the others, and "
            "default_transform=None)"
        )
    if not mirror.is_clear:
        cure = (
            "none of them is clear of zero, so give a sign to something else that turns, as the "
            "slope of a field in a state that is not measured "
            '(pm.Potential("one", pm.math.switch(slope > 0, 0.0, -np.inf)))'
        )
    return (
        f"{where} two mirror images of the posterior: its density is the same with the {signs}, so "
        f"that {so}; {cure}"
    )


def in_one_image[Run: EndedRun](fact: Run, mirrors: Sequence[Mirror]) -> Run:
    """A run as it would be with all draws in one image, if they are not."""
    if fact.convergence is None or not any(mirror.is_split for mirror in mirrors):
        return fact
    folded = mirrors[-1].folded
    positions = folded.reshape(-1, folded.shape[-1])
    return replace(fact, convergence=convergence(list(folded)), positions=positions)


def of_one_image(texts: Sequence[str], is_split: bool) -> list[str]:
    """What is said of such a run."""
    return [f"In one image, {t[0].lower()}{t[1:]}" for t in texts] if is_split else list(texts)
