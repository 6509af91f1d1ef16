"""A PyMC model's log-density by record of its panel, as two calls of machine code.

One call estimates the likelihoods of all records. The other gives the terms without a likelihood,
which takes microseconds: the moves of the population evaluate it alone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pytensor.tensor as pt
from pymc.model import Model
from pytensor.tensor.variable import TensorVariable

from ...compiler.native.pytensor_function import NativeFunction
from ...parallel.signals import held_interrupts
from ...pymc_model.compilation import compile_raveled
from ...pymc_model.inspection import health_outputs
from ...pymc_model.panel_structure import PanelStructure
from ...pymc_model.written_function import native_function
from ..kernel.records.arrays import (
    NativeRecordDensities,
    RecordEvaluation,
    evaluate_likelihoods,
    evaluate_priors,
)
from ..kernel.state import RAISED


class RecordDensities:
    """Compiled log-density of a model, by record, with its noise as an argument.

    Parameters
    ----------
    model : pymc.Model
    structure : PanelStructure
    variables : sequence of TensorVariable
        All value variables, in the order of the vector into which they are raveled.
    point : mapping of str to ndarray
        Any point of the model.
    seeds : mapping of str to shared variable
        The noise seeds, by the name of their StateSpace variable.
    """

    def __init__(
        self,
        model: Model,
        structure: PanelStructure,
        variables: Sequence[TensorVariable],
        point: Mapping[str, np.ndarray],
        seeds: Mapping[str, TensorVariable],
    ):
        other = structure.other_likelihood
        likelihoods = [structure.likelihood, pt.zeros(()) if other is None else other]
        healths = health_outputs(likelihoods)
        self._n_healths, self._n_terms = len(healths), structure.n_records + 1
        self._likelihood, self._start = compile_raveled(
            point, [*likelihoods, *healths], variables, seeds
        )
        self._prior, _ = compile_raveled(point, [structure.prior, structure.rest], variables)
        self._n_seeds = len(seeds)
        self._native: tuple[NativeFunction, NativeFunction] | None = None

    def __getstate__(self) -> dict:
        """Leave out the machine code, which another process loads itself."""
        return self.__dict__ | {"_native": None}

    def prepare(self) -> tuple[NativeFunction, NativeFunction]:
        """Load the machine code, and read the data as they are now."""
        inputs = _inputs(self._start, np.zeros(self._n_seeds, dtype=np.int64))
        self._native = (
            native_function(self._likelihood, inputs),
            native_function(self._prior, inputs[:1]),
        )
        return self._native

    def bind(self) -> "BoundRecordDensities":
        """Make the log-density callable from one thread, with separate arrays."""
        likelihood, prior = self._native or self.prepare()
        position = self._start.copy()
        seeds = np.zeros(self._n_seeds, dtype=np.int64)
        inputs = _inputs(position, seeds)
        likelihood_call, repeat_likelihood = likelihood.bind(inputs)
        prior_call, repeat_prior = prior.bind(inputs[:1])

        def raise_error() -> None:
            repeat_likelihood()
            repeat_prior()

        native = NativeRecordDensities(
            likelihood_call, prior_call, position, seeds, self._n_healths
        )
        return BoundRecordDensities(native, self._n_terms, raise_error)


@dataclass(frozen=True)
class BoundRecordDensities:
    """A log-density by record, with the arrays that its machine code reads and writes."""

    native: NativeRecordDensities
    n_terms: int  # one for each record, and one more
    # Evaluates again in Python, to raise the error of the machine code, and keeps its memory alive.
    raise_error: Callable[[], None]

    def estimate(
        self, position: np.ndarray, seeds: np.ndarray
    ) -> tuple[np.ndarray, RecordEvaluation]:
        """Estimate the log-likelihoods (G + 1,) at a position; an exception is raised."""
        self.native.position[:] = position
        self.native.seeds[:] = seeds
        estimates = np.empty(self.n_terms)
        with held_interrupts():
            found = evaluate_likelihoods(self.native, estimates)
        if found.failure == RAISED:
            self.raise_error()
        return estimates, found

    def priors(self, position: np.ndarray) -> np.ndarray:
        """All other terms (G + 1,) at a position; an exception is raised."""
        self.native.position[:] = position
        priors = np.empty(self.n_terms)
        with held_interrupts():
            found = evaluate_priors(self.native, priors)
        if not found:
            self.raise_error()
        return priors


def _inputs(position: np.ndarray, seeds: np.ndarray) -> list[np.ndarray]:
    """Arguments of the compiled functions; each seed is a view of the vector."""
    return [position, *(seeds[i : i + 1].reshape(()) for i in range(seeds.size))]
