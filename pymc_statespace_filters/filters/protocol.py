"""What a filter is: the contract between filters and everything that uses them.

A filter is an immutable, hashable object that holds settings. It states which systems it supports
and compiles functions for one system, which it is given as a `System`. No base class is needed:
`log_likelihood`, `StateSpace`, `sample_dram` and the evidence take any `Filter`. Its other
abilities are the methods of `RunFilter`, `ResumableFilter`, `StatesFilter`, `BatchFilter`,
`DifferentiableFilter`, `EnsembleFilter` and `ToleranceFilter`.

Arguments and results of the compiled functions are those of `filters.signatures`. Their arrays:
``theta`` (k,) parameters; ``steps`` (J,) int64, the step of each observation; ``observed`` (J, p),
NaN where missing; ``inputs`` (rows, n_inputs), row k holds during step k; ``t0`` the time of step
0. They return ``terms`` (J,), log p(d_j | d_1 .. d_{j-1}), 0 for a row that is wholly missing and
-inf from a failing observation on, and ``health`` (3,): the smallest effective number of particles
behind a term (inf without particles), a failure code of `filters.outcomes`, and the index of the
failing observation or -1.
"""

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..compiler.codegen.function_types import CompiledFunction as CompiledFunction
from ..compiler.native.plan import Plan
from ..compiler.native.planned_function import PlannedFunction
from ..errors import ModelError
from .state_law import StateLaw

if TYPE_CHECKING:
    from ..compiler.lowering.compiled_system import CompiledSystem

type Compiled = CompiledFunction | PlannedFunction
"""A function that numba compiles for one system, or one of a plan, which needs no compilation."""
type System = CompiledSystem
"""One system as a filter sees it: sizes, properties, and functions compiled when asked for."""


@runtime_checkable
class Filter(Protocol):
    """Every filter."""

    @property
    def noisy(self) -> bool:
        """Whether the likelihood is an estimate that depends on a seed."""

    @property
    def has_gradient(self) -> bool:
        """Whether the filter is a `DifferentiableFilter`."""

    def check(self, system: System) -> None:
        """Raise `ModelError` if the filter cannot treat the system."""

    def is_exact_for(self, system: System) -> bool:
        """Whether the likelihood, or the mean of its estimates, is that of the system."""

    def compile(self, system: System) -> Compiled:
        """Compile the log-likelihood."""


@runtime_checkable
class RunFilter(Filter, Protocol):
    """A filter that `run_filter` can show."""

    def compile_run(self, system: System) -> Compiled:
        """Compile one run with all that it computes."""


@runtime_checkable
class ResumableFilter(RunFilter, Protocol):
    """A filter that goes on from a vector, its state after earlier rows."""

    def law_of_state(self, system: System, states: NDArray[np.float64]) -> StateLaw:
        """Return the law of the system's state at m points, from vectors (m, S)."""


@runtime_checkable
class StatesFilter(Filter, Protocol):
    """A filter that gives states at draws: `filtered_states`, `smoothed_states`, `forecast`."""

    def compile_states(self, system: System, moment: str) -> Compiled:
        """Compile "predicted", "filtered" or "smoothed" states."""
        ...

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""


@runtime_checkable
class HealthFilter(Filter, Protocol):
    """A filter that tells how many of its members are behind every term."""

    def compile_health(self, system: System) -> Compiled:
        """Compile the effective number of every term."""


@runtime_checkable
class PredictionFilter(Filter, Protocol):
    """A filter that knows the law of every observation given those before it."""

    def compile_predictions(self, system: System) -> Compiled:
        """Compile the law of every observation, for systems with additive Gaussian noise."""


@runtime_checkable
class DifferentiableFilter(Filter, Protocol):
    """A filter whose likelihood has a gradient.

    A gradient is a forward pass, which leaves a tape, and a backward pass over it. A graph that
    holds the likelihood too shares the forward pass. The tape has a row before each prediction and
    before each update; without rows, the filter has failed. If a row is the mean of the state and
    the lower triangle of its covariance, `filter_diagnostics` reads the predictions from it; for a
    deterministic system the mean is enough. A filter with another tape is a `PredictionFilter`.
    """

    def compile_gradient(self, system: System) -> Compiled:
        """Compile both passes as one function."""

    def compile_taped(self, system: System) -> Compiled:
        """Compile the forward pass: terms, health and the tape."""

    def compile_pullback(self, system: System) -> Compiled:
        """Compile the backward pass: (theta .. seed, tape, terms_bar) -> theta_bar."""


@runtime_checkable
class BatchFilter(DifferentiableFilter, Protocol):
    """A filter that evaluates many parameter points, or the records of a panel, side by side.

    Every point and record has the terms that it has alone, see `filters.signatures`.
    """

    def plan_of_many(
        self, system: System, *, leaves_tape: bool = False, goes_back: bool = False
    ) -> Plan:
        """Plan the forward pass, with a tape or without one, or the pass back along a tape.

        One that leaves a tape and goes back along it is the gradient.
        """


@runtime_checkable
class EnsembleFilter(Filter, Protocol):
    """A filter of members moved by normals, which can be stored, moved a little, or distributed."""

    def size(self) -> int:
        """Return the number of members."""

    def max_ranks(self) -> int:
        """Return how many ranks can have a whole block of members each."""

    def smooth(self, system: System) -> "EnsembleFilter":
        """Return this filter with an estimate that changes little when its normals do."""

    def n_normals(self, system: System, n_steps: Any, n_observations: Any) -> Any:
        """Return how many normals one evaluation uses."""

    def stored_noise(self, system: System) -> PlannedFunction:
        """Compile the making of these normals: (steps, seed) -> one vector."""


@runtime_checkable
class ToleranceFilter(Filter, Protocol):
    """A filter whose error is bounded by a tolerance, and that takes longer the smaller it is."""

    def coarse(self) -> Filter:
        """Return this filter with the largest tolerance that still tells where a posterior lies."""


class Properties(NamedTuple):
    """What a filter is beyond its methods: its attributes of these names, False if it has none.

    It ``resumes_many`` if its `BatchFilter.plan_of_many` goes on at many points; its particles
    move by the rows to come if it ``needs_record_ahead``; and the mean of its estimates is the
    likelihood, for any number of members, if it is ``unbiased``. One that ``finds_path`` compiles
    "most probable" states, too.
    """

    resumes_many: bool
    needs_record_ahead: bool
    unbiased: bool
    finds_path: bool


def properties(filter: Filter) -> Properties:
    """Return what a filter says of itself."""
    return Properties(*(getattr(filter, name, False) for name in Properties._fields))


def check_states_filter(filter: Filter) -> StatesFilter:
    """Return the filter, or raise if it gives no states."""
    if not isinstance(filter, StatesFilter):
        raise ModelError(
            f"{filter!r} gives no states: it has no compile_states; name a filter of the package "
            f"instead (filter=...)"
        )
    return filter


def check_filter(filter: Any) -> None:
    """Raise unless this is a filter."""
    if isinstance(filter, type) or not isinstance(filter, Filter):
        raise ModelError(
            f"filter must be a filter such as psf.EKF() or psf.EnKF(1250), got {filter!r}"
        )


def check_sensor_has_noise(name: str, system: System) -> None:
    """Raise if a sensor has no noise, where the filter ``name`` needs its density."""
    if system.has_exact_sensor:
        raise ModelError(
            f"{name} needs the density of an observation given the state, which a "
            "sensor without noise has not: observation_noise must be positive definite, got a "
            "variance of zero"
        )
