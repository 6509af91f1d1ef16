"""The base class of filters that move members by noise: the functions that they compile."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint, address_of
from pymc_statespace_filters.compiler.native.jit import keep_alive, njit_callable, njit_internal
from pymc_statespace_filters.compiler.numerics.normals import BLOCK, padded
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.ensemble.callbacks import NO_CALLBACK
from pymc_statespace_filters.filters.ensemble.loop import FilterArguments
from pymc_statespace_filters.filters.ensemble.noise import (
    STORE_NORMALS,
    NoiseSizes,
    StoreArguments,
    n_stored,
)
from pymc_statespace_filters.filters.ensemble.partition import SINGLE_RANK
from pymc_statespace_filters.filters.ensemble.summaries import run_function, states_function
from pymc_statespace_filters.filters.outcomes import OUT_OF_MEMORY
from pymc_statespace_filters.filters.protocol import (
    DistributedLogLikelihoodFunction,
    HealthFunction,
    LogLikelihoodFunction,
    RunFunction,
    StatesFunction,
    StoredNoiseFunction,
    System,
)
from pymc_statespace_filters.filters.system_table import system_table


class EnsembleFilterBase:
    """A filter whose likelihood is an estimate made with noise; an `EnsembleFilter`.

    A subclass is a frozen dataclass of settings. It gives its ``entry`` (see
    `loop.ensemble_filter`), `size` and `settings`, which the entry reads, and how it smooths.

    Attributes
    ----------
    unbiased : bool
        Whether the mean of the estimates is the likelihood, for any number of members.
    simulates : bool
        Whether an update simulates an observation of every member.
    """

    noisy: ClassVar[bool] = True
    unbiased: ClassVar[bool] = False
    has_gradient: ClassVar[bool] = False
    simulates: ClassVar[bool] = False
    entry: ClassVar[EntryPoint]

    def size(self) -> int:
        """Return the number of members."""
        raise NotImplementedError

    def settings(self) -> tuple[float, ...]:
        """Return the settings that the entry reads besides the size, choices by their number."""
        raise NotImplementedError

    def smoother(self, system: System) -> CompiledFunction[StatesFunction]:
        """Compile the smoother of this filter for one system."""
        raise NotImplementedError

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""
        raise NotImplementedError

    def resampling_normals(self) -> int:
        """Return how many normals a resampling takes."""
        return 0

    def ordering(self) -> EntryPoint | None:
        """Return the function that sorts members, if the filter sorts them."""
        return None

    def algorithm(self, system: System) -> "EnsembleFilterBase":
        """Return the filter that treats this system: itself, unless it reduces to another."""
        return self

    def smooth(self, system: System) -> "EnsembleFilterBase":
        """Return this filter with an estimate that changes little when its normals do."""
        return self

    def check(self, system: System) -> None:
        """Raise if the filter cannot treat the system."""

    def is_exact_for(self, system: System) -> bool:
        """Whether the expected likelihood is that of the system, for any number of members."""
        return self.unbiased and system.has_exact_observation_density

    def max_ranks(self) -> int:
        """Return how many ranks can have a whole block of 64 members each.

        A rank with only part of a block might compute it by other instructions, as there are too
        few members for the vector code of the others, and differ in the last bit.
        """
        return max(1, self.size() // BLOCK)

    # Noise

    def noise_sizes(self, system: System) -> NoiseSizes:
        """Return how many normals the filter takes where."""
        simulated = system.r if self.simulates else 0
        resampling = self.resampling_normals()
        return NoiseSizes(padded(self.size()), system.n_start, system.m, simulated, resampling)

    def n_normals(self, system: System, n_steps: Any, n_observations: Any) -> Any:
        """Return how many normals an evaluation stores: a number, or an expression of symbols."""
        sizes = self.algorithm(system).noise_sizes(system)
        return n_stored.py_func(sizes, n_steps, n_observations)

    def stored_noise(self, system: System) -> CompiledFunction[StoredNoiseFunction]:
        """Compile the function (steps, seed) -> the normals that an evaluation with it uses."""
        sizes = self.algorithm(system).noise_sizes(system)
        width, initial, process, observation, resampling = sizes
        STORE_NORMALS.compile()
        store = STORE_NORMALS.external

        @njit_callable
        def stored(steps, seed):
            n_steps = steps[-1] if steps.size else np.int64(0)
            out = np.empty(n_stored(sizes, n_steps, steps.size))
            arguments = StoreArguments(
                seed=seed, steps=steps.ctypes.data, n_observations=steps.size, width=width,
                initial=initial, process=process, observation=observation, resampling=resampling,
                out=out.ctypes.data,
            )  # fmt: skip
            store(*arguments)
            return out

        return CompiledFunction(stored, key_of(f"stored noise {sizes}", STORE_NORMALS.key))

    # Compiled functions

    def compile(self, system: System) -> CompiledFunction[LogLikelihoodFunction]:
        """Compile the log-likelihood."""
        evaluation = self.algorithm(system).evaluation(system)
        evaluate = evaluation.function

        @njit_callable
        def run(theta, steps, observed, inputs, t0, noise):
            terms, _, health = evaluate(
                theta, steps, observed, inputs, t0, noise, NO_CALLBACK, SINGLE_RANK
            )
            return terms, health

        return CompiledFunction(run, key_of("likelihood", evaluation.key))

    def compile_health(self, system: System) -> CompiledFunction[HealthFunction]:
        """Compile the effective number behind every term of `compile`."""
        evaluation = self.algorithm(system).evaluation(system)
        evaluate = evaluation.function

        @njit_callable
        def run(theta, steps, observed, inputs, t0, seed):
            noise = (seed, np.empty(0))
            return evaluate(theta, steps, observed, inputs, t0, noise, NO_CALLBACK, SINGLE_RANK)

        return CompiledFunction(run, key_of("health", evaluation.key))

    def compile_distributed(
        self, system: System
    ) -> CompiledFunction[DistributedLogLikelihoodFunction]:
        """Compile the log-likelihood for members that are divided among ranks.

        Each rank moves its own members (see `partition`); terms and health are equal on all ranks,
        bit for bit those of `compile`.
        """
        evaluation = self.algorithm(system).evaluation(system)
        evaluate = evaluation.function

        @njit_callable
        def run(theta, steps, observed, inputs, t0, seed, rank, n_ranks, exchange):
            noise, layout = (seed, np.empty(0)), (rank, n_ranks, exchange)
            terms, _, health = evaluate(
                theta, steps, observed, inputs, t0, noise, NO_CALLBACK, layout
            )
            return terms, health

        return CompiledFunction(run, key_of("distributed likelihood", evaluation.key))

    def compile_states(self, system: System, moment: str) -> CompiledFunction[StatesFunction]:
        """Compile "predicted", "filtered" or "smoothed" states."""
        filter = self.algorithm(system)
        if moment == "smoothed":
            return filter.smoother(system)
        return states_function(filter.with_callback(system), system.n, self.size(), moment)

    def compile_run(self, system: System) -> CompiledFunction[RunFunction]:
        """Compile one run with all that it computes."""
        with_callback = self.algorithm(system).with_callback(system)
        return run_function(with_callback, system.n, self.size())

    def with_callback(self, system: System) -> CompiledFunction:
        """Compile the likelihood with a callback: its address and its two vectors."""
        evaluation = self.evaluation(system)
        evaluate = evaluation.function

        @njit_callable
        def run(theta, steps, observed, inputs, t0, noise, callback):
            terms, _, health = evaluate(
                theta, steps, observed, inputs, t0, noise, callback, SINGLE_RANK
            )
            return terms, health

        return CompiledFunction(run, key_of("with callback", evaluation.key))

    def functions(self) -> Sequence[str]:
        """Return the names of the system's functions that the entry calls."""
        simulated = ("observe",) if self.simulates else ()
        return "initialise", "propagate", "log_density", *simulated

    def evaluation(self, system: System) -> CompiledFunction:
        """Bind the filter's entry point to one system."""
        self.entry.compile()
        order = "" if (ordering := self.ordering()) is None else ordering.symbol
        if ordering is not None:
            ordering.compile()
        table = system_table(system, self.functions())
        evaluate, make_table, dt = self.entry.external, table.make, system.dt
        sizes = self.noise_sizes(system)
        settings = np.array([self.size(), *sizes, *self.settings()], dtype=np.float64)

        @njit_internal
        def run(theta, steps, observed, inputs, t0, noise, callback, layout):
            seed, normals = noise
            n_steps = steps[-1] if steps.size else np.int64(0)
            if normals.size and normals.size != n_stored(sizes, n_steps, steps.size):
                raise ModelError("normals must be those of this filter, system and steps")
            terms, health = np.full(steps.size, -np.inf), np.empty(3)
            n_effective = np.full(steps.size, np.nan)
            health[0], health[1], health[2] = 0.0, OUT_OF_MEMORY, 0.0
            table = make_table()
            arguments = FilterArguments(
                table=table.ctypes.data, dt=dt, theta=theta.ctypes.data, n_theta=theta.size,
                inputs=inputs.ctypes.data, n_rows=inputs.shape[0], settings=settings.ctypes.data,
                steps=steps.ctypes.data, n_observations=steps.size, observed=observed.ctypes.data,
                t0=t0, seed=seed, normals=normals.ctypes.data, n_normals=normals.size,
                order=address_of(order), callback=callback[0], integers=callback[1],
                reals=callback[2], rank=layout[0], n_ranks=layout[1], exchange=layout[2],
                terms=terms.ctypes.data, n_effective=n_effective.ctypes.data,
                health=health.ctypes.data,
            )  # fmt: skip
            evaluate(*arguments)
            keep_alive(table)
            keep_alive(normals)
            return terms, n_effective, health

        return CompiledFunction(
            run, key_of(f"{self!r} {settings.tolist()} {order}", table.key, self.entry.key)
        )
