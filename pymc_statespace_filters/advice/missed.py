"""What chains have missed of the posterior: a search at their end, in a small part of its time."""

from functools import cache

import numpy as np

from ..checks.coverage.check import MOST_PARAMETERS
from ..checks.coverage.sentences import store, stored, unvisited
from ..evidence.evidence_facts import PartsOfPosterior
from ..parallel.shared_rows import by_first_rank
from ..parallel.signals import unless_interrupted
from ..pymc_model.density import ModelDensity
from ..pymc_model.inspection import noise_seeds
from ..pymc_model.posterior_draws import (
    MIN_DRAWS,
    STEP_CHECK,
    are_populations,
    noise_was_moved,
    unconstrained_draws,
)
from ..sampling.output.facts import EndedRun
from ..sampling.target.target import Target
from .mirrors import in_one_image, mirror_sentence, mirrors_within
from .signs import signs_message
from .step_check import step_problems
from .words import sentences

# CPU seconds: so many, or this share of the time of the run if that is more.
_LEAST_SECONDS, _SHARE = 1.0, 0.1
_MOST_MIRRORS = 3  # that are told; with the advice on these the next run tells others
# Fewer draws in all know too little of their tails.
_LEAST_DRAWS = 4000


@sentences.register
def _(fact: PartsOfPosterior) -> list[str]:
    """What was found at the end of the run, or is found now, of chains.

    Populations fill their tails otherwise, and have a look of their own.
    """
    if not fact.are_sorted and (known := stored(fact.idata)) is not None:
        return known
    posterior = fact.posterior
    if are_populations(fact.idata) or posterior.log_density.size < _LEAST_DRAWS:
        return []
    parts = posterior.draws, posterior.log_density, posterior.evaluate
    return by_first_rank(lambda: unvisited(fact.model, *parts, _LEAST_SECONDS, fact.rng))


def missed_of[Run: EndedRun](fact: Run) -> tuple[list[str], Run]:
    """Say what the draws lack, and whether their integration steps are too long.

    Both are stored with the draws. And the run with all draws in one of the mirror images that
    they are in, if they are: the same one if not.
    """
    nothing: tuple[list[str], Run] = [], fact
    if fact.tree["posterior"].sizes["draw"] < MIN_DRAWS:
        return nothing
    missed, alike = unless_interrupted(lambda: _missed_parts(fact), nothing)
    steps = unless_interrupted(lambda: step_problems(fact.tree, fact.model), list[str]())
    if steps:
        fact.tree.attrs[STEP_CHECK] = " ".join(steps)
    return [*(f"{text[0].upper()}{text[1:]}." for text in missed), *steps], alike


def _missed_parts[Run: EndedRun](fact: Run) -> tuple[list[str], Run]:
    """Say which modes and tails of the posterior the draws lack, or that signs have no meaning.

    The outcome is stored with the draws. Chains that held one noise seed are not checked. What is
    found in mirror images is nothing else.
    """
    tree, model, prior = fact.tree, fact.model, fact.target.prior_draws
    stats = tree["sample_stats"]
    seeded = [name for name in stats.data_vars if str(name).endswith("_seed")]
    if "lp" not in stats or (seeded and not tree.attrs["refresh_noise"]):
        return [], fact
    draws = unconstrained_draws(tree, model)
    flat = draws.reshape(-1, draws.shape[-1])
    seconds = max(_LEAST_SECONDS, _SHARE * fact.seconds)
    density = cache(lambda: _density(fact))

    def evaluate(x: np.ndarray) -> np.ndarray:
        return density().evaluate_afresh(x, fact.rngs[0])

    is_exact = not noise_seeds(model)
    found: list[str] = []
    if is_exact and (mirrors := mirrors_within(seconds, model, draws, evaluate)):
        found = [mirror_sentence(model, mirror) for mirror in mirrors[:_MOST_MIRRORS]]
        store(tree, found)
        return found, in_one_image(fact, mirrors)
    if draws.shape[-1] > MOST_PARAMETERS:
        return [], fact
    if len(flat) >= _LEAST_DRAWS:
        log_density = stats["lp"].transpose("chain", "draw").values.astype(np.float64)
        wide = prior.draws if prior.is_prior and len(prior.draws) > 1 else None
        evaluate_afresh = density().evaluate_afresh
        found = unvisited(model, draws, log_density, evaluate_afresh, seconds, fact.rngs[0], wide)
        store(tree, found)
    if is_exact and (sign := signs_message(model, flat, evaluate)) is not None:
        found = [sign, *found]
    return found, fact


def _density(fact: EndedRun) -> Target | ModelDensity:
    if isinstance(fact.target, Target) and fact.target.evaluates_alone:
        return fact.target
    return ModelDensity(fact.model, moved=noise_was_moved(fact.tree))
