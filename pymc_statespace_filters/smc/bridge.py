r"""Populations led from one distribution to the next, along temperatures that a pilot chooses.

The distributions :math:`p(x) L(x) l(x)^\beta` lead from those before, at :math:`\beta = 0`, to
those after a factor :math:`l` of the likelihood, at :math:`\beta = 1`: the whole likelihood, that
of one more observation, or the ratio of two estimates. The particles are weighted by
:math:`l^{\beta' - \beta}`; where the effective size of the pilot falls to half of its particles,
they are resampled and moved (Del Moral, Doucet and Jasra 2006; Chopin 2002; Chopin, Jacob and
Papaspiliopoulos 2013). The mean weights multiply to

.. math::

    \hat p = \prod_t \sum_i W_i^{(t)} l(x_i)^{\beta_{t+1} - \beta_t},

an unbiased estimate of the ratio of the two integrals in every population but the pilot, whose
particles decide when the others are moved, and how.

A noisy likelihood is the estimate that is stored with its point: on the space of points and noise
the same formulas hold, and the noise integrates out where the estimate is unbiased.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError
from .kernel import fitted_kernel
from .moves import Moved, Size, move_others, move_pilot
from .particles import Evaluate, Populations
from .temperature import next_temperature

ESS_FRACTION = 0.5  # of all the pilot's particles, those of zero likelihood included

_NONE_ALIVE = "the likelihood is zero at all particles"

Array = NDArray[np.float64]


class Stage(NamedTuple):
    """What happened at one temperature; effective sizes (R,) are those before the moves."""

    temperature: float
    effective_sizes: Array
    n_steps: int
    acceptance: float
    scale: float
    n_evaluated: int  # proposals, those of the pilot included


class Cloud(NamedTuple):
    """The pilot, the other populations, and the length of the steps that the pilot has learnt."""

    pilot: Populations
    others: Populations
    scale: float = 1.0


class Crossed(NamedTuple):
    """How far a bridge has led, the log of each population's estimate of the ratio, and how."""

    cloud: Cloud
    log_ratio: Array  # (R,)
    stages: list[Stage]


def cross(
    begin: Cloud | Crossed,
    evaluate: Evaluate,
    size: Size,
    rng: np.random.Generator,
    *,
    refresh: bool = False,
    screen: Evaluate | None = None,
    on_stage: Callable[[Crossed], None] = lambda so_far: None,
) -> Crossed:
    """Lead the populations across; with ``refresh`` they are resampled and moved at the end, too.

    The increments of the particles are those of the factor; ``evaluate`` gives them at new points.
    ``screen`` is a cheap likelihood, in the same factors, by which proposals are screened.
    ``on_stage`` is told how far they are, from where another call goes on.
    """
    if isinstance(begin, Cloud):
        begin = Crossed(begin, np.zeros(len(begin.others.log_weights)), [])
    cloud, log_ratio, stages = begin
    temperature = stages[-1].temperature if stages else 0.0
    while temperature < 1.0:
        raised = _raised(cloud.pilot, temperature)
        pilot, _ = cloud.pilot.raised(raised - temperature)
        others, log_mean = cloud.others.raised(raised - temperature)
        log_ratio = log_ratio + log_mean
        if np.isneginf(log_ratio).all():
            raise ModelError(f"{_NONE_ALIVE} of the populations: raise draws, or narrow the priors")
        temperature, cloud = raised, cloud._replace(pilot=pilot, others=others)
        if temperature == 1.0 and not refresh:
            return Crossed(cloud, log_ratio, stages)
        sizes = sizes_of_evidence(others, log_ratio)
        cloud, moved, n_evaluated = _moved(cloud, temperature, evaluate, size, rng, screen)
        stage = Stage(temperature, sizes, moved.n_steps, moved.acceptance, cloud.scale, n_evaluated)
        stages = [*stages, stage]
        on_stage(Crossed(cloud, log_ratio, stages))
    return Crossed(cloud, log_ratio, stages)


def sizes_of_evidence(others: Populations, log_evidences: Array) -> Array:
    """Effective sizes of populations; 0 of one that has no evidence, and counts no more."""
    return np.where(np.isneginf(log_evidences), 0.0, others.effective_sizes)


def _raised(pilot: Populations, temperature: float) -> float:
    """The next temperature; the present one if so many particles have zero likelihood."""
    increment = pilot.particles.increment
    n_alive = np.isfinite(increment).sum()
    if n_alive == 0:
        raise ModelError(f"{_NONE_ALIVE} of the pilot: raise draws, or narrow the priors")
    fraction = ESS_FRACTION * len(increment) / n_alive
    return next_temperature(temperature, increment, fraction, pilot.log_weights[0])


def _moved(
    cloud: Cloud,
    temperature: float,
    evaluate: Evaluate,
    size: Size,
    rng: np.random.Generator,
    screen: Evaluate | None,
) -> tuple[Cloud, Moved, int]:
    """The cloud with all populations moved at one temperature, how the others were, evaluations."""
    kernel = fitted_kernel(cloud.pilot, cloud.scale, rng, screen)
    pilot, kernel = move_pilot(cloud.pilot, kernel, temperature, evaluate, size, rng)
    others = move_others(cloud.others, kernel, pilot.n_steps, temperature, evaluate, size, rng)
    n_evaluated = pilot.n_evaluated + others.n_evaluated
    return Cloud(pilot.populations, others.populations, kernel.scale), others, n_evaluated
