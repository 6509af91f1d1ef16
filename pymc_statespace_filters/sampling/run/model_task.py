"""All chains of one model: their starts, how long they go on, and their results."""

import time
from collections.abc import Mapping
from functools import cached_property, partial

import numpy as np
from pymc.model import Model
from xarray import DataTree

from ...parallel.communicator import Communicator
from ...parallel.signals import unless_interrupted
from ..checkpoint.arrays import Stored
from ..checkpoint.record_file import RecordFile
from ..kernel.state import ChainState, Draws
from ..output.convergence import Convergence, convergence
from ..output.facts import of_model
from ..output.likelihood_variance import is_measured
from ..target.initial_points import chain_candidates
from ..target.record_target import RecordTarget, target_of
from ..target.target import Target
from ..target.variables import check_no_generators
from .chain_task import ChainTask, Store
from .model_result import tree_of
from .population_search import (
    SearchedPoints,
    WarmUp,
    first_cov,
    search_population,
    stops_of,
)
from .record_chain import chain_of
from .request import ExecutionOptions, SamplingRequest
from .stopping import Length, first_length, next_length
from .thinned_draws import Thinning

# Draws of each chain from which diagnostics are computed while chains run; of ten parameters this
# takes a tenth of a second.
_MOST_LIVE_DRAWS = 4000

_LENGTH = "length"  # key in the checkpoint


def key_of_chain(index: int) -> str:
    """The key of a chain in the checkpoint of its model."""
    return f"chain {index}"


class ModelTask:
    """The chains of a model, stored in its ``checkpoint`` if that is set.

    ``name`` is for messages, and empty if there is only one model; ``group`` are the ranks that
    evaluate the likelihoods together, of which this is the first. The ``target`` is given if it has
    been made already. Raises `ModelError` if the log-density draws random numbers.
    """

    def __init__(
        self,
        model: Model,
        request: SamplingRequest,
        name: str = "",
        group: Communicator | None = None,
        target: Target | RecordTarget | None = None,
    ):
        check_no_generators(model)
        self.model, self.request, self.name = model, request, name
        self._group = group
        self.checkpoint: RecordFile | None = None
        self.searched = SearchedPoints()
        self._given = target
        self._target: Target | RecordTarget | None = None
        self.n_iterations = stops_of(request)[0]  # after which the chains end, for now
        self.length = first_length(request)  # after the warm-up
        self._results: dict[int, tuple[Draws, ChainState]] = {}
        # The last diagnostics, and the iterations behind a draw and lengths that they are of.
        self._convergence: tuple[list[int], Convergence | None] = [], None
        self._began = self._ended = self._cpu_began = 0.0

    @property
    def is_distributed(self) -> bool:
        """Whether other ranks evaluate likelihoods together with this one."""
        return self._group is not None and self._group.size > 1

    def prepare(self) -> Target | RecordTarget:
        """Compile the model and find candidates for the starts, once."""
        if self._target is None:
            request = self.request
            target = self._given or target_of(
                self.model,
                request.settings,
                request.proposal_cov,
                self._group,
                has_pilot=request.pilot is not None,
                centres=request.is_centred,
            )
            self._target = target
            target.prepare()
            # Before the clocks and the bars of chains begin.
            chain_of(target, np.zeros(2, dtype=np.uint64), n_rows=0, n_covs=0).compile()
            self._seeds = np.random.SeedSequence(request.entropy).spawn(request.chains)
            self._candidates = chain_candidates(
                self.model,
                target.raveled,
                target.prior_draws,
                request.initvals,
                self._seeds,
                disperse=request.tune > 0,
            )
            self.measures_noise = is_measured(target, request.n_iterations)
        return self._target

    def chain_task(
        self, index: int, stored: Stored | None = None, store: Store | None = None
    ) -> ChainTask:
        """Make the task of a chain, from its start or from its checkpoint.

        Where this rank has no checkpoint, ``stored`` and ``store`` are as `ChainTask` takes them.
        """
        target, request, key = self.prepare(), self.request, key_of_chain(index)
        if self.checkpoint is not None:
            stored, store = self.checkpoint.read(key), partial(self.checkpoint.append, key)
        candidates, cov = self._candidates[index], None
        population = self.searched.x if request.initvals is None else None
        if isinstance(target, Target):
            given = candidates(np.random.default_rng(0))[-1]
            cov = first_cov(request, target, population, given)
        if population is not None:
            candidates = partial(_one_of, population)
        return ChainTask(
            target,
            request.tune,
            self.n_iterations,
            candidates,
            self._seeds[index],
            n_rows=request.tune + self._most_draws,
            thin=self.thin,
            former=request.former and (request.former.states[index], request.former.iterations),
            index=index,
            name=f"chain {index} of model {self.name!r}" if self.name else f"chain {index}",
            stored=stored,
            store=store,
            keeps_warmup=request.keeps_warmup,
            measures_noise=self.measures_noise,
            proposal_cov=cov,
            mixture=self.mixture,
        )

    def find_population(self, *, progressbar: bool) -> SearchedPoints:
        """Points of the posterior, found once for all chains; none if starts are given otherwise.

        None, too, if every record finds its own start, see `RecordChain.start`. Raises `ModelError`
        if no points can be found, though the pilot needs some.
        """
        target = self.prepare()
        if isinstance(target, RecordTarget):
            return SearchedPoints()
        return search_population(
            self.model,
            target,
            self.request,
            self.checkpoint,
            of_model(self.name),
            progressbar=progressbar,
        )

    def cost(self) -> float:
        """Estimate the seconds that a chain takes: as many evaluations as iterations."""
        evaluation = self.prepare().evaluation()
        seconds = []
        for _ in range(3):
            began = time.perf_counter()
            evaluation()
            seconds.append(time.perf_counter() - began)
        return min(seconds) * self.request.n_iterations

    def start_clock(self) -> None:
        """Note that a chain starts; the first one starts the sampling time."""
        self._began = self._began or time.monotonic()
        self._cpu_began = self._cpu_began or time.process_time()

    def add_result(self, index: int, draws: Draws, state: ChainState) -> None:
        """Keep the result of a chain, from any rank."""
        self._results[index] = draws, state
        self._ended = time.monotonic()

    @property
    def is_complete(self) -> bool:
        """Whether all chains have made ``n_iterations``."""
        lengths = [len(draws.positions) for draws, _ in self._results.values()]
        n_rows = Thinning(self.request.tune, self.thin).n_rows(self.n_iterations)
        return lengths == [n_rows] * self.request.chains

    def extend(self) -> bool:
        """Raise ``n_iterations`` if complete chains are to go on: after a part of the warm-up.

        Or to the next length, if the effective sample size is too small.
        """
        tune = self.request.tune
        if self.n_iterations < tune or (self.n_iterations == tune and self.length.draws):
            chains = [self._results[i][0] for i in range(self.request.chains)]
            end = self._warm_up.end_part(chains, self.n_iterations)
            self.n_iterations = end if end <= tune else tune + self.length.n_iterations
            return True
        if self.request.until_ess is None:
            return False
        seconds = time.process_time() - self._cpu_began
        longer = next_length(self.request, self.length, self.convergence(), seconds)
        if longer is None:
            return False
        if longer.thin > self.length.thin:
            self._results.clear()  # they are as long as what follows them
        self.length, self.n_iterations = longer, tune + longer.n_iterations
        self._store_length()
        return True

    def set_length(self, length: Length) -> None:
        """Set the length after which chains end, before any has begun."""
        self.length = length
        if self.request.tune == 0:
            self.n_iterations = length.n_iterations

    @property
    def thin(self) -> int:
        """Iterations of which one draw is kept."""
        return self.length.thin

    @property
    def _most_draws(self) -> int:
        """Draws that a chain may have after its warm-up."""
        request = self.request
        return request.draws if request.doubles_thin else request.max_draws or request.draws

    @property
    def seconds(self) -> float:
        """That sampling took."""
        return self._ended - self._began

    def stored_length(self) -> Length:
        """The length to which the chains of the checkpoint were to go on, if there is one."""
        stored = None
        if self.checkpoint is not None and self.request.doubles_thin:
            stored = self.checkpoint.read(_LENGTH)
        return self.length if stored is None else Length(*stored.draws["length"][-1].tolist())

    def _store_length(self) -> None:
        """Store the length in the checkpoint: coarser draws do not show why they went on."""
        if self.checkpoint is not None and self.request.doubles_thin:
            self.checkpoint.append(_LENGTH, {"length": np.array([self.length])}, {})

    @property
    def mixture(self) -> np.ndarray:
        """The packed mixture of the chains' proposals, of the current part."""
        return self._warm_up.mixture

    @cached_property
    def _warm_up(self) -> WarmUp:
        target = self.prepare()
        dim = target.raveled.dim if isinstance(target, Target) else 0
        is_noisy = bool(target.seed_names)
        return WarmUp(self.request, dim, self.searched.x, is_noisy=is_noisy)

    def convergence(self) -> Convergence | None:
        """Diagnostics of the results; computed once, as it takes long for many draws."""
        positions = self._positions({})
        lengths = [self.thin, *map(len, positions)]
        if lengths != self._convergence[0]:
            self._convergence = lengths, convergence(positions)
        return self._convergence[1]

    def convergence_so_far(self, running: Mapping[int, ChainTask]) -> Convergence | None:
        """Diagnostics of the results and of chains that run here, from some of their draws."""
        return convergence(self._positions(running), _MOST_LIVE_DRAWS)

    def _positions(self, running: Mapping[int, ChainTask]) -> list[np.ndarray]:
        """Draws after the warm-up of the chains that have results or run here."""
        tune = self.request.tune
        positions = {i: draws.positions[tune:] for i, (draws, _) in self._results.items()}
        positions |= {i: chain.positions for i, chain in running.items()}
        return self.request.with_former(positions)

    def load_missing_results(self) -> None:
        """Load chains that never ran from the checkpoint, as after an interruption."""
        for index in set(range(self.request.chains)) - set(self._results):
            self._results[index] = self.chain_task(index).result()

    @property
    def has_draws(self) -> bool:
        """Whether a chain has made an iteration that is kept."""
        n_skipped = self.request.n_skipped
        return any(len(draws.positions) > n_skipped for draws, _ in self._results.values())

    def to_datatree(self, options: ExecutionOptions) -> DataTree:
        """Make the DataTree of all chains; ``options.told`` is called with the fact of their end.

        The task keeps no results: the draws are in memory twice, but never three times.
        """
        request, found, is_complete = self.request, None, self.is_complete
        if options.compute_convergence_checks or request.until_ess is not None:
            found = unless_interrupted(self.convergence, None)
        return tree_of(
            self,
            [self._results.pop(index) for index in range(request.chains)],
            found,
            options,
            is_complete=is_complete,
        )


def _one_of(population: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """The only candidate for a start: one of the points (m, d)."""
    return list(rng.permutation(population)[:1])
