"""The check in words: which parameter of a model, where, and how much is missing.

The words are stored with the draws, so that the evidence need not look again.
"""

import json
import time
from collections.abc import Sequence

import numpy as np
import pymc as pm
import xarray as xr
from numpy.typing import NDArray

from ...pymc_model.at_points import ConstrainedValues
from ...pymc_model.elements import element_names, places_in_vector
from . import ALL_MODES
from .check import MissedTail, missed_tails
from .copies import missed_copy
from .missed_modes import MissedMode
from .tail_proposals import Evaluate

ATTRIBUTE = "unvisited"  # of results, a JSON text
N_SHOWN = 4  # elements of a point
MOST_DRAWS = 20_000  # that are looked at
N_TIMED, N_PARTS = 40, 3  # evaluations whose time is measured; a pause may fall into one part
N_FAR = 10  # the same, at points of the prior

Array = NDArray[np.float64]


def unvisited(
    model: pm.Model,
    draws: Array,
    log_density: Array,
    evaluate: Evaluate,
    seconds: float,
    rng: np.random.Generator,
    prior: Array | None = None,
) -> list[str]:
    """Say which mode the draws have missed, see `missed_copy`, or of which tails they lack a part.

    ``seconds`` of CPU time are for all evaluations of either look. Without draws of the ``prior``
    (m, k) there is no look for modes.
    """
    step = max(1, -(-log_density.size // MOST_DRAWS))
    draws, log_density = draws[:, ::step], log_density[:, ::step]
    x = draws.reshape(-1, draws.shape[-1])
    timed = x[:: max(1, len(x) // N_TIMED)]
    evaluate(timed[:1], rng)  # the first call may compile
    each = min(_seconds_of_each(evaluate, part, rng) for part in np.array_split(timed, N_PARTS))
    n_evaluations = seconds / max(each, 1e-7)
    sentences = [
        _sentence(model, one)
        for one in missed_tails(draws, log_density, evaluate, n_evaluations, rng)
    ]
    if prior is not None:
        shapes = [at.shape for at in places_in_vector(model).values()]
        # A grid, for example, has more points where the noise is small.
        far = _seconds_of_each(evaluate, prior[:: -(-len(prior) // N_FAR)], rng)
        n_evaluations = seconds / max(each, far, 1e-7)
        copy = missed_copy(draws, log_density, prior, shapes, evaluate, n_evaluations, rng)
        if copy is not None:  # a tail that leads there is a part of the same
            return [_sentence_of_copy(model, copy)]
    return sentences


def _seconds_of_each(evaluate: Evaluate, x: Array, rng: np.random.Generator) -> float:
    began = time.process_time()
    evaluate(x, rng)
    return (time.process_time() - began) / len(x)


def store(idata: xr.DataTree, sentences: Sequence[str]) -> None:
    """Keep the outcome with the draws."""
    idata.attrs[ATTRIBUTE] = json.dumps(list(sentences))


def stored(idata: xr.DataTree) -> list[str] | None:
    """The outcome that is kept with the draws; None if they were not checked."""
    return json.loads(idata.attrs[ATTRIBUTE]) if ATTRIBUTE in idata.attrs else None


def _sentence(model: pm.Model, missed: MissedTail) -> str:
    index = missed.tail.parameter
    name = element_names(model)[index]
    where = _where(model, missed)
    return (
        f"the chains have missed a part of the posterior {where.format(name=name)}: "
        f"{missed.draws:.1%} of the draws lie there, and at least {missed.posterior:.1%} of the "
        f"posterior ({missed.errors:.1f} standard errors more), so that means, intervals and the "
        "evidence lack it; reparametrise the model there (a non-centred form of a hierarchical "
        "one), or draw longer chains"
    )


def _sentence_of_copy(model: pm.Model, missed: MissedMode) -> str:
    return (
        f"the chains have missed a separate mode of the posterior around "
        f"{_point(model, missed.centre)}: {missed.share:.1%} of the draws lie there, and at least "
        f"{missed.posterior:.1%} of the posterior ({missed.errors:.1f} standard errors more), so "
        f"that means, intervals and the evidence lack it; {ALL_MODES}, or "
        "let the prior exclude all but one"
    )


def sentence_of_mode(model: pm.Model, missed: MissedMode, draws: int) -> str:
    """Say where particles lack a part of the posterior, of populations of so many draws."""
    return (
        f"the particles have missed a part of the posterior around {_point(model, missed.centre)}: "
        f"{missed.share:.1%} of them lie there, and at least {missed.posterior:.1%} of the "
        f"posterior ({missed.errors:.1f} standard errors more), so that means, intervals and the "
        f"evidence lack it; raise draws, now {draws}, to several times as many, or reparametrise "
        "the model there (a non-centred form of a hierarchical one)"
    )


def _point(model: pm.Model, x: Array) -> str:
    """The first values of a point in the model's units; unconstrained if it has more elements."""
    names = element_names(model)
    values = np.concatenate([np.ravel(value) for value in ConstrainedValues(model)(x).values()])
    which = ""
    if len(values) != len(x):
        values, which = x, ", unconstrained"
    shown = [f"{n} = {v:.3g}" for n, v in zip(names[:N_SHOWN], values, strict=False)]
    return ", ".join([*shown, *(["..."] if len(names) > N_SHOWN else [])]) + which


def _where(model: pm.Model, missed: MissedTail) -> str:
    """The region in the model's units; unconstrained if the elements differ from these."""
    values = ConstrainedValues(model)
    flat = [
        np.concatenate([np.ravel(value) for value in values(x).values()])
        for x in (missed.at_edge, missed.furthest)
    ]
    if len(flat[0]) != len(missed.at_edge):
        side = "above" if missed.tail.side > 0 else "below"
        return (
            f"where {{name}}, unconstrained, is {side} {missed.at_edge[missed.tail.parameter]:.3g}"
        )
    edge, furthest = (float(one[missed.tail.parameter]) for one in flat)
    return f"where {{name}} is {'above' if furthest > edge else 'below'} {edge:.3g}"
