r"""Tempered sequential Monte Carlo: the evidence along a path from the prior to the posterior.

Particles of the prior pass through the distributions :math:`p(x) L(x)^\beta`, where the inverse
temperature :math:`\beta` increases from 0 to 1. At each stage they are weighted by
:math:`L^{\beta' - \beta}`, resampled, and moved by Metropolis steps that leave the distribution at
:math:`\beta'` invariant; the evidence is the product of the mean weights,

.. math::

    \hat p(D) = \prod_t \frac{1}{N} \sum_{i=1}^N L(x_i)^{\beta_{t+1} - \beta_t},

which is unbiased for any moves (Del Moral, Doucet and Jasra 2006). Several runs have the same
temperatures, chosen for all particles together; proposals are fitted to the particles of other
runs. The evidences of the runs are averaged, not their logarithms, and their spread gives the
error.

The next temperature is that at which the effective sample size has fallen to a given fraction
(Jasra, Stephens, Doucet and Tsagaris 2011). The particles are moved until a further move hardly
increases their distance from the starting points.

With a noisy likelihood an estimate is made when a point is proposed and stored with it; L and its
powers denote the stored estimate. On the space of points x and noise u, with density g(u) and
estimates L(x, u), the distributions are :math:`p(x) g(u) L(x, u)^\beta`. A proposal has fresh
noise, drawn from g, so that g cancels in its acceptance probability. At :math:`\beta = 0` this is
the prior and fresh noise; at :math:`\beta = 1` its integral is that of the prior times the expected
likelihood: the evidence is exact, although the intermediate distributions depend on the noise.

The particles start from the prior, so that modes missed by the chains can be found. The draws guide
them: a part of the proposals comes from a mixture of Student-t distributions fitted to the draws.
The moves leave the distribution at every temperature invariant whatever that mixture is, so that
draws which miss a mode cost precision and not truth.

The guide is needed for modes of unequal width. Of two normal modes in k dimensions, of equal mass
and widths :math:`s_1 > s_2`, the narrower one holds about :math:`(s_2 / s_1)^{k(1 - \beta)}` of the
other's mass at the inverse temperature :math:`\beta`, far less than one particle in a long part of
the path. Random walks do not bring the particles back; proposals at the draws do, as soon as the
narrow mode gains mass.

A narrow mode that the chains have missed as well remains unknown. At the end the particles are
compared with the draws (`populations`), and a region that only one of the two visits is a doubt.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from ...errors import ModelError
from ...smc.temperature import next_temperature
from ...student_mixture import StudentMixture
from ...system.checks import check_count, is_integer
from ..posterior import Posterior
from .populations import compare_with_draws
from .protocol import Estimate
from .smc_moves import (
    Particles,
    cross_fit,
    metropolis_step,
    resample_systematic,
    sample_prior_particles,
)
from .student_mixture import choose_mixture

MIN_RUNS, MIN_PARTICLES = 8, 50
ESS_FRACTION = 0.85  # left by a step of the temperature; longer steps miss tails
# Move until the squared distance from the start grows by less than a fraction of itself.
MIN_MOVES, MAX_MOVES, MIN_GAIN = 2, 50, 0.1
ACCEPTANCE = 0.25  # target rate of the random walk
SCALES = (0.1, 2.0)  # bounds for the random walk, relative to the optimum for a Gaussian
MIN_ACCEPTANCE = 0.02
MIN_ANCESTORS = 5
MAX_SPREAD = 0.7

Array = NDArray[np.float64]


class _Stage(NamedTuple):
    """Statistics of the moves at one temperature."""

    n_moves: int
    acceptance: float  # rate over random-walk and independence proposals
    scale: float  # of the random walk after adaptation


@dataclass(frozen=True)
class TemperedSMC:
    """Tempered sequential Monte Carlo from the prior, guided by the posterior draws.

    Wide modes that the chains have missed are found. A mode that is much narrower than another, in
    many dimensions, is found only if the chains have visited it: if neither has, nothing shows it.
    A doubt says so if the last particles miss a region that the draws visit, or the reverse.

    Parameters
    ----------
    n_particles : int
        Particles in each run, at least 50.
    n_runs : int
        Number of runs; even, because the proposals of each half are fitted to the other half, and
        at least 8, because their spread gives the standard error.

    Examples
    --------
    >>> from pymc_statespace_filters.evidence.estimators.tempered_smc import TemperedSMC
    >>> TemperedSMC(n_particles=500)
    TemperedSMC(n_particles=500, n_runs=16)
    """

    name: ClassVar[str] = "tempered_smc"
    uses_draws: ClassVar[bool] = False
    n_particles: int = 250
    n_runs: int = 16

    def __post_init__(self) -> None:
        runs = self.n_runs
        check_count("n_particles", self.n_particles, MIN_PARTICLES)
        if not (is_integer(runs) and runs >= MIN_RUNS and runs % 2 == 0):
            raise ModelError(f"n_runs must be an even integer of at least {MIN_RUNS}, got {runs!r}")

    def n_evaluations(self, posterior: Posterior) -> int:
        """A rough guess: the numbers of temperatures and moves are adaptive."""
        return self.n_runs * self.n_particles * (1 + 5 * (2 + posterior.draws.shape[-1]))

    def estimate(self, posterior: Posterior, *, rng: np.random.Generator) -> Estimate:
        """Estimate the log-evidence from prior draws.

        Raises
        ------
        ModelError
            If the prior is improper, or too few of its draws have a positive likelihood.
        """
        particles = sample_prior_particles(posterior, self.n_runs * self.n_particles, rng)
        guide = choose_mixture(posterior, rng)
        log_evidences = np.zeros(self.n_runs)
        temperature, scale = 0.0, 1.0
        stages: list[_Stage] = []
        while True:
            # Weight before resampling and moving: the estimate is unbiased for any moves.
            raised = next_temperature(temperature, particles.log_likelihood, ESS_FRACTION)
            log_weights = (raised - temperature) * particles.log_likelihood
            log_weights = log_weights.reshape(self.n_runs, self.n_particles)
            log_evidences += logsumexp(log_weights, axis=1) - np.log(self.n_particles)
            particles = particles.at(resample_systematic(log_weights, rng))
            temperature = raised
            if temperature == 1:
                missed = compare_with_draws(particles, self.n_runs, posterior, rng)
                return _summary(log_evidences, particles.ancestor, stages, missed)
            particles, stage = move_particles(particles, temperature, guide, scale, posterior, rng)
            scale = stage.scale
            stages.append(stage)


def move_particles(
    particles: Particles,
    temperature: float,
    guide: StudentMixture,
    scale: float,
    posterior: Posterior,
    rng: np.random.Generator,
) -> tuple[Particles, _Stage]:
    """Move particles by steps that leave p(x) L(x)^temperature invariant, until they have mixed."""
    coordinates = cross_fit(particles.x)
    start = coordinates.whitened(particles.x)
    distance, rates = 0.0, []
    for _ in range(MAX_MOVES):
        particles, walks, jumps = metropolis_step(
            particles, temperature, coordinates, guide, scale, posterior, rng
        )
        rates.append((walks + jumps) / 2)
        scale = float(np.clip(scale * math.exp(walks - ACCEPTANCE), *SCALES))
        before = distance
        distance = ((coordinates.whitened(particles.x) - start) ** 2).sum(axis=1).mean()
        if len(rates) >= MIN_MOVES and distance - before < MIN_GAIN * distance:
            break
    return particles, _Stage(len(rates), float(np.mean(rates)), scale)


def _summary(
    log_evidences: Array,
    ancestor: NDArray[np.int64],
    stages: list[_Stage],
    missed: tuple[str, ...] = (),
) -> Estimate:
    """Average the evidences of the runs (runs,), with the standard error from their spread."""
    n_runs = len(log_evidences)
    peak = log_evidences.max()
    evidences = np.exp(log_evidences - peak)
    spread = float(evidences.std(ddof=1) / evidences.mean())
    # Few runs: inflate by the standard deviation of Student's t, whose variance is (n-1) / (n-3).
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
        doubts=(*_check(acceptance, n_ancestors, spread), *missed),
    )


def _check(acceptance: float, n_ancestors: float, spread: float) -> Iterator[str]:
    """Check the acceptance of the worst stage, the surviving ancestors and the runs' spread."""
    if acceptance < MIN_ACCEPTANCE:
        yield (
            f"moves are rarely accepted ({acceptance:.1%} at worst): reduce the noise of the "
            "likelihood, or reparametrise towards a Gaussian posterior"
        )
    if n_ancestors < MIN_ANCESTORS:
        yield (
            f"the particles of a run descend from {n_ancestors:.1f} draws of the prior, fewer "
            f"than {MIN_ANCESTORS}: narrow the priors, or use estimators that start from "
            "posterior draws"
        )
    if spread > MAX_SPREAD:
        yield (
            f"the evidences of the runs have a standard deviation of {spread:.2f} of their mean: "
            "a few runs dominate it, and the standard error is unreliable; narrow the priors, or "
            "use estimators that start from posterior draws"
        )
