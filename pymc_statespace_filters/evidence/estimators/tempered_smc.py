r"""The evidence on the way from the prior to the posterior: tempered sequential Monte Carlo.

Particles of the prior are led through the laws :math:`p(x) L(x)^\beta`, with the temperature
:math:`\beta` raised from 0 to 1. At each step they are weighted by :math:`L^{\beta' - \beta}`,
resampled, and moved by Metropolis steps that keep the law at :math:`\beta'`; the evidence is the
product of the mean weights,

.. math::

    \hat p(D) = \prod_t \frac{1}{N} \sum_{i=1}^N L(x_i)^{\beta_{t+1} - \beta_t},

without bias whatever the moves (Del Moral, Doucet and Jasra 2006). Several runs go side by side
under the same temperatures, chosen for all particles together; proposals are learnt from those of
other runs. Their evidences are averaged, and never the logarithms; their spread is the error.

The temperature is raised until the effective number of the weighted particles has fallen to a share
(Jasra, Stephens, Doucet and Tsagaris 2011), and the particles are moved until one move more brings
them hardly further from where they started.

With a noisy likelihood an estimate is made with its point and stays with it until the point is
left; so do L and all powers of it mean that stored estimate. On the space of points x and noise u,
with density g(u) and estimates L(x, u), the laws are :math:`p(x) g(u) L(x, u)^\beta`. A proposal
has fresh noise, drawn from g, so that g cancels in its acceptance. At :math:`\beta = 0` this is the
prior and fresh noise, at :math:`\beta = 1` its integral is that of prior times expected likelihood:
the evidence is exact, though the laws on the way depend on the noise.

No draw of the posterior is used. So modes that the chains have missed are found here.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import logsumexp

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.estimators.protocol import Estimate
from pymc_statespace_filters.evidence.estimators.smc_moves import (
    Particles,
    cross_fit,
    metropolis_step,
    resample_systematic,
    sample_prior_particles,
)
from pymc_statespace_filters.evidence.posterior.draws import Posterior

MIN_RUNS, MIN_PARTICLES = 8, 50
SHARE = (
    0.85  # of the effective number that a step of the temperature leaves; longer steps miss tails
)
# Move until the squared distance from the start grows by less than a share of itself.
MIN_MOVES, MAX_MOVES, MIN_GAIN = 2, 50, 0.1
ACCEPTANCE = 0.25  # of random walks
SCALES = (0.1, 2.0)  # least and largest of random walks, in the optimal one for a Gaussian
MIN_ACCEPTANCE = 0.02
MIN_ANCESTORS = 5
MAX_SPREAD = 0.7

Array = NDArray[np.float64]


class _Stage(NamedTuple):
    """How the moves at one temperature went."""

    n_moves: int
    acceptance: float  # of walks and independent proposals together
    scale: float  # of the walks at the end


@dataclass(frozen=True)
class TemperedSMC:
    """Tempered sequential Monte Carlo from the prior; draws of the posterior are not used.

    Parameters
    ----------
    n_particles : int
        In each run; at least 50.
    n_runs : int
        Independent but for what they learn from each other; even, because either half learns from
        the other, and at least 8, so that their spread is an error.

    Examples
    --------
    >>> from pymc_statespace_filters.evidence.estimators.tempered_smc import TemperedSMC
    >>> TemperedSMC(n_particles=500)
    TemperedSMC(n_particles=500, n_runs=16)
    """

    name: ClassVar[str] = "tempered_smc"
    n_particles: int = 250
    n_runs: int = 16

    def __post_init__(self) -> None:
        particles, runs = self.n_particles, self.n_runs
        if not (isinstance(particles, int | np.integer) and particles >= MIN_PARTICLES):
            raise ModelError(
                f"n_particles must be an integer of at least {MIN_PARTICLES}, got {particles!r}"
            )
        if not (isinstance(runs, int | np.integer) and runs >= MIN_RUNS and runs % 2 == 0):
            raise ModelError(f"n_runs must be an even integer of at least {MIN_RUNS}, got {runs!r}")

    def n_evaluations(self, posterior: Posterior) -> int:
        """A guess: the number of temperatures and of moves is found on the way."""
        return self.n_runs * self.n_particles * (1 + 5 * (2 + posterior.draws.shape[-1]))

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from draws of the prior.

        Raises
        ------
        ModelError
            If the prior is improper, or too few of its draws have a likelihood.
        """
        particles = sample_prior_particles(posterior, self.n_runs * self.n_particles, rng)
        log_evidences = np.zeros(self.n_runs)
        temperature, scale = 0.0, 1.0
        stages: list[_Stage] = []
        while True:
            # Weight the particles where they are; only then resample and move them.
            raised = next_temperature(temperature, particles.log_likelihood)
            log_weights = (raised - temperature) * particles.log_likelihood
            log_weights = log_weights.reshape(self.n_runs, self.n_particles)
            log_evidences += logsumexp(log_weights, axis=1) - np.log(self.n_particles)
            particles = particles.at(resample_systematic(log_weights, rng))
            temperature = raised
            if temperature == 1:
                return _summary(log_evidences, particles.ancestor, stages)
            particles, stage = move_particles(particles, temperature, scale, posterior, rng)
            scale = stage.scale
            stages.append(stage)


def next_temperature(temperature: float, log_likelihood: Array) -> float:
    """The next temperature, at which the effective number has fallen to `SHARE`; at most one.

    Particles without a likelihood are lost at the first step, however small: the share is one of
    the others.
    """
    alive = log_likelihood[np.isfinite(log_likelihood)]

    def surplus(step: float) -> float:
        log_effective = 2 * logsumexp(step * alive) - logsumexp(2 * step * alive)
        return math.exp(log_effective) / len(alive) - SHARE

    if surplus(1 - temperature) >= 0:
        return 1.0
    # The step may be smaller than any absolute tolerance, if the prior is wide.
    return temperature + brentq(surplus, 0.0, 1 - temperature, xtol=1e-300, rtol=1e-9)


def move_particles(
    particles: Particles,
    temperature: float,
    scale: float,
    posterior: Posterior,
    rng: np.random.Generator,
) -> tuple[Particles, _Stage]:
    """Move particles by steps that keep p(x) L(x)^temperature, until they are far enough."""
    coordinates = cross_fit(particles.x)
    start = coordinates.whitened(particles.x)
    distance, rates = 0.0, []
    for _ in range(MAX_MOVES):
        particles, walks, jumps = metropolis_step(
            particles, temperature, coordinates, scale, posterior, rng
        )
        rates.append((walks + jumps) / 2)
        scale = float(np.clip(scale * math.exp(walks - ACCEPTANCE), *SCALES))
        before = distance
        distance = ((coordinates.whitened(particles.x) - start) ** 2).sum(axis=1).mean()
        if len(rates) >= MIN_MOVES and distance - before < MIN_GAIN * distance:
            break
    return particles, _Stage(len(rates), float(np.mean(rates)), scale)


def _summary(log_evidences: Array, ancestor: NDArray[np.int64], stages: list[_Stage]) -> Estimate:
    """The mean of the runs' evidences (runs,), with its error from their spread."""
    n_runs = len(log_evidences)
    peak = log_evidences.max()
    evidences = np.exp(log_evidences - peak)
    spread = float(evidences.std(ddof=1) / evidences.mean())
    # So wide that errors in its unit have the variance one, where Student's law, for so few runs,
    # has (n - 1) / (n - 3).
    student = math.sqrt((n_runs - 1) / (n_runs - 3))
    n_ancestors = len(np.unique(ancestor)) / n_runs
    acceptance = min((stage.acceptance for stage in stages), default=1.0)
    return Estimate(
        log_evidence=float(peak + np.log(evidences.mean())),
        se=spread / math.sqrt(n_runs) * student,
        settings={
            "n_runs": n_runs,
            "n_particles": len(ancestor) // n_runs,
            "n_temperatures": len(stages) + 1,
            "n_moves": sum(stage.n_moves for stage in stages),
            "least_acceptance": acceptance,
            "n_ancestors": n_ancestors,
            "spread_of_runs": spread,
        },
        doubts=tuple(_doubts(acceptance, n_ancestors, spread)),
    )


def _doubts(acceptance: float, n_ancestors: float, spread: float) -> Iterator[str]:
    """Reasons for doubt, from the worst stage, the survivors in a run, and the runs' spread."""
    if acceptance < MIN_ACCEPTANCE:
        yield (
            f"moves are hardly accepted (at worst {acceptance:.1%}): lessen the noise of the "
            "likelihood, or give the parameters a scale on which the posterior is smoother"
        )
    if n_ancestors < MIN_ANCESTORS:
        yield (
            f"its particles descend from {n_ancestors:.1f} draws of the prior in each run, fewer "
            f"than {MIN_ANCESTORS}: narrow the priors, or trust estimators that start from the "
            "draws"
        )
    if spread > MAX_SPREAD:
        yield (
            f"its runs disagree, with a standard deviation of {spread:.2f} of their mean: a few of "
            "them carry it, and its error is itself a guess: narrow the priors, or trust "
            "estimators that start from the draws"
        )
