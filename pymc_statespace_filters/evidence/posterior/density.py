"""A model's log-density at many points at once: machine code, in threads.

The log-density is PyTensor's compiled function, called by its address. Each point comes with the
noise seeds of its estimate, so that neither the order nor the number of threads matters.
"""

from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numba import njit
from numpy.typing import NDArray
from pymc.pytensorf import compile as compile_pymc
from pymc.pytensorf import join_nonshared_inputs
from pytensor.tensor.variable import TensorVariable

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.inspection import noise_seeds, smooth_filters, with_filter
from pymc_statespace_filters.machine_code import (
    NativeFunction,
    available_cores,
    digest,
    kept,
    make_call,
)

Array = NDArray[np.float64]

_REFRESH_SECONDS = 0.1
# What the main thread and an evaluating one tell each other.
_N_DONE, _STOP = 0, 1


def _evaluate_rows(call, point, seed, points, seeds, values, told):
    """Evaluate points (m, k) with seeds (m, n_seeds), until told to stop; False if one raised."""
    for i in range(len(points)):
        if told[_STOP]:
            return True
        for j in range(point.size):
            point[j] = points[i, j]
        for j in range(seed.size):
            seed[j] = seeds[i, j]
        if not make_call(call):
            return False
        values[i] = call.out[1]
        told[_N_DONE] = i + 1
    return True


_evaluate_rows = kept(
    njit(_evaluate_rows, error_model="numpy", nogil=True),
    digest("evaluate_rows", Path(__file__).read_text()),
)


class RowFunction:
    """A number that depends on the free variables of a model, compiled over one flat vector.

    Parameters
    ----------
    model : pymc.Model
    output : TensorVariable
        A scalar graph of the model's value variables; the noise seeds become arguments.

    Attributes
    ----------
    seed_names : tuple of str
        The noisy state-space variables, in the order of the columns of a seed array.
    model_seeds : ndarray of int64
        The seeds that the model holds for them.
    watch : callable
        Told, in the main thread, how many points were evaluated since it was last told.
    """

    def __init__(self, model: pm.Model, output: TensorVariable) -> None:
        shared = noise_seeds(model)
        self.seed_names = tuple(shared)
        self.model_seeds = np.array([seed.get_value() for seed in shared.values()], dtype=np.int64)
        self.watch: Callable[[int], None] = lambda count: None
        values = [model.rvs_to_values[rv] for rv in model.free_RVs]
        seeds = {seed: pt.lscalar(f"{name}_seed") for name, seed in shared.items()}
        start = model.initial_point()
        (output,), joined = join_nonshared_inputs(start, [output], values, seeds)
        inputs = [joined, *seeds.values()]
        function = compile_pymc(inputs, [output], on_unused_input="ignore")
        function.trust_input = True
        self._start = np.concatenate([np.ravel(start[v.name]) for v in values], dtype=np.float64)
        self._native = NativeFunction(function, self._inputs(self._start, self.model_seeds))

    @staticmethod
    def _inputs(point: Array, seed: NDArray[np.int64]) -> list[np.ndarray]:
        """Arguments of the compiled function; the seeds are views."""
        return [point, *(seed[i : i + 1].reshape(()) for i in range(seed.size))]

    def evaluate(self, x: Array, seeds: NDArray[np.int64] | None = None) -> Array:
        """Evaluate points x (m, k), each with its row of seeds (m, n_seeds); NaN becomes -inf.

        Without seeds every point has the model's own.
        """
        points = np.ascontiguousarray(x, dtype=np.float64)
        if seeds is None:
            seeds = np.broadcast_to(self.model_seeds, (len(points), self.model_seeds.size))
        seeds = np.ascontiguousarray(seeds, dtype=np.int64)
        values = np.full(len(points), -np.inf)
        n_threads = min(available_cores(), max(1, len(points)))
        ends = np.linspace(0, len(points), n_threads + 1).astype(int)
        told = np.zeros((n_threads, 2), dtype=np.int64)
        parts = [slice(*ends[i : i + 2]) for i in range(n_threads)]
        with ThreadPoolExecutor(n_threads) as pool:
            futures = [
                pool.submit(self._evaluate_part, points[part], seeds[part], values[part], told[i])
                for i, part in enumerate(parts)
            ]
            try:
                self._wait(futures, told)
            finally:
                told[:, _STOP] = True
        return np.where(np.isnan(values), -np.inf, values)

    def _evaluate_part(
        self, points: Array, seeds: NDArray[np.int64], values: Array, told: NDArray[np.int64]
    ) -> None:
        point, seed = self._start.copy(), self.model_seeds.copy()
        inputs = self._inputs(point, seed)
        call, kept_alive = self._native.bind(inputs)
        if not _evaluate_rows(call, point, seed, points, seeds, values, told):
            self._native(*inputs)  # raises what the machine code met
        del kept_alive

    def _wait(self, futures: list[Any], told: NDArray[np.int64]) -> None:
        n_told, pending = 0, set(futures)
        while pending:
            done, pending = wait(pending, _REFRESH_SECONDS, return_when=FIRST_EXCEPTION)
            for future in done:
                future.result()
            n_done = int(told[:, _N_DONE].sum())
            self.watch(n_done - n_told)
            n_told = n_done


class ModelDensity(RowFunction):
    """The compiled log-density of a model.

    Parameters
    ----------
    model : pymc.Model
    moved : bool
        Whether the draws' noise was moved along the chain, by the smooth versions of the filters.
    """

    def __init__(self, model: pm.Model, *, moved: bool = False) -> None:
        if model.discrete_value_vars:
            names = [model.values_to_rvs[value].name for value in model.discrete_value_vars]
            raise ModelError(
                f"model must have continuous free variables only; {names} are discrete: "
                "sum them out of the likelihood first"
            )
        if not model.free_RVs:
            raise ModelError("model must have at least one free variable, it has none")
        self.model = model
        self.moved = moved
        log_density = model.logp()
        if moved:
            (log_density,) = with_filter([log_density], model, smooth_filters(model))
        super().__init__(model, log_density)
