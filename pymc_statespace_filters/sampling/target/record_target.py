"""A model with a panel as the sampler sees it, if it moves every record by itself.

The log-density takes two calls of machine code. One estimates the likelihoods of all records. The
other gives the terms without a likelihood, which takes microseconds: the moves of the population
evaluate it alone. Both take positions in the coordinates of the structure, in which some own
parameters are centred.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytensor.tensor as pt
from pymc.model import Model
from pytensor.tensor.variable import TensorVariable

from ...compiler.native.pytensor_function import NativeFunction
from ...errors import ModelError
from ...filters.outcomes import RAISED
from ...parallel.communicator import Communicator
from ...parallel.signals import held_interrupts
from ...pymc_model.density import compile_raveled
from ...pymc_model.inspection import health_outputs, panel_variables
from ...pymc_model.panel_structure import PanelStructure, panel_structure
from ...pymc_model.written_function import native_function
from ..kernel.record_arrays import (
    NativeRecordDensities,
    RecordEvaluation,
    RecordLayout,
    RecordRandomBlock,
    centre,
    evaluate_likelihoods,
    evaluate_priors,
    record_random_block,
)
from ..kernel.state import ChainState
from .initial_points import variances_of
from .sampled_model import Growth, SampledModel
from .settings import RandomWalkSettings, checked_proposal_cov
from .target import Target


class RecordDensities:
    """Compiled log-density of a model, by record, with its noise as an argument.

    All value ``variables`` of the model are in the order of the vector into which they are raveled;
    the other arguments are as of `LogDensity`.
    """

    def __init__(
        self,
        model: Model,
        structure: PanelStructure,
        variables: Sequence[TensorVariable],
        point: Mapping[str, np.ndarray],
        seeds: Mapping[str, TensorVariable],
    ):
        centrings = {one.value: one for one in structure.centrings}
        variables = [centrings[v].centred if v in centrings else v for v in variables]
        both = [*structure.centrings, *structure.centred]
        locations, scales = [one.location for one in both], [one.scale for one in both]
        other = structure.other_likelihood
        likelihoods = [structure.likelihood, pt.zeros(()) if other is None else other]
        healths = health_outputs(likelihoods)
        self._n_healths, self._n_terms = len(healths), structure.n_records + 1
        self._likelihood, self._start = compile_raveled(
            point, [*likelihoods, *healths], variables, seeds
        )
        self._prior, _ = compile_raveled(
            point, [structure.prior, structure.rest, *locations, *scales], variables
        )
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

    def centred(self, position: np.ndarray, layout: RecordLayout) -> np.ndarray:
        """A position of the model in the coordinates of these densities; an exception is raised."""
        self.native.position[:] = position
        with held_interrupts():
            log_jacobian = centre(self.native, layout, layout.n_standard)
        if np.isnan(log_jacobian):
            self.raise_error()
        return self.native.position.copy()


def _inputs(position: np.ndarray, seeds: np.ndarray) -> list[np.ndarray]:
    """Arguments of the compiled functions; each seed is a view of the vector."""
    return [position, *(seeds[i : i + 1].reshape(()) for i in range(seeds.size))]


class RecordTarget(SampledModel):
    """A model whose records, of these ``labels``, are moved one by one.

    Of the covariance ``proposal_cov`` (d, d) of the first proposals each block takes its own part.
    If it is one of proposals of all parameters together (``of_all``), as of a pilot, it has the
    factor 2.38^2 / d of their number, and each block that of its own. Raises `ModelError` as
    `SampledModel`, and if ``proposal_cov`` or a setting does not fit.
    """

    def __init__(
        self,
        model: Model,
        settings: RandomWalkSettings,
        structure: PanelStructure,
        proposal_cov: np.ndarray | None = None,
        *,
        of_all: bool = False,
    ):
        _check_settings(settings, structure.name)
        super().__init__(model, None, settings)
        if self._seeds:  # the noise of all estimates would reject nearly every interwoven move
            structure = structure._replace(centred=())
        self.structure = structure
        self.labels = tuple(model.coords[f"{structure.name}_record"])
        self.layout = self._layout(model)
        self._proposal_cov = None
        if proposal_cov is not None:
            self._proposal_cov = checked_proposal_cov(proposal_cov, self.raveled.dim)
            if of_all:
                self._proposal_cov *= self.raveled.dim / self._block_sizes()
        self.densities = RecordDensities(
            model, structure, self.raveled.variables, self._default, self._seeds
        )

    def _layout(self, model: Model) -> RecordLayout:
        structure, panels = self.structure, panel_variables(model)
        n_records = structure.n_records
        index = self.raveled.unravel(np.arange(self.raveled.dim))
        places = {name: values.astype(np.int64) for name, values in index.items()}
        columns: list[int] = []
        of_records = []
        for column, name in enumerate(self._seeds):
            n_seeds = n_records if name in panels else 1
            if name in panels:
                of_records.append(len(columns) + np.arange(n_records))
            columns += [column] * n_seeds
        seeds = np.array(of_records, dtype=np.int64).reshape(-1, n_records).T
        standard = _joined([places[one.value.name] for one in structure.centrings])
        return RecordLayout(
            np.concatenate([places[v.name].reshape(n_records, -1) for v in structure.own], axis=1),
            _joined([places[v.name] for v in structure.shared]),
            _joined([places[v.name] for v in structure.population]),
            np.concatenate([standard, _joined([places[v.value.name] for v in structure.centred])]),
            len(standard),
            _joined([places[v.name] for v in structure.interwoven]),
            np.ascontiguousarray(seeds),
            np.array(columns, dtype=np.int64),
        )

    @property
    def n_noisy(self) -> int:
        """Seeds of an evaluation, one for each noisy variable."""
        return len(self._seeds)

    def evaluation(self) -> Callable[[], object]:
        """A function that evaluates all records once, to measure what they cost."""
        bound = self.densities.bind()
        start = bound.centred(bound.native.position.copy(), self.layout)
        seeds = bound.native.seeds.copy()
        return lambda: bound.estimate(start, seeds)

    def variable_name(self, value: TensorVariable) -> str:
        """The name of the free variable of a value."""
        return self.model.values_to_rvs[value].name

    def prepare(self) -> None:
        """Load the machine code, and read data and fixed seeds as they are now."""
        self._read_seeds()
        self.densities.prepare()

    def growth(self, state: ChainState) -> Growth:
        """Compare a chain's proposals with draws from the prior."""
        variances = self.layout.proposal_variances(state.adaptation)
        return self._growth(variances, self._first_variances)

    @cached_property
    def first_adaptation(self) -> np.ndarray:
        """Packed states of the adaptation of all blocks."""
        first = self._first_variances if self._proposal_cov is None else self._proposal_cov
        return self.layout.first_adaptation(first)

    def random_block(self, key: np.ndarray, index: int) -> RecordRandomBlock:
        """Draw a block of random numbers for a chain with this key."""
        block = record_random_block(key, index, self.layout, self.n_noisy)
        if not self.settings.refresh_noise:
            block.seeds[...] = self.fixed_seeds
        return block

    @cached_property
    def _first_variances(self) -> np.ndarray:
        """Variances of the prior's draws times 2.38^2 over the dimension of the block."""
        bound = self.densities.bind()
        draws = self.prior_draws.draws.copy()
        for draw in draws:
            draw[:] = bound.centred(draw, self.layout)
        return variances_of(draws) * 2.38**2 / self._block_sizes()

    def _block_sizes(self) -> np.ndarray:
        """The number of parameters in the block of each, (d,)."""
        sizes = np.empty(self.raveled.dim)
        for block in self.layout.blocks():
            sizes[block] = len(block)
        return sizes


def target_of(
    model: Model,
    settings: RandomWalkSettings,
    proposal_cov: np.ndarray | None,
    group: Communicator | None,
    *,
    has_pilot: bool,
    centres: bool,
) -> Target | RecordTarget:
    """The target of a panel whose records have parameters of their own, or of any other model.

    Arguments as of `Target` and `panel_structure`; ``has_pilot`` is whether the covariance comes
    from a pilot.
    """
    structure = panel_structure(model, centres=centres)
    if structure is None:
        return Target(model, None, settings, proposal_cov, group=group)
    if group is not None and group.size > 1:
        raise ModelError(
            f"per_chain of comm must be 1 for the panel {structure.name!r}, got "
            f"{group.size}: every rank evaluates all records of its chains"
        )
    return RecordTarget(model, settings, structure, proposal_cov, of_all=has_pilot)


def _joined(places: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.empty(0, dtype=np.int64), *map(np.ravel, places)])


def _check_settings(settings: RandomWalkSettings, name: str) -> None:
    """Raise if a setting asks for what the moves of single records do not have."""
    asked = {"screen": settings.screen, "correlation": settings.correlation}
    for setting, value in asked.items():
        if value is not None:
            raise ModelError(
                f"{setting} must be None for the panel {name!r}, whose records are moved one by "
                f"one, got {value!r}; pm.sample(step=psf.DRAM()) moves all parameters together"
            )
    if settings.stages not in ((2, 1), (1, 1)):
        raise ModelError(
            f"stages must be 1 for the panel {name!r}, whose records make one proposal at a time, "
            f"got {settings.stages}; pm.sample(step=psf.DRAM()) moves all parameters together"
        )
