"""Why probabilities of terms may be less certain than their errors suggest."""

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
import pymc as pm
from numpy.typing import NDArray
from pytensor.graph.traversal import ancestors

from ..errors import ModelError
from .candidates import Candidates
from .probabilities import Probabilities
from .submodel_density import Array, Point, SubmodelDensity
from .submodel_evidence import LEAST_EFFECTIVE, Visits, Weighted

MAX_SHARE = 0.01  # of the probability, in sub-models of unreliable evidence
MOST_APART, LEAST_APART = 4.0, 0.02  # of visits and probabilities: errors, and at least
# Effective points of the full model. In 25 cases of good and poor draws the two with one such point
# were wrong, all others had 20 and more and were right; two of these were doubted for their
# sub-models (`benchmarks.terms_poor_draws`).
LEAST_OF_FULL = 5.0
NEGLIGIBLE = 0.005  # probability of a single one
MOST_SAMPLED = 2  # candidates whose sub-models may as well be sampled one by one
N_COMPARED, SAME = 3, 1e-9  # draws at which terms are told apart; relative, of equal likelihoods


def check_finite(points: Sequence[Weighted], candidates: Candidates) -> None:
    """Raise if no sub-model without some candidate has a density that is not zero."""
    present = np.array([one.proposal.present for one in points])
    possible = np.array([np.isfinite(one.log_weights).any() for one in points])
    for j, key in enumerate(candidates.keys):
        without = ~present[:, j]
        if without.any() and not possible[without].any():
            values = candidates.switches.values[j].tolist()
            raise ModelError(
                f"absent must give a value of {key!r} at which the model has a density, got "
                f"{values[0] if isinstance(key, str) else tuple(values)}: the likelihood, or the "
                "prior of a variable that depends on it, is zero or not finite at all points of "
                "all sub-models without it"
            )


def check_distinct(density: SubmodelDensity, draws: Array, rng: np.random.Generator) -> None:
    """Raise if two candidates switch off the same term, as the factors of a product do.

    Without either of them the likelihood is then the same, whatever the draws (n, k) are, and it is
    another one with both.
    """
    n = len(density.candidates)
    x = draws[rng.integers(len(draws), size=N_COMPARED)]
    seeds = density.density.fresh_seeds(N_COMPARED, rng)
    sets = np.concatenate([np.ones((1, n), dtype=bool), ~np.eye(n, dtype=bool)])
    found = density.evaluate(
        Point(
            np.tile(x, (n + 1, 1)),
            np.repeat(sets, N_COMPARED, axis=0),
            np.tile(seeds, (n + 1, 1)),
        )
    )
    likelihood = (found.total - found.own.sum(axis=1)).reshape(n + 1, N_COMPARED)
    full, without = likelihood[0], likelihood[1:]
    for a, b in combinations(range(n), 2):
        if _is_same(without[a], without[b]) and not _is_same(without[a], full):
            first, second = (density.candidates.keys[i] for i in (a, b))
            raise ModelError(
                f"absent must have one candidate for a term: {first!r} and {second!r} switch off "
                "the same one, as neither has an effect without the other. Leave one of them out, "
                f"or give the tuple {(*_names(first), *_names(second))}"
            )


def _is_same(a: Array, b: Array) -> bool:
    """Whether log-likelihoods are equal but for rounding."""
    with np.errstate(invalid="ignore"):  # of infinities, which tell nothing
        return bool((np.abs(a - b) <= SAME * (1 + np.abs(a))).all())


def _names(key: str | tuple[str, ...]) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key


def unreliable(found: Probabilities, points: Sequence[Weighted]) -> NDArray[np.bool_]:
    """Which sub-models that matter have evidences whose errors cannot be believed, (S,)."""
    poor = found.of_models > NEGLIGIBLE
    for i in np.flatnonzero(poor).tolist():
        poor[i] = not points[i].is_reliable
    return np.asarray(poor)


def doubts_of_potentials(model: pm.Model, candidates: Candidates) -> Iterator[str]:
    """Which Potentials may belong to the priors of candidates."""
    if not model.observed_RVs:
        return  # They are the likelihood.
    own = {model[name] for name in candidates.variables}
    for potential in model.potentials:
        if used := sorted(rv.name for rv in own & set(ancestors([potential]))):
            yield (
                f"the Potential {potential.name!r} uses {', '.join(used)}: where it is a part of "
                "the prior, this is not normalised, and the probabilities of these terms are "
                "proportional to an unknown number: give them a distribution that has the density"
            )


def doubts(
    found: Probabilities,
    points: Sequence[Weighted],
    candidates: Candidates,
    visits: Visits | None,
    full: Weighted | None,
) -> Iterator[str]:
    """Why the errors of inclusions may be too small.

    ``full`` has points of the full model, unless proposals do without its draws.
    """
    if full is not None and full.n_effective < LEAST_OF_FULL:
        yield (
            "the draws of idata do not seem to be from the posterior of this model, or are too "
            f"few: {full.count} points that were drawn like them are worth {full.n_effective:.1f} "
            "draws of the posterior, and no better proposal was found. Give draws of psf.sample"
            f"{_or_particles(points)}"
        )
    poor = unreliable(found, points)
    share = float(found.of_models[poor].sum())
    if share > MAX_SHARE:
        worst = int(np.argmax(np.where(poor, found.of_models, -1.0)))
        labels = np.array(candidates.labels)[found.present[worst]]
        few = points[worst].n_effective < LEAST_EFFECTIVE
        yield (
            f"sub-models with {share:.0%} of the probability have "
            f"{'few effective points' if few else 'weights with a heavy tail'}, such as "
            f"that with {', '.join(labels) or 'none of the terms'} (Pareto k "
            f"{points[worst].pareto_k:.2f}, {points[worst].n_effective:.0f} "
            f"effective points): {_advice(points, candidates, full)}"
        )
    if visits is None:
        return
    error = np.hypot(visits.error, found.inclusion_se)
    apart = np.abs(visits.frequency - found.inclusion)
    if (far := apart > MOST_APART * error + LEAST_APART).any():
        j = int(np.argmax(np.where(far, apart, 0.0)))
        yield (
            f"the chains over sub-models have visited {candidates.labels[j]} with the frequency "
            f"{visits.frequency[j]:.2f} ± {visits.error[j]:.2f}, and the sub-models that were met "
            f"give it the probability {found.inclusion[j]:.2f}: some that matter were not met; "
            "run again with another random_seed, or name fewer candidates"
        )


def _advice(points: Sequence[Weighted], candidates: Candidates, full: Weighted | None) -> str:
    """What helps where points of sub-models are worth little."""
    if full is None:
        return (
            "the draws of the full model are no guide, as the data do not determine all of its "
            "parameters: name fewer candidates, or compare the result with that of another "
            "random_seed"
        )
    more = f"give more draws of the full model as idata{_or_particles(points)}"
    if len(candidates) <= MOST_SAMPLED:
        more += (
            ", or sample the models with and without a term, and compare their evidences "
            "(compare_evidence)"
        )
    if any(isinstance(key, str) for key in candidates.keys):
        more += (
            "; and what only one term uses, as a gap, together with it, as ('k', 'gap') in absent"
        )
    return more


def _or_particles(points: Sequence[Weighted]) -> str:
    """The remedy of noisy likelihoods, each point of which has a seed."""
    return ", or a filter with more particles" if points[0].seeds.shape[1] else ""
