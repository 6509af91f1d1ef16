"""What a filter is: the contract between filters and everything that uses them.

A filter is an immutable, hashable object that holds settings. It states which systems it supports
and plans functions for one system, which it is given as a `System`. A filter of a user's own is
three functions and a subclass of `ensemble.parts.PartsFilter`. What only some filters can are the
methods of `DifferentiableFilter`, `EnsembleFilter`, `PredictionFilter` and `ToleranceFilter`.

Arguments and results of the functions are those of `ops.signatures`. Their arrays:
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

from ..compiler.native.plan import Plan
from ..errors import ModelError
from .state_law import StateLaw

if TYPE_CHECKING:
    from ..compiler.lowering.compiled_system import CompiledSystem

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

    def plan_of_likelihood(self, system: System) -> Plan:
        """Plan the log-likelihood."""

    def plan_of_run(self, system: System) -> Plan:
        """Plan one run with all that it computes."""

    def plan_of_states(self, system: System, moment: str) -> Plan:
        """Plan "predicted", "filtered" or "smoothed" states."""
        ...

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""

    def law_of_state(self, system: System, states: NDArray[np.float64]) -> StateLaw:
        """Return the law of the system's state at m points, from vectors (m, S) that it left."""


@runtime_checkable
class PredictionFilter(Filter, Protocol):
    """A filter that knows the law of every observation given those before it."""

    def plan_of_predictions(self, system: System) -> Plan:
        """Plan the law of every observation, for systems with additive Gaussian noise."""


@runtime_checkable
class DifferentiableFilter(Filter, Protocol):
    """A filter whose likelihood has a gradient, and that takes many records or points in one pass.

    Every record and point has the terms that it has alone, see `ops.signatures`.

    A gradient is a forward pass, which leaves a tape, and a backward pass over it. A graph that
    holds the likelihood too shares the forward pass. The tape has a row before each prediction and
    before each update; without rows, the filter has failed. If a row is the mean of the state and
    the lower triangle of its covariance, `filter_diagnostics` reads the predictions from it; for a
    deterministic system the mean is enough. A filter with another tape is a `PredictionFilter`.
    """

    def plan_of_pass(
        self,
        system: System,
        *,
        of_many: bool = False,
        leaves_tape: bool = False,
        goes_back: bool = False,
    ) -> Plan:
        """Plan the forward pass, with a tape or without one, or the pass back along a tape.

        One that leaves a tape and goes back along it is the gradient.
        """


@runtime_checkable
class EnsembleFilter(Filter, Protocol):
    """Every noisy filter: its members are moved by normals, which can be stored and distributed."""

    def size(self) -> int:
        """Return the number of members."""

    def max_ranks(self) -> int:
        """Return how many ranks can have a whole block of members each."""

    def smooth(self, system: System) -> "EnsembleFilter":
        """Return this filter with an estimate that changes little when its normals do."""

    def n_normals(self, system: System, n_steps: Any, n_observations: Any) -> Any:
        """Return how many normals one evaluation uses."""

    def plan_of_noise(self, system: System) -> Plan:
        """Plan the making of these normals: (steps, seed) -> one vector."""


@runtime_checkable
class ToleranceFilter(Filter, Protocol):
    """A filter whose error is bounded by a tolerance, and that takes longer the smaller it is."""

    def coarse(self) -> Filter:
        """Return this filter with the largest tolerance that still tells where a posterior lies."""


class Properties(NamedTuple):
    """What a filter is beyond its methods: its attributes of these names, False if it has none.

    It ``resumes_many`` if its passes of many points go on from states; its particles move by the
    rows to come if it ``needs_record_ahead``; and the mean of its estimates is the likelihood, for
    any number of members, if it is ``unbiased``. One that ``finds_path`` plans "most probable"
    states, too.
    """

    resumes_many: bool
    needs_record_ahead: bool
    unbiased: bool
    finds_path: bool


def properties(filter: Filter) -> Properties:
    """Return what a filter says of itself."""
    return Properties(*(getattr(filter, name, False) for name in Properties._fields))


def check_filter(filter: Any) -> None:
    """Raise unless this is a filter."""
    is_filter = isinstance(filter, Filter) and not isinstance(filter, type)
    if not is_filter or (filter.noisy and not isinstance(filter, EnsembleFilter)):
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
