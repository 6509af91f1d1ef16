"""What every filter that moves members by noise has in common towards the rest of the package."""

from typing import Any, ClassVar

import numpy as np

from pymc_statespace_filters.compiler.codegen.function_types import CompiledFunction
from pymc_statespace_filters.compiler.lowering.ensemble import Machine, ensemble_machine
from pymc_statespace_filters.compiler.lowering.entry_points import machine_entries
from pymc_statespace_filters.compiler.native.cache_key import key_of
from pymc_statespace_filters.compiler.native.entry_point import EntryPoint, address_of
from pymc_statespace_filters.compiler.native.jit import keep_alive, njit_contract
from pymc_statespace_filters.compiler.numerics.philox import BLOCK, padded
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.ensemble.callbacks import NO_CALLBACK
from pymc_statespace_filters.filters.ensemble.noise import STORE_NORMALS, NoiseSizes, n_stored
from pymc_statespace_filters.filters.ensemble.partition import SINGLE_RANK
from pymc_statespace_filters.filters.ensemble.run_summaries import members_kernel
from pymc_statespace_filters.filters.ensemble.summaries import summary_kernel
from pymc_statespace_filters.filters.ensemble.system_table import N_TABLE
from pymc_statespace_filters.filters.outcomes import OUT_OF_MEMORY
from pymc_statespace_filters.system.model import StateSpaceModel


class EnsembleFilter:
    """A filter whose likelihood is an estimate made with noise.

    A filter gives its ``entry``, see `_loop.filter_entry`, and what `settings` reads.
    """

    noisy: ClassVar[bool] = True
    unbiased: ClassVar[bool] = False
    has_gradient: ClassVar[bool] = False
    needs_simulated_observations: ClassVar[bool] = False
    simulates: ClassVar[bool] = False
    entry: ClassVar[EntryPoint]

    def size(self) -> int:
        """Return the number of members."""
        raise NotImplementedError

    def settings(self) -> tuple[float, ...]:
        """Return the settings that the entry reads besides the size, choices by their number."""
        raise NotImplementedError

    def most_ranks(self) -> int:
        """Return how many ranks can have a whole block of 64 members each.

        One that had but a part of a block might compute it by other instructions, as there are too
        few for the vector code of the others, and differ in the last bit.
        """
        return max(1, self.size() // BLOCK)

    def resampling_normals(self) -> int:
        """Return how many normals a resampling takes."""
        return 0

    def check(self, system: StateSpaceModel) -> None:
        """Raise if the system is not one that this filter can treat."""
        if self.needs_simulated_observations and not system.gaussian_observation:
            raise ModelError(
                f"{type(self).__name__} nudges members by a Kalman gain and so needs an "
                f"observation function with Gaussian noise; with observation_dist or "
                f"observation_logp use the particle filters BootstrapPF or PFEnKF"
            )

    def is_exact_for(self, system: StateSpaceModel) -> bool:
        """Whether the expected likelihood is that of the system, for any number of members."""
        # Noise that is not additive enters the density through its linearisation.
        return self.unbiased and (system.additive_noise or not system.gaussian_observation)

    def algorithm(self, machine: Machine) -> "EnsembleFilter":
        """Return the filter that treats this system: itself, unless nothing is to be nudged."""
        return self

    def smooth(self, system: StateSpaceModel) -> "EnsembleFilter":
        """Return this filter with an estimate that changes little when its normals do."""
        return self

    def n_normals(self, system: StateSpaceModel, n_steps: Any, n_observations: Any) -> Any:
        """How many normals an evaluation stores; of numbers a number, of symbols an expression."""
        machine = ensemble_machine(system)
        sizes = self.algorithm(machine).noise_sizes(machine)
        return n_stored.py_func(sizes, n_steps, n_observations)

    def noise_sizes(self, machine: Machine) -> NoiseSizes:
        """Return how many normals the filter takes where."""
        simulated = machine.r if self.simulates else 0
        resampling = self.resampling_normals()
        return NoiseSizes(padded(self.size()), machine.n, machine.m, simulated, resampling)

    def compile(self, system: StateSpaceModel) -> CompiledFunction:
        """The function (theta, steps, observed, inputs, t0, noise) -> (terms, health).

        ``noise`` is a seed and a vector of stored normals; the seed counts where the vector is
        empty.
        """
        machine = ensemble_machine(system)
        return CompiledFunction(self.kernel(machine), key_of(repr(self), machine.key))

    def kernel(self, machine: Machine) -> Any:
        """Bind the filter's entry to the functions of one system."""
        evaluate = self.algorithm(machine)._bound(machine)

        @njit_contract
        def run(theta, steps, observed, inputs, t0, noise):
            return evaluate(theta, steps, observed, inputs, t0, noise, NO_CALLBACK, SINGLE_RANK)

        return run

    def compile_shared(self, system: StateSpaceModel) -> CompiledFunction:
        """The function (theta, steps, observed, inputs, t0, seed, rank, n_ranks, exchange).

        It moves one rank's share of the members (see `_share`) and gives the same terms and health
        on all ranks, to the bit those of `compile` on one.
        """
        machine = ensemble_machine(system)
        return CompiledFunction(
            self.shared_kernel(machine), key_of(f"shared {self!r}", machine.key)
        )

    def shared_kernel(self, machine: Machine) -> Any:
        """Bind the filter's entry to one system, for several ranks."""
        evaluate = self.algorithm(machine)._bound(machine)

        @njit_contract
        def run(theta, steps, observed, inputs, t0, seed, rank, n_ranks, exchange):
            noise, layout = (seed, np.empty(0)), (rank, n_ranks, exchange)
            return evaluate(theta, steps, observed, inputs, t0, noise, NO_CALLBACK, layout)

        return run

    def with_callback(self, machine: Machine) -> Any:
        """The kernel with the addresses of a witness and its two vectors: `_witness`."""
        evaluate = self._bound(machine)

        @njit_contract
        def run(theta, steps, observed, inputs, t0, noise, watch):
            return evaluate(theta, steps, observed, inputs, t0, noise, watch, SINGLE_RANK)

        return run

    def _bound(self, machine: Machine) -> Any:
        self.entry.compile()
        evaluate, make_table, dt = self.entry.external, system_table(machine), machine.dt
        sizes = self.noise_sizes(machine)
        settings = np.array([self.size(), *sizes, *self.settings()], dtype=np.float64)

        @njit_contract
        def run(theta, steps, observed, inputs, t0, noise, watch, layout):
            seed, normals = noise
            n_steps = steps[-1] if steps.size else np.int64(0)
            if normals.size and normals.size != n_stored(sizes, n_steps, steps.size):
                raise ModelError("normals must be those of this filter, system and steps")
            terms, health = np.full(steps.size, -np.inf), np.empty(3)
            health[0], health[1], health[2] = 0.0, OUT_OF_MEMORY, 0.0
            table = make_table()
            evaluate(
                table.ctypes.data, dt, settings.ctypes.data, theta.ctypes.data, theta.size,
                steps.ctypes.data, steps.size, observed.ctypes.data,
                inputs.ctypes.data, inputs.shape[0], t0,
                seed, normals.ctypes.data, normals.size, *watch, *layout,
                terms.ctypes.data, health.ctypes.data,
            )  # fmt: skip
            keep_alive(table)
            keep_alive(normals)
            return terms, health

        return run

    def compile_states(self, system: StateSpaceModel, moment: str) -> CompiledFunction:
        """The function (theta, steps, observed, inputs, t0, seed, rows, draw_seed) -> states.

        See `filters`, the room, for what it returns.
        """
        machine = ensemble_machine(system)
        filter = self.algorithm(machine)
        if moment == "smoothed":
            kernel = filter.smoother(system, machine)
        else:
            kernel = summary_kernel(filter.with_callback(machine), system.n, self.size(), moment)
        return CompiledFunction(kernel, key_of(f"{moment} states {self!r}", machine.key))

    def compile_run(self, system: StateSpaceModel) -> CompiledFunction:
        """The function (theta, steps, observed, inputs, t0, seed, rows) -> a run.

        See `filters`, the room, for what it returns.
        """
        machine = ensemble_machine(system)
        with_callback = self.algorithm(machine).with_callback(machine)
        kernel = members_kernel(with_callback, system.n, self.size())
        return CompiledFunction(kernel, key_of(f"run {self!r}", machine.key))

    def smoother(self, system: StateSpaceModel, machine: Machine) -> Any:
        """Bind the smoother of this filter to one system."""
        raise NotImplementedError

    def smoothing_method(self, system: StateSpaceModel) -> str:
        """Name the method of the smoothed states."""
        raise NotImplementedError

    def stored_noise(self, system: StateSpaceModel) -> CompiledFunction:
        """The function (steps, seed) -> the normals that an evaluation with this seed uses."""
        return self.stored_normals(ensemble_machine(system))

    def stored_normals(self, machine: Machine) -> CompiledFunction:
        """Bind the making of normals to the sizes of one system."""
        sizes = self.algorithm(machine).noise_sizes(machine)
        width, initial, process, observation, resampling = sizes
        STORE_NORMALS.compile()
        store = STORE_NORMALS.external

        @njit_contract
        def stored(steps, seed):
            n_steps = steps[-1] if steps.size else np.int64(0)
            out = np.empty(n_stored(sizes, n_steps, steps.size))
            store(
                seed, steps.ctypes.data, steps.size, width, initial, process, observation,
                resampling, out.ctypes.data,
            )  # fmt: skip
            return out

        return CompiledFunction(stored, key_of(f"stored noise {sizes}", STORE_NORMALS.key))


def system_table(machine: Machine) -> Any:
    """A function () -> the table that `_system.read_system` reads."""
    functions = machine_entries(machine)
    for entry in functions:
        if entry is not None:
            entry.compile()
    prepare, initialise, propagate, log_density = (f.symbol for f in functions[:4])
    observe = functions.observe.symbol if functions.observe is not None else ""
    shape = (machine.n, machine.p, machine.n_inputs, machine.n_constants, machine.free.size)
    padding = [0] * (N_TABLE - len(shape))
    constants = np.array([*shape, *padding, *machine.free], dtype=np.int64)

    @njit_contract
    def make_table():
        table = constants.copy()
        table[5], table[6] = address_of(prepare), address_of(initialise)
        table[7], table[8] = address_of(propagate), address_of(log_density)
        table[9] = address_of(observe)
        return table

    return make_table
