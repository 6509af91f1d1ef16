"""A PyMC model's log-density as one call of machine code.

The value variables that a sampler moves are raveled into one vector; the other variables and the
noise of estimated likelihoods are further arguments. The same call returns the health of the
filters, so that the reason of a failure costs no second evaluation.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytensor.tensor as pt
from numpy.typing import ArrayLike
from pymc.model import Model
from pytensor.graph.basic import Variable
from pytensor.tensor.variable import TensorVariable

from ...compiler.native.pytensor_function import NativeFunction
from ...compiler.native.rows import Rows
from ...errors import ModelError
from ...filters.outcomes import NOT_A_NUMBER, RAISED, Failure
from ...parallel.communicator import Communicator
from ...parallel.signals import held_interrupts
from ...pymc_model.density import compile_density, compile_raveled
from ...pymc_model.graph_rewrites import autoregressive_noise, with_filter, with_likelihood_callback
from ...pymc_model.inspection import (
    health_outputs,
    log_density_graph,
    log_density_terms,
    state_space_nodes,
)
from ...pymc_model.written_function import native_function
from ..kernel.state import Evaluation, NativeLogDensity
from ..kernel.transition import evaluate
from .leader_follower import Leader, leader_errors


class LogDensity:
    """Compiled log-density of a model on its unconstrained space, with its noise as an argument.

    The continuous value ``variables`` are raveled into one vector, in this order; the others are
    further arguments, in the order of their names, ``others``. Any ``point`` of the model has the
    first values of all arguments, and ``seeds`` are the noise seeds, by the name of their
    StateSpace variable.

    With ``fixed_noise`` every evaluation uses the noise of the model's seeds. Their normals are
    then drawn once, in `prepare`, and the seeds of a call are not read. With a ``correlation`` the
    normals of an evaluation are so many times those carried by the chain plus fresh ones, of the
    same variance. ``graph`` is the log-density if it is not the model's own, see
    `screening_density`. The ranks of a ``group`` evaluate the noisy likelihoods together: this one,
    the first, evaluates the log-density; the others call `leader_follower.follow`. The gradient, if
    wanted, is the last result of `at_rows`. Raises `GradientUnavailableError` if the gradient is
    asked for and a filter has none.
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
        with_gradient: bool = False,
    ):
        others = [v for v in model.value_vars if v not in variables]
        self.others = tuple(v.name for v in others)
        density = log_density_graph(model) if graph is None else graph
        outputs = [density, log_density_graph(model, model.free_RVs), *health_outputs([density])]
        self._n_healths = len(outputs) - 2
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
        further = [*others, *noise_inputs]
        self._function, self._start = compile_raveled(
            point,
            outputs,
            variables,
            seeds,
            further,
            with_gradient=with_gradient,
            **(compile_kwargs or {}),
        )
        self._n_seeds = len(seeds)
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
        noise = [np.zeros(())] if self._carries_noise else []
        errors: Any = nullcontext
        if self._has_callback:
            noise = [np.zeros((), np.int64) if self._leader is None else self._leader.address]
        if self._leader is not None:
            errors = partial(leader_errors, self._leader)
        self._normals = self._first_normals()
        seeds = [np.zeros((), np.int64)] * self._n_seeds
        inputs = [self._start, *seeds, *self._others, *noise, *self._normals]
        self._native = native_function(self._function, inputs, errors)
        return self._native

    def at_rows(self) -> Rows:
        """A function of positions (m, d) and m seeds of each noisy variable.

        The first of its results are the log-density and that of the prior.
        """
        native, n_varying = self._native or self.prepare(), 1 + self._n_seeds
        return Rows(native, n_varying, in_turn=self._leader is not None)

    def failures(self, results: Sequence[np.ndarray]) -> Counter[Failure]:
        """How many of the results of `at_rows` are of failed evaluations, for each reason."""
        log_density, healths = results[0], results[2 : 2 + self._n_healths]
        codes = np.where(log_density < np.inf, 0, NOT_A_NUMBER)
        for health in healths[::-1]:  # the first filter that failed is the reason
            codes = np.where(health[:, 1] != 0.0, health[:, 1], codes)
        return Counter(Failure.of(code) for code in codes[codes != 0])

    def bind(self) -> "BoundLogDensity":
        """Make the log-density callable from one thread, with separate arrays."""
        native = self._native or self.prepare()
        position, others = self._start.copy(), [value.copy() for value in self._others]
        seeds = np.zeros(self._n_seeds, dtype=np.int64)
        each_seed = [seeds[i : i + 1].reshape(()) for i in range(seeds.size)]
        correlation, carried = np.zeros(()), np.zeros(self.n_carried)
        noise = native.example[1 + len(seeds) + len(others) :]  # not copied: there may be millions
        if self._carries_noise:
            ends = np.cumsum([values.size for values in self._normals])
            noise = [correlation, *np.split(carried, ends[:-1])]
        call, raise_error = native.bind([position, *each_seed, *others, *noise])
        arguments = NativeLogDensity(call, position, seeds, self._n_healths)
        return BoundLogDensity(arguments, others, correlation, carried, raise_error)

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
    # Evaluates again in Python, to raise the error of the machine code, and keeps its memory alive.
    raise_error: Callable[[], object]

    def __call__(
        self, position: np.ndarray, others: Sequence[np.ndarray], seeds: ArrayLike
    ) -> Evaluation:
        """Evaluate once, from Python, at a position (d,); an exception of the model is raised."""
        self.native.position[:] = position
        self.native.seeds[:] = seeds
        for mine, value in zip(self.others, others, strict=True):
            mine[...] = value
        with held_interrupts():
            result = evaluate(self.native)
        if result.failure == RAISED:
            self.raise_error()
        return result


def screening_density(model: Model, screen: Any, power: float) -> TensorVariable:
    """Graph of a cheap log-density: `tempered_density` with the screen for all filters.

    Raises `ModelError` if the filter does not support a system.
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
