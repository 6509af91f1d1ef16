"""What the chains of a model have found: the DataTree, and the facts about the run."""

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from xarray import DataTree

from ...parallel.signals import unless_interrupted
from ...pymc_model.elements import element_names
from ...pymc_model.inspection import filters_used
from ...pymc_model.posterior_draws import STATES
from ...statistics.lower_chains import lower_chains, nats_below
from ..kernel.state import LOG_DENSITY, ChainState, Draws, side_generator
from ..output.convergence import Convergence
from ..output.datatree import to_datatree
from ..output.facts import EndedChain, EndedDram, of_model
from ..output.likelihood_variance import TOO_NOISY, SeedSpread, spread_at_highest_draw
from ..output.phase_statistics import PhaseStatistics
from ..output.sample_stats import stat_dims, whole_chain
from .continuation import stored_states
from .record_chain import chain_of

if TYPE_CHECKING:
    from .model_task import ModelTask
    from .request import ExecutionOptions

type Results = list[tuple[Draws, ChainState]]  # of each chain

_MOST_POSITIONS = 20_000  # that what helps slow chains is seen from


def tree_of(
    task: "ModelTask",
    results: Results,
    convergence: Convergence | None,
    options: "ExecutionOptions",
    *,
    is_complete: bool,
) -> DataTree:
    """Make the DataTree of all chains; the results are emptied.

    ``convergence`` are the diagnostics, if they were asked for; ``options.told`` is called with
    the fact that the chains have ended.
    """
    target, request = task.prepare(), task.request
    of_results = _facts(task, results)
    states = _stored_states(task, results) if is_complete else None
    key = results[0][1].key
    chains = []
    while results:
        chains.append(whole_chain(target, *results.pop(0), request.tune, task.length.thin))
    tree = to_datatree(
        task.model,
        target.raveled,
        chains,
        tune=request.tune,
        keep_warmup=request.keeps_warmup,
        sampling_time=task.seconds,
        stat_dims=stat_dims(target),
    )
    tree.attrs |= {
        **filters_used(task.model),
        "exact": int(target.exact),
        "refresh_noise": int(request.settings.refresh_noise),
        "correlation": request.settings.correlation or 0.0,
        "iterations_per_draw": task.length.thin,
    }
    if (spread := of_results["spread"]) is not None:
        tree.attrs["log_likelihood_variance"] = spread[1].variance
        if task.searched.is_noisy and TOO_NOISY < spread[1].variance < np.inf:
            of_results["spread"] = None  # it was said before the chains began
    if states is not None:
        tree[STATES] = states
    ended = EndedDram(
        model=task.model,
        target=target,
        request=request,
        tree=tree,
        names=element_names(task.model, target.raveled.variables),
        length=task.length,
        seconds=task.seconds,
        convergence=convergence,
        rngs=(side_generator(key, 3), side_generator(key, 2)),
        options=options,
        is_complete=is_complete,
        **of_results,
    )
    options.told(ended, of_model(task.name))
    return tree


def _facts(task: "ModelTask", results: Results) -> dict[str, Any]:
    """What is seen in the results alone, see `EndedDram`."""
    tune, target = task.request.tune, task.prepare()
    draws = [of_chain for of_chain, _ in results]
    lengths = [len(of_chain.positions) for of_chain in draws]
    chains = {
        i: EndedChain(
            target,
            PhaseStatistics.from_draws(of_chain, tune, lengths[i], task.length.thin),
            target.growth(state),
        )
        for i, (of_chain, state) in enumerate(results)
        if lengths[i] > tune
    }
    log_densities = {i: draws[i].numbers[tune:, LOG_DENSITY] for i in chains}
    n_parameters = target.raveled.dim
    positions = task.request.with_former({i: d.positions[tune:] for i, d in enumerate(draws)})
    step = 1 + sum(map(len, positions)) // _MOST_POSITIONS
    return {
        "lengths": lengths,
        "chains": chains,
        "lower": lower_chains(log_densities, n_parameters),
        "below": nats_below(task.searched.level, log_densities, n_parameters),
        "positions": np.concatenate([of_chain[::step] for of_chain in positions]),
        "spread": unless_interrupted(partial(_spread, task, results), None),
    }


def _spread(task: "ModelTask", results: Results) -> tuple[int, SeedSpread] | None:
    """The likelihood's noise after a complete run, if it is to be measured."""
    request, target = task.request, task.prepare()
    lengths = {len(draws.positions) for draws, _ in results}
    if not task.measures_noise or lengths != {request.tune + task.length.draws}:
        return None
    keys = [state.key for _, state in results]
    return spread_at_highest_draw(
        [draws for draws, _ in results],
        request.tune if request.draws else 0,
        chain_of(target, keys[0], 0, 0).seed_spread,
        keys,
        len(target.seed_names),
    )


def _stored_states(task: "ModelTask", results: Results) -> DataTree | None:
    """The states from which complete chains can go on."""
    request, former = task.request, task.request.former
    if task.n_iterations <= request.tune:
        return None
    return stored_states(
        task.model,
        [state for _, state in results],
        iterations=task.n_iterations + (0 if former is None else former.iterations),
        draws=task.length.draws + (0 if former is None else len(former.positions[0])),
        thin=task.length.thin,
        is_centred=request.is_centred,
        settings=request.settings,
    )
