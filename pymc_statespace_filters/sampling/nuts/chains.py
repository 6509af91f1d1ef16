"""Chains of nutpie, looked at while they run, until their draws are worth enough."""

import math
import time
import warnings
from collections.abc import Callable
from threading import Semaphore
from typing import Any, NamedTuple

import numpy as np
import nutpie
from numpy.typing import NDArray
from nutpie.compiled_pyfunc import from_pyfunc
from xarray import DataTree

from ...errors import ModelError
from ...parallel.signals import interrupts_are_noted, takes_interrupt
from ..output.chain_bars import ChainProgress
from ..output.convergence import Convergence, convergence
from ..output.facts import TOLERATED
from ..run.request import SamplingRequest
from ..run.stopping import Length, first_length, next_length
from .frame import Frame
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
# Chains that diverge go on only as long as a doubling of their iterations, which should double the
# effective draws, raises them so much.
_LEAST_GROWTH = 1.25


class NutsChains(NamedTuple):
    """Positions (chain, draw, d) and statistics of kept draws, and what lies behind them."""

    positions: Array
    statistics: dict[str, np.ndarray]
    length: Length
    found: Convergence | None
    seconds: float
    is_stuck: bool  # whether they diverged, and ended as more iterations had not helped
    is_complete: bool  # whether they have made as many iterations as they were to
    n_gradients: int  # with those of the warm-up
    is_beaten: bool = False  # whether they ended as they take more gradients than they may


def run_nuts(
    density: DensityGradient,
    points: Array,
    frame: Frame,
    request: SamplingRequest,
    *,
    cores: int,
    seed: int,
    progressbar: bool | str,
    most_gradients: float = np.inf,
) -> NutsChains:
    """Run the chains of a request in the coordinates of a frame, each from one of m points (m, d).

    They end where they are seen to take more gradients than the most. Ctrl-C ends them; the draws
    that all have made are kept.
    """
    allowed = Semaphore(cores)

    def evaluate_in_turn() -> Callable[[Array], tuple[float, Array]]:
        evaluate = frame.within(density.for_a_thread())

        def waiting(x: Array) -> tuple[float, Array]:
            with allowed:
                return evaluate(x)

        return waiting

    dim = len(frame.centre)
    model = from_pyfunc(
        dim,
        evaluate_in_turn,
        lambda *_: lambda z: {"position": frame.positions(z)},
        [np.dtype(np.float64)],
        [(dim,)],
        ["position"],
        make_initial_point_fn=lambda seed: frame.coordinates(
            points[np.random.default_rng(seed).integers(len(points))]
        ),
    )
    began = time.monotonic(), time.process_time()
    interrupts_are_noted()
    size = request.chains, request.draws, request.tune
    with ChainProgress(*size, progressbar, has_rate=False) as bars:
        sampler = nutpie.sample(
            model,
            draws=request.max_draws or request.draws,
            tune=request.tune,
            chains=request.chains,
            cores=request.chains,  # or the first would run to their end before the others begin
            seed=seed,
            progress_bar=False,
            progress_rate=50,
            adaptation=frame.adaptation,
            blocking=False,
            progress_callback=(watch := _Watch()),
        )
        return _followed(sampler, watch, request, bars, began, most_gradients)


class _Watch:
    """The last progress of each chain, which nutpie reports from a thread of its own."""

    def __init__(self) -> None:
        self.chains: list[Any] = []

    def __call__(self, chains: list[Any]) -> None:
        self.chains = chains


def _followed(
    sampler: Any,
    watch: _Watch,
    request: SamplingRequest,
    bars: ChainProgress,
    began: tuple[float, float],
    most_gradients: float,
) -> NutsChains:
    """Wait for the chains, and end them at the first length whose draws are worth enough."""
    length, found, is_stuck, is_beaten = first_length(request), None, False, False
    while not takes_interrupt():
        time.sleep(_SECONDS)
        made = [chain.finished_draws for chain in watch.chains]
        for i, chain in enumerate(watch.chains):
            bars.update(i, chain.finished_draws, _shown(chain))
        is_over = _is_finished(sampler)
        due = request.tune + length.n_iterations
        is_beaten = _gradients_within(watch.chains, due) > most_gradients
        if is_beaten:
            break
        if not is_over and (not made or min(made) < due):
            continue
        for i, chain in enumerate(watch.chains):  # which may be what was said before the end
            bars.update(i, request.tune + length.n_iterations, _shown(chain))
        trace = sampler.inspect()
        positions = _positions(trace)
        rows = slice(length.thin - 1, length.n_iterations, length.thin)
        before, found = found, convergence(list(positions[:, rows]))
        longer = next_length(request, length, found, time.process_time() - began[1])
        is_stuck = longer is not None and _is_stuck(trace, rows, before, found)
        is_beaten = longer is not None and _n_gradients(trace, rows.stop) > most_gradients
        if is_stuck or is_beaten or longer is None:
            break
        if is_over and _n_made(positions) < longer.n_iterations:
            break
        length = longer
        for i in range(request.chains):
            bars.extend(i, request.tune + length.n_iterations)
    seconds = time.monotonic() - began[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # ArviZ doubts fewer draws than chains
        trace = sampler.abort()
    kept = _kept(trace, length, found, seconds)
    kept = kept._replace(is_stuck=is_stuck, is_beaten=is_beaten)
    made = kept.positions.shape[1]
    if is_beaten:  # how many draws there are depends on when it was seen, and what they took
        return kept._replace(found=None, n_gradients=math.floor(most_gradients) + 1)
    if made == length.draws:
        return kept
    found = convergence(list(kept.positions))
    return kept._replace(length=length._replace(draws=made), found=found, is_complete=False)


def _is_finished(sampler: Any) -> bool:
    try:
        return bool(sampler.is_finished)
    except TimeoutError:  # nutpie did not answer at once
        return False
    except RuntimeError as error:  # with the trace of its machine code
        reason = str(error).partition("\n")[0]
        raise ModelError(
            f"NUTS could not start, as density and gradient are not finite where it tried: {reason}"
        ) from None


def _shown(chain: Any) -> dict[str, float]:
    return {"n_failed": chain.divergences}


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


def _gradients_within(chains: list[Any], n_iterations: int) -> int:
    """Gradients so far of the chains that have made no more iterations than these.

    Those of later ones depend on when they are counted.
    """
    return sum(c.total_num_steps for c in chains if c.finished_draws <= n_iterations)


def _n_gradients(trace: DataTree, n_iterations: int) -> int:
    """Gradients of the warm-up and of so many iterations after it; NaN where a chain has none."""
    of_warm_up, of_draws = (
        trace[group].dataset["n_steps"].values for group in ("warmup_sample_stats", "sample_stats")
    )
    return int(np.nansum(of_warm_up) + np.nansum(of_draws[:, :n_iterations]))


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
        positions[:, rows],
        statistics,
        length,
        found,
        seconds,
        is_stuck=False,
        is_complete=True,
        n_gradients=_n_gradients(trace, rows.stop),
    )
