"""A PyMC model's log-density as one call of machine code.

The value variables that a sampler moves are raveled into one vector; the other variables and the
noise of estimated likelihoods are further arguments. The same call returns the health of the
filters, so that the reason of a failure costs no second evaluation.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytensor.tensor as pt
from numpy.typing import ArrayLike
from pymc.model import Model
from pymc.pytensorf import join_nonshared_inputs
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.compiler.native.parallel_map import ParallelMap
from pymc_statespace_filters.compiler.native.pytensor_function import NativeFunction
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.parallel.communicator import Communicator
from pymc_statespace_filters.parallel.signals import held_interrupts
from pymc_statespace_filters.pymc_model.compilation import compile_density
from pymc_statespace_filters.pymc_model.graph_rewrites import (
    autoregressive_noise,
    with_filter,
    with_likelihood_callback,
)
from pymc_statespace_filters.pymc_model.inspection import (
    health_outputs,
    log_density_terms,
    state_space_nodes,
)
from pymc_statespace_filters.sampling.kernel.state import RAISED, Evaluation, NativeLogDensity
from pymc_statespace_filters.sampling.kernel.transition import evaluate
from pymc_statespace_filters.sampling.target.leader_follower import Leader, leader_errors


class LogDensity:
    """Compiled log-density of a model on its unconstrained space, with its noise as an argument.

    The value variables that are not raveled are further arguments, in the order of their names,
    ``others``.

    Parameters
    ----------
    model : pymc.Model
    variables : sequence of TensorVariable
        Continuous value variables that are raveled into one vector, in this order.
    point : mapping of str to ndarray
        Any point of the model, as the first values of all arguments.
    seeds : mapping of str to shared variable
        The noise seeds, by the name of their StateSpace variable.
    compile_kwargs : dict, optional
        Passed to PyMC's compiler.
    fixed_noise : bool
        Whether every evaluation uses the noise of the model's seeds. Their normals are then drawn
        once, in `prepare`, and the seeds of a call are not read.
    correlation : float, optional
        If given, the normals of an evaluation are ``correlation`` times those carried by the chain
        plus fresh ones, of the same variance.
    graph : TensorVariable, optional
        The log-density if it is not the model's own, see `screening_density`.
    group : Communicator, optional
        Ranks that evaluate the noisy likelihoods together. The first, this one, evaluates the
        log-density; the others call `leader_follower.follow`.
    extra : sequence of TensorVariable
        Further results for `at_rows`.
    """

    def __init__(
        self,
        model: Model,
        variables: Sequence[TensorVariable],
        point: Mapping[str, np.ndarray],
        seeds: Mapping[str, TensorVariable],
        compile_kwargs: dict | None = None,
        *,
        fixed_noise: bool = False,
        correlation: float | None = None,
        graph: TensorVariable | None = None,
        group: Communicator | None = None,
        extra: Sequence[TensorVariable] = (),
    ):
        others = [v for v in model.value_vars if v not in variables]
        self.others = tuple(v.name for v in others)
        density = model.logp() if graph is None else graph
        outputs = [density, model.logp(vars=model.free_RVs), *health_outputs([density])]
        self._n_healths = len(outputs) - 2
        outputs += extra
        seed_inputs = {seed: seed.type(f"{name}_seed_input") for name, seed in seeds.items()}
        noise_inputs: list[Variable] = []
        noise: list[Variable] = []
        self._leader: Leader | None = None
        self._has_callback = False
        self._carries_noise = correlation is not None and bool(seeds) and not fixed_noise
        if self._carries_noise:
            graphs, moved = autoregressive_noise(outputs, seeds)
            outputs = [*graphs, *moved.moved]
            noise_inputs, noise = [moved.correlation, *moved.normals], list(moved.sizes)
        else:
            # Also on one rank: the same machine code gives the same bits.
            outputs, callback = with_likelihood_callback(outputs, seeds if fixed_noise else {})
            noise_inputs, noise = list(callback.normals), list(callback.normals.values())
            if callback.kinds:
                self._has_callback = True
                noise_inputs = [callback.address, *noise_inputs]
            if group is not None:
                self._leader = Leader(group, callback.kinds)
        # The stored normals, or their numbers, which depend on the data.
        self._make_noise: Any = compile_density([], noise) if noise else list
        self._n_noises = len(noise)
        outputs, joined = join_nonshared_inputs(
            point, outputs, variables, shared_inputs=seed_inputs
        )
        inputs = [joined, *seed_inputs.values(), *others, *noise_inputs]
        self._function = compile_density(inputs, outputs, **(compile_kwargs or {}))
        self._function.trust_input = True
        self._n_seeds = len(seeds)
        self._start = np.concatenate([np.ravel(point[v.name]) for v in variables], dtype=np.float64)
        self._others = [np.array(point[name]) for name in self.others]
        self._native: NativeFunction | None = None
        self._normals: list[np.ndarray] = []

    def __getstate__(self) -> dict:
        """Leave out the machine code, which another process loads itself."""
        return self.__dict__ | {"_native": None, "_normals": []}

    @property
    def n_carried(self) -> int:
        """Number of normals that a chain carries; known once prepared."""
        return sum(normals.size for normals in self._normals) if self._carries_noise else 0

    def prepare(self) -> NativeFunction:
        """Load the machine code, and read the data as they are now."""
        self._normals = self._first_normals()
        seeds = np.zeros(self._n_seeds, dtype=np.int64)
        inputs = self._inputs(self._start, self._others, np.zeros(()), self._normals, seeds)
        with leader_errors(self._leader):
            self._native = NativeFunction(self._function, inputs)
        return self._native

    def at_rows(self) -> "ParallelMap | RowsOnAllRanks":
        """A function of positions (m, d) and m seeds of each noisy variable.

        The first columns of its results are the log-density and that of the prior, the last ones
        are ``extra``. It works in threads, unless all ranks evaluate together.
        """
        if self._leader is not None:
            return RowsOnAllRanks(self.bind())
        seeds = np.zeros(self._n_seeds, dtype=np.int64)
        inputs = self._inputs(self._start, self._others, np.zeros(()), self._first_normals(), seeds)
        n = 1 + self._n_seeds
        return ParallelMap(self._function, inputs[:n], inputs[n:])

    def bind(self) -> "BoundLogDensity":
        """Make the log-density callable from one thread, with separate arrays."""
        native = self._native or self.prepare()
        position, others = self._start.copy(), [value.copy() for value in self._others]
        seeds = np.zeros(self._n_seeds, dtype=np.int64)
        correlation, carried = np.zeros(()), np.zeros(self.n_carried)
        normals = self._normals
        if self._carries_noise:
            ends = np.cumsum([values.size for values in normals])
            normals = np.split(carried, ends[:-1])
        inputs = self._inputs(position, others, correlation, normals, seeds)
        call, buffers = native.bind(inputs)

        def raise_error(_keep_alive: Any = buffers) -> None:
            with leader_errors(self._leader):
                native(*inputs)

        arguments = NativeLogDensity(call, position, seeds, self._n_healths)
        return BoundLogDensity(arguments, others, correlation, carried, raise_error)

    def _inputs(
        self,
        position: np.ndarray,
        others: Sequence[np.ndarray],
        correlation: np.ndarray,
        normals: Sequence[np.ndarray],
        seeds: np.ndarray,
    ) -> list[np.ndarray]:
        """Arguments of the compiled function; parts of an array are views of it."""
        first = [correlation] if self._carries_noise else []
        if self._has_callback:
            first = [np.zeros((), np.int64) if self._leader is None else self._leader.address]
        each_seed = [seeds[i : i + 1].reshape(()) for i in range(seeds.size)]
        return [position, *each_seed, *others, *first, *normals]

    def _first_normals(self) -> list[np.ndarray]:
        """The stored normals; none if ranks divide the particles, as each draws its part."""
        if self._leader is not None:
            return [np.empty(0) for _ in range(self._n_noises)]
        noise = self._make_noise()
        return [np.zeros(int(size)) for size in noise] if self._carries_noise else noise


@dataclass(frozen=True)
class BoundLogDensity:
    """A log-density with the arrays that its machine code reads and writes."""

    native: NativeLogDensity
    others: list[np.ndarray]  # values of the variables that are not in the vector
    correlation: np.ndarray  # (), of an evaluation's noise with that carried; 0 draws fresh noise
    carried: np.ndarray  # (n_carried,), the normals that the chain carries
    # Evaluates again in Python, to raise the error of the machine code, and keeps the memory of the
    # machine code's arguments alive.
    raise_error: Callable[[], None]

    def __call__(
        self, position: np.ndarray, others: Sequence[np.ndarray], seeds: ArrayLike
    ) -> Evaluation:
        """Evaluate once, from Python; an exception of the model is raised.

        Parameters
        ----------
        position : ndarray, shape (d,)
            The raveled variables.
        others : sequence of ndarray
            Values of the other variables.
        seeds : array_like of int64, shape (noisy,)
            The noise seeds; not read if the noise is fixed.
        """
        self.native.position[:] = position
        self.native.seeds[:] = seeds
        for mine, value in zip(self.others, others, strict=True):
            mine[...] = value
        with held_interrupts():
            result = evaluate(self.native)
        if result.failure == RAISED:
            self.raise_error()
        return result


class RowsOnAllRanks:
    """A log-density at many points, one after the other, as ranks evaluate each together."""

    def __init__(self, density: BoundLogDensity) -> None:
        self._density = density
        self.on_progress: Callable[[int], None] = lambda count: None

    def __call__(self, x: np.ndarray, *seeds: np.ndarray) -> np.ndarray:
        """Log-densities of posterior and prior, (m, 2), at positions (m, d)."""
        results = np.empty((len(x), 2))
        for i, position in enumerate(x):
            self._density(position, self._density.others, [column[i] for column in seeds])
            results[i] = self._density.native.call.out[1:3]
            self.on_progress(1)
        return results


def screening_density(model: Model, screen: Any, power: float) -> TensorVariable:
    """Graph of a cheap log-density: `tempered_density` with the screen for all filters.

    Raises
    ------
    ModelError
        If the filter does not support a system.
    """
    try:
        return tempered_density(model, dict.fromkeys(state_space_nodes(model), screen), power)
    except ModelError as error:
        raise ModelError(f"screen={screen!r}: {error}") from error


def tempered_density(model: Model, filters: Mapping[str, Any], power: float) -> TensorVariable:
    """Graph of a model's log-density with other filters, whose likelihoods are tempered.

    ``filters`` are given by the names of StateSpace variables, and the power is the exponent of the
    likelihoods of these variables; other terms, as priors, have exponent 1.
    """
    total = sum(
        pt.sum(term) * (power if name in filters else 1.0)
        for name, term in log_density_terms(model)
    )
    return with_filter([total], model, filters)[0]
