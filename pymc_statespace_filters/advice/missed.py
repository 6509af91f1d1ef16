"""What chains have missed of the posterior: a search at their end, in a small part of its time."""

import numpy as np

from ..checks.coverage.check import MOST_PARAMETERS
from ..checks.coverage.sentences import store, stored, unvisited
from ..evidence.evidence_facts import PartsOfPosterior
from ..parallel.shared_rows import by_first_rank
from ..parallel.signals import unless_interrupted
from ..pymc_model.density import ModelDensity
from ..pymc_model.posterior_draws import (
    MIN_DRAWS,
    STEP_CHECK,
    are_populations,
    noise_was_moved,
    unconstrained_draws,
)
from ..sampling.output.facts import EndedRun
from ..sampling.target.target import Target
from .signs import signs_message, with_both_signs
from .step_check import step_problems
from .words import sentences

# CPU seconds: so many, or this share of the time of the run if that is more.
_LEAST_SECONDS, _SHARE = 1.0, 0.1
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


def missed_of(fact: EndedRun) -> list[str]:
    """Say what the draws lack, and whether their integration steps are too long.

    Both are stored with the draws.
    """
    nothing: list[str] = []
    if fact.tree["posterior"].sizes["draw"] < MIN_DRAWS:
        return nothing
    missed = unless_interrupted(lambda: _missed_parts(fact), nothing)
    steps = unless_interrupted(lambda: step_problems(fact.tree, fact.model), nothing)
    if steps:
        fact.tree.attrs[STEP_CHECK] = " ".join(steps)
    return [*missed, *steps]


def _missed_parts(fact: EndedRun) -> list[str]:
    """Say which modes and tails of the posterior the draws lack, or that a sign has no meaning.

    The outcome is stored with the draws. Chains that held one noise seed are not checked.
    """
    tree, model, prior = fact.tree, fact.model, fact.target.prior_draws
    stats = tree["sample_stats"]
    seeded = [name for name in stats.data_vars if str(name).endswith("_seed")]
    if "lp" not in stats or (seeded and not tree.attrs["refresh_noise"]):
        return []
    draws = unconstrained_draws(tree, model)
    if draws.shape[-1] > MOST_PARAMETERS:
        return []
    flat = draws.reshape(-1, draws.shape[-1])
    is_enough = len(flat) >= _LEAST_DRAWS
    if not (is_enough or with_both_signs(model, flat)):
        return []
    density: Target | ModelDensity
    if isinstance(fact.target, Target) and fact.target.evaluates_alone:
        density = fact.target
    else:
        density = ModelDensity(model, moved=noise_was_moved(tree))
    found: list[str] = []
    if is_enough:
        log_density = stats["lp"].transpose("chain", "draw").values.astype(np.float64)
        seconds = max(_LEAST_SECONDS, _SHARE * fact.seconds)
        wide = prior.draws if prior.is_prior and len(prior.draws) > 1 else None
        found = unvisited(
            model, draws, log_density, density.evaluate_afresh, seconds, fact.rngs[0], wide
        )
        store(tree, found)
    if not density.seed_names:
        sign = signs_message(model, flat, lambda x: density.evaluate_afresh(x, fact.rngs[0]))
        found = found if sign is None else [sign, *found]
    return [f"{text[0].upper()}{text[1:]}." for text in found]
