"""Chains of nutpie, looked at while they run, until their draws are worth enough."""

import time
from collections.abc import Callable
from contextlib import suppress
from threading import Semaphore
from typing import Any, NamedTuple

import numpy as np
import nutpie
from numpy.typing import NDArray
from nutpie.compiled_pyfunc import from_pyfunc
from xarray import DataTree

from ...parallel.signals import interrupts_are_noted, takes_interrupt
from ..output.chain_bars import ChainProgress
from ..output.convergence import Convergence, convergence
from ..run.request import SamplingRequest
from ..run.stopping import Length, first_length, next_length
from .gradient import DensityGradient

Array = NDArray[np.float64]

# Of the statistics of nutpie, those that are kept, by their names in PyMC.
STATISTICS = {
    "logp": "model_logp",
    "diverging": "diverging",
    "energy": "energy",
    "depth": "tree_depth",
    "maxdepth_reached": "reached_max_treedepth",
    "n_steps": "n_steps",
    "step_size": "step_size",
    "mean_tree_accept": "acceptance_rate",
}
_SECONDS = 0.05
# Share of the draws that may diverge without a word. Beyond it chains go on only as long as a
# doubling of their iterations, which should double the effective draws, raises them so much.
TOLERATED, _LEAST_GROWTH = 0.001, 1.25


class NutsChains(NamedTuple):
    """Positions (chain, draw, d) and statistics of kept draws, and what lies behind them."""

    positions: Array
    statistics: dict[str, np.ndarray]
    length: Length
    found: Convergence | None
    seconds: float
    is_stuck: bool  # whether they diverged, and ended as more iterations had not helped
    is_complete: bool  # whether they have made as many iterations as they were to


def run_nuts(
    density: DensityGradient,
    start: Callable[[np.random.Generator], Array],
    dim: int,
    request: SamplingRequest,
    *,
    cores: int,
    seed: int,
    progressbar: bool | str,
) -> NutsChains:
    """Run the chains of a request, each from ``start`` with a generator of its own.

    Ctrl-C ends them; the draws that all have made are kept.
    """
    allowed = Semaphore(cores)

    def evaluate_in_turn() -> Callable[[Array], tuple[float, Array]]:
        evaluate = density.for_a_thread()

        def waiting(x: Array) -> tuple[float, Array]:
            with allowed:
                return evaluate(x)

        return waiting

    model = from_pyfunc(
        dim,
        evaluate_in_turn,
        lambda *_: lambda x: {"position": x.copy()},
        [np.dtype(np.float64)],
        [(dim,)],
        ["position"],
        make_initial_point_fn=lambda seed: start(np.random.default_rng(seed)),
    )
    began = time.monotonic()
    interrupts_are_noted()
    with ChainProgress(request.chains, request.draws, request.tune, progressbar) as bars:
        sampler = nutpie.sample(
            model,
            draws=request.max_draws or request.draws,
            tune=request.tune,
            chains=request.chains,
            cores=request.chains,  # or the first would run to their end before the others begin
            seed=seed,
            progress_bar=False,
            progress_rate=50,
            adaptation="low_rank",  # no worse than whitened by the starts
            blocking=False,
            progress_callback=(watch := _Watch()),
        )
        return _followed(sampler, watch, request, bars, began)


class _Watch:
    """The last progress of each chain, which nutpie reports from a thread of its own."""

    def __init__(self) -> None:
        self.chains: list[Any] = []

    def __call__(self, chains: list[Any]) -> None:
        self.chains = chains


def _followed(
    sampler: Any, watch: _Watch, request: SamplingRequest, bars: ChainProgress, began: float
) -> NutsChains:
    """Wait for the chains, and end them at the first length whose draws are worth enough."""
    length, found, is_stuck = first_length(request), None, False
    while not takes_interrupt():
        time.sleep(_SECONDS)
        made = [chain.finished_draws for chain in watch.chains]
        for i, chain in enumerate(watch.chains):
            bars.update(i, chain.finished_draws, _shown(chain))
        is_over = _is_finished(sampler)
        if not is_over and (not made or min(made) < request.tune + length.n_iterations):
            continue
        for i, chain in enumerate(watch.chains):  # which may be what was said before the end
            bars.update(i, request.tune + length.n_iterations, _shown(chain))
        trace = sampler.inspect()
        positions = _positions(trace)
        rows = slice(length.thin - 1, length.n_iterations, length.thin)
        before, found = found, convergence(list(positions[:, rows]))
        longer = next_length(request, length, found, time.monotonic() - began)
        is_stuck = longer is not None and _is_stuck(trace, rows, before, found)
        if is_stuck or longer is None:
            break
        if is_over and _n_made(positions) < longer.n_iterations:
            break
        length = longer
        for i in range(request.chains):
            bars.extend(i, request.tune + length.n_iterations)
    seconds = time.monotonic() - began
    kept = _kept(sampler.abort(), length, found, seconds)._replace(is_stuck=is_stuck)
    made = kept.positions.shape[1]
    if made == length.draws:
        return kept
    found = convergence(list(kept.positions))
    return kept._replace(length=length._replace(draws=made), found=found, is_complete=False)


def _is_finished(sampler: Any) -> bool:
    with suppress(TimeoutError):  # nutpie did not answer at once
        return bool(sampler.is_finished)
    return False


def _shown(chain: Any) -> dict[str, float]:
    return {"accept_rate": np.nan, "n_failed": chain.divergences}


def _is_stuck(
    trace: DataTree, rows: slice, before: Convergence | None, found: Convergence | None
) -> bool:
    """Whether chains diverge, and twice as many iterations have hardly raised what they are worth.

    As at the neck of a funnel, which they do not enter however long they run.
    """
    if before is None or found is None or found.least_ess >= _LEAST_GROWTH * before.least_ess:
        return False
    diverging = trace["sample_stats"].dataset["diverging"].values[:, rows]
    return bool(diverging.mean() > TOLERATED)


def _positions(trace: DataTree) -> Array:
    return np.asarray(trace["posterior"].dataset["position"])


def _n_made(positions: Array) -> int:
    """Draws that all chains have made."""
    return int(np.isfinite(positions).all(axis=(0, 2)).sum())


def _kept(trace: DataTree, length: Length, found: Convergence | None, seconds: float) -> NutsChains:
    """Every ``thin``-th draw of a trace, as far as all chains have come."""
    rows = slice(length.thin - 1, length.n_iterations, length.thin)
    positions = _positions(trace)
    rows = slice(rows.start, min(rows.stop, _n_made(positions)), rows.step)
    stats = trace["sample_stats"].dataset
    statistics = {
        kept: stats[name].values[:, rows] for name, kept in STATISTICS.items() if name in stats
    }
    return NutsChains(
        positions[:, rows], statistics, length, found, seconds, is_stuck=False, is_complete=True
    )
