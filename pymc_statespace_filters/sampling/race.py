"""`race`: one sampler after the other, each from the points of the one before, until one is enough.

The random walk runs first: it needs no gradient, and its effective draws grow with its iterations,
so that it is known early how many it needs. If they are more than the first run of NUTS takes, NUTS
starts at its points, in coordinates made of them. It ends where it is seen to take more than the
walk, or diverges; then the walk goes on from the draws of NUTS, with proposals made of them.

What a sampler takes is counted in evaluations, not in seconds, so that the outcome depends on no
clock: a seed gives the same draws on an idle machine and on a busy one.
"""

import time
from dataclasses import replace
from functools import partial
from typing import Any

from pymc.model import Model
from xarray import DataTree

from ..facts import in_words, tell
from ..parallel.signals import unless_interrupted
from .choice import DRAM, MOST_THIN, NUTS, Choice, why_not_after_all
from .output.facts import EndedDram, EndedNuts, EndedRun, Raced, of_model
from .run.driver import sample_models
from .run.request import ExecutionOptions, SamplingRequest
from .run.stopping import is_enough, is_hopeless
from .target.record_target import RecordTarget

# Iterations of the walk, in draws, that take no more than the first run of NUTS.
_WALK = 32
_GRADIENT = 4.0  # log-densities that a gradient takes: 3 to 6
_MARGIN = 2.0  # by which NUTS may exceed what the walk is expected to take, an estimate
_FEWER = 3  # by which its warm-up is shorter, as it knows the scales
_N_POINTS = 1000  # of NUTS, from which the walk goes on


def race(
    model: Model,
    request: SamplingRequest,
    goal: float | None,
    options: ExecutionOptions,
    name: str,
) -> tuple[DataTree, Choice]:
    """Draws of the sampler whose draws are worth ``goal``, or else most; and how it came to that.

    Arguments and errors are those of `sample`.
    """
    assert goal is not None  # for at least as many draws as have diagnostics
    began, runs = time.process_time(), list[EndedRun]()
    quiet = options._replace(told=lambda fact, begin: runs.append(fact))

    def walk(asked: SamplingRequest) -> None:
        sample_models({name: model}, [asked], quiet, [])

    def rest(**changes: Any) -> SamplingRequest:
        left = request.seconds - (time.process_time() - began)
        return request._replace(seconds=left, initvals=None, **changes)

    most = min(request.max_draws or request.draws, _WALK * request.draws)
    first = request._replace(until_ess=goal, max_draws=most, doubles_thin=True, gives_up=True)
    walk(first)
    begin, is_slow = of_model(name), _is_too_slow(runs[0])
    reason = why_not_after_all(model) if is_slow else ""
    if is_slow and not reason:
        from .nuts.sample_nuts import sample_nuts  # nutpie takes longer to import than the rest

        needed = goal * _evaluations(runs[0]) / _effective(runs[0])
        asked = rest(tune=-(-request.tune // _FEWER))
        if asked.max_draws is not None:
            asked = asked._replace(max_draws=min(asked.max_draws, MOST_THIN[NUTS] * asked.draws))
        given = asked, quiet, name, runs[0].positions, _MARGIN * needed / _GRADIENT
        unless_interrupted(partial(sample_nuts, model, *given), None)
    if is_slow and request.until_ess is not None and not _is_good(runs[-1], first):
        unless_interrupted(partial(walk, _again(first, rest(), runs)), None)
    best = max(runs, key=lambda run: (_is_good(run, first), _effective(run)))
    raced = Raced(tuple(runs), best, goal)
    if len(runs) > 1:
        tell(raced, begin)
    tell(replace(best, request=request._replace(tune=best.request.tune)), begin)
    sampler = NUTS if isinstance(best, EndedNuts) else DRAM
    return best.tree, Choice(sampler, reason or in_words(raced))


def _is_too_slow(walk: EndedRun) -> bool:
    """Whether the first walk has ended since it needs more iterations, not time, or the user."""
    request, found = walk.request, walk.convergence
    most = request.max_draws or request.draws
    is_last = 2 * walk.length.n_iterations > most
    is_at_end = is_last or is_hopeless(request, walk.length, found)
    return walk.is_complete and is_at_end and not is_enough(request, found)


def _is_good(run: EndedRun, goal: SamplingRequest) -> bool:
    """Whether draws are worth enough, and can be trusted."""
    diverges = isinstance(run, EndedNuts) and run.diverges
    return is_enough(goal, run.convergence) and not diverges


def _again(first: SamplingRequest, rest: SamplingRequest, runs: list[EndedRun]) -> SamplingRequest:
    """The walk from the points that are worth most; no longer than at first if some are enough."""
    request = first if is_enough(first, runs[-1].convergence) else rest
    if isinstance(runs[0].target, RecordTarget):  # whose records find their own starts
        return request
    points = max(runs, key=_effective).positions
    return request._replace(pilot=points[:: -(-len(points) // _N_POINTS)].tolist(), initvals=None)


def _effective(run: EndedRun) -> float:
    """The smallest effective sample size."""
    return 1.0 if run.convergence is None else max(1.0, run.convergence.least_ess)


def _evaluations(walk: EndedRun) -> int:
    """Log-densities after the warm-up."""
    assert isinstance(walk, EndedDram)
    return sum(chain.statistics.evaluations for chain in walk.chains.values())
