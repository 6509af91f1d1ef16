"""`race`: one sampler after the other, each from the points of the one before, until one is enough.

The random walk runs first, as it needs no gradient: short at first, then longer and longer, each
time with proposals made of the draws of the time before. Where it would take more than the first
run of NUTS, or there are too many dimensions to learn proposals, NUTS starts at its points, in
coordinates made of them. It ends where it is seen to take more than the walk; then, or where it
diverges, the walk goes on from the points that are worth most, for at most as long as all has taken
before.

What a sampler takes is counted in evaluations, not in seconds, so that the outcome depends on no
clock: a seed gives the same draws on an idle machine and on a busy one.
"""

import math
import time
from dataclasses import replace
from functools import partial

from pymc.model import Model
from xarray import DataTree

from ..errors import ModelError
from ..facts import in_words, tell
from ..parallel.signals import is_interrupted, unless_interrupted
from .choice import DRAM, MOST_THIN, NUTS, Choice, why_not_after_all
from .output.facts import EndedDram, EndedNuts, EndedRun, Raced, of_model
from .run.driver import sample_models
from .run.request import ExecutionOptions, SamplingRequest
from .run.stopping import expected_iterations, is_enough
from .target.record_target import RecordTarget

# Iterations of the first walk, in draws; by how much each is longer than the one before; and those
# of the last one before NUTS. NUTS needs the evaluations of the last but one before its draws are
# looked at for the first time, and would hardly gain on a walk of which they are worth something.
_FIRST, _LONGER, _WALK = 4, 4, 256
_UNKNOWN = 4.0  # by which draws of proposals that are still poor may underrate the walk
_GRADIENT = 4.0  # log-densities that a gradient takes: 3 to 6
_MARGIN = 2.0  # by which NUTS may exceed what the walk is expected to take, an estimate
_MOST_SPENT = 16.0  # by which it may exceed what the walks have taken
_FEWER = 3  # by which its warm-up is shorter, as it knows the scales
_N_POINTS = 4000  # of which proposals are made
# For which 400 effective draws make proposals, three for each: in more, a longer walk is no better.
_MOST_DIMENSIONS = 133
# Share of the draws of NUTS that may diverge. What they cannot enter has about so much of the
# posterior: left out at three standard deviations, it moves a mean by 0.03 of them, which 400
# effective draws do not show. More than a tenth of it is told all the same.
_DIVERGING = 0.01


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
    limit = request.max_draws or request.draws
    first = request._replace(until_ess=goal, doubles_thin=True)

    def left(request: SamplingRequest) -> SamplingRequest:
        """With the time that is left, and random numbers of its own."""
        seconds = request.seconds - (time.process_time() - began)
        entropy = [*request.entropy, len(runs)]
        return request._replace(seconds=seconds, initvals=None, entropy=entropy)

    def walk(thin: float, most: float) -> None:
        """Walks of so many iterations a draw, then more, until one is enough or too many are."""
        while thin <= most and not any(_is_good(run, first) for run in runs):
            asked = first._replace(max_draws=min(limit, int(thin * request.draws)))
            if not runs:
                sample_models({name: model}, [asked], quiet, [])
            else:
                given = [_from_points(left(asked), runs)], quiet, (), runs[0].target
                unless_interrupted(partial(sample_models, {name: model}, *given), None)
            needed = expected_iterations(first, runs[-1].length, runs[-1].convergence)
            # Records find starts and proposals of their own, no better ones in a longer walk.
            unknown = 1.0 if isinstance(runs[0].target, RecordTarget) else _UNKNOWN
            is_hopeless = needed > unknown * most * request.draws
            is_hopeless |= _has_no_proposals(runs[0])
            if is_hopeless or asked.max_draws == limit or not _is_too_short(runs[-1]):
                break
            thin *= _LONGER

    walk(_FIRST, _WALK)
    begin, is_slow = of_model(name), _is_too_short(runs[-1])
    reason = why_not_after_all(model) if is_slow else ""
    if reason:
        walk(_LONGER * _WALK, math.inf)
    elif is_slow:
        from .nuts.sample_nuts import sample_nuts  # nutpie takes longer to import than the rest

        needed = goal * _evaluations(runs[-1]) / _effective(runs[-1])
        most = _MARGIN * needed
        if not _has_no_proposals(runs[0]):
            most = min(most, _MOST_SPENT * sum(map(_evaluations, runs)))
        asked = left(request)._replace(tune=-(-request.tune // _FEWER))
        if asked.max_draws is not None:
            asked = asked._replace(max_draws=min(asked.max_draws, MOST_THIN[NUTS] * asked.draws))
        given = asked, quiet, name, runs[-1].positions, most / _GRADIENT
        try:
            unless_interrupted(partial(sample_nuts, model, *given), None)
        except ModelError as error:  # the walk has draws
            reason = str(error)
        if request.until_ess is not None:
            spent = sum(map(_evaluations, runs)) / (request.chains * request.draws)
            walk(_WALK, spent)
    best = max(runs, key=lambda run: (_is_good(run, first), _effective(run)))
    raced = Raced(tuple(runs), best, goal)
    if len(runs) > 1:
        tell(raced, begin)
    asked = request._replace(tune=best.request.tune)
    # After an interrupt nothing is said of the limits that the race had.
    is_complete = best.is_complete and not is_interrupted()
    tell(replace(best, request=asked, is_complete=is_complete), begin)
    sampler = NUTS if isinstance(best, EndedNuts) else DRAM
    return best.tree, Choice(sampler, reason or in_words(raced))


def _is_too_short(walk: EndedRun) -> bool:
    """Whether a walk has ended since it needs more iterations, not time, or the user."""
    request = walk.request
    is_last = 2 * walk.length.n_iterations > (request.max_draws or request.draws)
    return walk.is_complete and is_last and not is_enough(request, walk.convergence)


def _has_no_proposals(walk: EndedRun) -> bool:
    """Whether a longer walk would not have better proposals, as the dimensions are too many."""
    is_of_records = isinstance(walk.target, RecordTarget)
    return walk.positions.shape[1] > _MOST_DIMENSIONS and not is_of_records


def _is_good(run: EndedRun, goal: SamplingRequest) -> bool:
    """Whether draws are worth enough, and can be trusted."""
    if not is_enough(goal, run.convergence):  # of NUTS there may be no draws
        return False
    return not isinstance(run, EndedNuts) or float(run.diverging.mean()) <= _DIVERGING


def _from_points(request: SamplingRequest, runs: list[EndedRun]) -> SamplingRequest:
    """A walk from the points of the last one, which has seen most, or of NUTS if worth more."""
    if isinstance(runs[0].target, RecordTarget):  # whose records find their own starts
        return request
    walk, *nuts = runs[-2:] if isinstance(runs[-1], EndedNuts) else runs[-1:]
    points = max([walk, *nuts], key=_effective).positions
    return request._replace(pilot=points[:: -(-len(points) // _N_POINTS)].tolist())


def _effective(run: EndedRun) -> float:
    """The smallest effective sample size."""
    return 1.0 if run.convergence is None else max(1.0, run.convergence.least_ess)


def _evaluations(run: EndedRun) -> float:
    """Log-densities, without those of the walk's warm-up."""
    if isinstance(run, EndedNuts):
        return _GRADIENT * run.n_gradients
    assert isinstance(run, EndedDram)
    return float(sum(chain.statistics.evaluations for chain in run.chains.values()))
