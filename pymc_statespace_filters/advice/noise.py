"""Noise of an estimated likelihood: what it costs a chain, and how many particles would do."""

import math
import time
from collections.abc import Sequence

import numpy as np
from pymc.model import Model

from ..compiler.lowering.compiled_system import compile_system
from ..filters.catalog import quiet_filter
from ..filters.protocol import EnsembleFilter, Filter, properties
from ..filters.written import short_form
from ..pymc_model.inspection import noisy_filters, state_space_nodes
from ..sampling.kernel.state import draw_seeds
from ..sampling.output.facts import NoisyStart, NoisyStarts
from ..sampling.output.likelihood_variance import (
    HOPELESS,
    MIDDLE,
    N_SEEDS,
    ROUNDING,
    TARGET,
    TOO_NOISY,
    TOO_QUIET,
    SeedSpread,
    acceptance_share,
    seed_spread,
)
from ..sampling.particle_number import SlowVariance
from ..sampling.target.log_density import LogDensity
from ..sampling.target.target import Target
from .collapse import collapse_remedies, speed_up
from .words import sentences

# Above this factor of particles the variance is extrapolated too far to name it.
MOST = 1000.0
# Fewer particles are worth asking for if an evaluation takes half of the time with them.
WORTHWHILE = 2.0
# The least share of moves that is named.
_LEAST_SHARE = 0.01


@sentences.register
def _(fact: NoisyStart) -> list[str]:
    """The noise at a start is such that a chain may never leave it."""
    spread = fact.spread
    if not HOPELESS < spread.variance < np.inf:
        return []
    remedy = collapse_remedies(fact.model) if spread.variance > MOST * MIDDLE else ""
    return [
        f"Chain {fact.chain}, at the start: the estimated log-likelihood{spread.of} has a variance "
        f"of {spread.variance:.3g} over {spread.n} noise seeds. The chain accepts "
        f"{_moves(spread.variance)} that it would accept with an exact likelihood: it has not left "
        "the start yet and may never do so. Start elsewhere (initvals), or give the filter more "
        f"particles; psf.suggest_particles(model) finds the number. {remedy}".rstrip()
    ]


@sentences.register
def _(fact: NoisyStarts) -> list[str]:
    """Too much noise at a typical one of the points found, and what was seen to do.

    A run takes minutes until it shows that its chains do not move. Another filter of the same
    posterior takes seconds to compile.
    """
    model, target, found, rng = fact.model, fact.target, fact.found, fact.rng
    typical = found.x[np.argsort(found.log_density)[len(found.x) // 2]]
    spread, seconds = _measured(target.density, target, typical, rng)
    # One low estimate of many makes the variance large, but hardly a chain slow.
    if not (spread.variance > TOO_NOISY and spread.variance_low > TARGET[1]):
        return []
    remedy = more_particles(spread.variance, collapse_remedies(model))
    if (filters := _quieter(model)) is not None:
        other, longer = _measured(target.density_with(filters), target, typical, rng)
        if other.variance < TARGET[1]:
            names = " and ".join(dict.fromkeys(map(short_form, filters.values())))
            less = f"{other.variance:.1g}" if other.variance > ROUNDING else "zero"
            remedy = (
                f"With {names} the variance is {less} there, and an evaluation takes "
                f"{rounded(longer / seconds)} times as long: give the model this filter."
            )
    return [
        "At a typical one of the starts the estimated log-likelihood has a variance of "
        f"{spread.variance:.3g} over {spread.n} noise seeds. Chains accept "
        f"{_moves(spread.variance)} that they would accept with an exact likelihood. {remedy}"
    ]


@sentences.register
def _(fact: SlowVariance) -> list[str]:
    """More particles hardly make the estimates less noisy."""
    other = _quieter_filter(fact.model, fact.name)
    remedy = "" if other is None else f". Use {short_form(other)}, which has less noise here"
    return [f"{fact.name}: {fact.measured}{remedy}"]


def _moves(variance: float) -> str:
    """The share of the moves that noise leaves, if a dozen estimates tell it.

    Large variances are those of single low estimates, and the share is not that of Gaussian errors:
    one chain accepted 6 % where these would leave 2e-11.
    """
    share = acceptance_share(variance)
    return f"about {share:.1g} of the moves" if share >= _LEAST_SHARE else "few of the moves"


def variance_advice(
    spread: SeedSpread,
    where: str,
    chain: int,
    filters: Sequence[EnsembleFilter] = (),
    remedy: str = "",
) -> str | None:
    """Advise the user if the variance is far outside the range in which chains work best.

    None between variances of 0.05 and 10, without noise, and where fewer particles would save
    little. ``where`` says where it was measured, such as "at the start"; ``filters`` are the noisy
    ones, and ``remedy`` is what to do if their particles collapse.
    """
    found = f"Chain {chain}, {where}: the estimated log-likelihood{spread.of}"
    if spread.n_failed > spread.n or spread.variance == np.inf:
        return (
            f"{found} failed for {spread.n_failed} of {spread.n + spread.n_failed} noise seeds. "
            "Start elsewhere (initvals), or give the filter more particles."
        )
    if spread.variance > TOO_NOISY:
        return (
            f"{found} has a variance of {spread.variance:.3g} over {spread.n} noise seeds. "
            f"The chain accepts {_moves(spread.variance)} that it would accept with an exact "
            "likelihood, and stays long at overestimates. "
            f"{more_particles(spread.variance, remedy)}"
        )
    if not ROUNDING < spread.variance < TOO_QUIET:
        return None
    factor, saved = speed_up(filters, MIDDLE / spread.variance)
    if saved < WORTHWHILE:
        return None
    return (
        f"{found} has a variance of only {spread.variance:.2g} over {spread.n} noise seeds. "
        f"With about {rounded(factor)} times fewer particles it would lie below {TARGET[1]:g} and "
        "the chain would gain more per unit of time; psf.suggest_particles(model) finds the number."
    )


def more_particles(variance: float, remedy: str) -> str:
    """Say what brings a variance into the range: so many particles, or something else."""
    factor = variance / MIDDLE
    if factor > MOST:
        return f"More particles would hardly do. {remedy}".rstrip()
    return (
        f"The variance is about proportional to 1/N for N particles: {rounded(factor)} times as "
        f"many would bring it between {TARGET[0]:g} and {TARGET[1]:g}; "
        "psf.suggest_particles(model) finds the number."
    )


def rounded(factor: float) -> str:
    """Format a factor with two digits, without an exponent."""
    digits = 1 - math.floor(math.log10(factor))
    return f"{round(factor, digits):.{max(0, digits)}f}"


def _measured(
    density: LogDensity, target: Target, x: np.ndarray, rng: np.random.Generator
) -> tuple[SeedSpread, float]:
    """The spread of the estimates at a point, and the CPU seconds of one."""
    bound, seeds = density.bind(), draw_seeds(rng, (N_SEEDS, len(target.seed_names)))
    bound(x, (), seeds[0])  # loads the machine code
    began = time.process_time()
    spread = seed_spread(bound, x, (), seeds)
    return spread, (time.process_time() - began) / N_SEEDS


def _quieter(model: Model) -> dict[str, Filter] | None:
    """Filters with little noise and the same posterior; None if a variable has none."""
    found = {}
    for name, filter in noisy_filters(model).items():
        other = _quieter_filter(model, name) if properties(filter).unbiased else None
        if other is None:
            return None
        found[name] = other
    return found


def _quieter_filter(model: Model, name: str) -> Filter | None:
    """A filter of the same likelihood with little noise or none, for one variable."""
    op = state_space_nodes(model)[name].op
    return quiet_filter(compile_system(op.system), op.filter)
