"""What a filter is: the contract between filters and everything that uses them.

A filter is an immutable, hashable object that holds settings. It states which systems it supports
and compiles functions for one system, which it is given as a `System`. No base class is needed:
`log_likelihood`, `StateSpace`, `sample_dram` and the evidence take any `Filter`. Its other
abilities are the methods of `RunFilter`, `StatesFilter`, `BatchFilter`, `DifferentiableFilter` and
`EnsembleFilter`.

Arrays of the compiled functions: ``theta`` (k,) parameters; ``steps`` (J,) int64, the step of each
observation; ``observed`` (J, p), NaN where missing; ``inputs`` (rows, n_inputs), row k holds during
step k; ``t0`` the time of step 0. They return ``terms`` (J,), log p(d_j | d_1 .. d_{j-1}), 0 for a
row that is wholly missing and -inf from a failing observation on, and ``health`` (3,): the smallest
effective number of particles behind a term (inf without particles), a failure code of
`filters.outcomes`, and the index of the failing observation or -1.
"""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..compiler.codegen.function_types import CompiledFunction, MemberFunction, ParameterFunction
from ..compiler.native.planned_function import PlannedFunction
from ..errors import ModelError

type Array = NDArray[np.float64]
type Integers = NDArray[np.int64]
type Compiled[F] = CompiledFunction[F] | PlannedFunction
"""A function that numba compiles for one system, or one of a plan, which needs no compilation."""


class System(Protocol):
    """One system as a filter sees it: `compiler.lowering.compiled_system.CompiledSystem`.

    Each function is compiled when first asked for, and its ``function`` is called with arrays.
    Members of an ensemble, or other points, are the N columns of ``X`` (n, N). ``c`` are the
    constants of an evaluation, ``k`` the step and ``t`` its time, ``Z`` standard normals with a
    column for each member (more are allowed), ``D`` (p, N) observations, ``M`` (2, N) a mean and a
    variance for each column. Arrays are contiguous, in C order.

    ``m`` counts the normals of one step, which may be fewer than ``model.m``: noises with constant
    gains are merged. ``n_start`` counts those of a start. ``free`` are the states that an update
    may move.
    """

    model: Any
    n: int
    n_start: int
    m: int
    p: int
    r: int
    n_inputs: int  # columns of `inputs`, with that of resets if the system has accumulators
    n_theta: int
    n_constants: int
    dt: float
    free: Integers
    states: tuple[str, ...]
    carried: tuple[str, ...]
    gaussian_observation: bool
    additive_noise: bool
    observation_uses_inputs: bool

    def __hash__(self) -> int: ...

    @property
    def extend(self) -> Any:
        """Entry point from the user's parameters to the ``n_theta`` that ``model`` reads, or None.

        Those behind the user's are linear algebra of parameters alone, done once per evaluation.
        """

    @property
    def extend_back(self) -> Any:
        """Entry point of its pullback."""

    @property
    def prepare(self) -> ParameterFunction:
        """Function (theta) -> c, the constants of one evaluation."""

    @property
    def initialise(self) -> MemberFunction:
        """Function (c, Z, X) that draws the state at step 0."""

    @property
    def propagate(self) -> MemberFunction:
        """Function (c, inputs, k, t, Z, X) that moves every member one step, in place."""

    @property
    def observe(self) -> MemberFunction:
        """Function (c, inputs, k, t, Z, X, D) that simulates observations."""

    @property
    def log_density(self) -> MemberFunction:
        """Function (c, inputs, k, t, d, X, out) that writes log p(d | x)."""

    @property
    def step_moments(self) -> MemberFunction:
        """Function (c, inputs, k, t, X, M): mean and variance of the next state, one state."""

    @property
    def is_deterministic(self) -> bool:
        """Whether the state is known to be a function of the parameters alone."""

    @property
    def with_gaussian_steps(self) -> "System":
        """The system with normal variables in place of others in ``process_dist``."""

    @property
    def gaussian(self) -> "System":
        """The same with a Gaussian start; the system itself where all noise is Gaussian."""

    @property
    def is_linear(self) -> bool:
        """Whether the system is known to be linear."""

    @property
    def has_additive_process_noise(self) -> bool:
        """Whether the transition is known to be g(x, 0) + G(x) q."""

    @property
    def has_smooth_transition(self) -> bool:
        """Whether the transition is known to have no kink and no jump."""

    @property
    def jumping_equations(self) -> tuple[str, ...]:
        """Those of "transition" and "observation" that are known to jump in the state."""

    @property
    def is_time_invariant(self) -> bool:
        """Whether `step_moments` is known to depend on neither inputs nor time."""

    @property
    def has_transition_density(self) -> bool:
        """Whether one step is known to have a Gaussian density given the state before."""

    @property
    def has_smooth_sensor(self) -> bool:
        """Whether no observable has a kink as a function of the state."""

    @property
    def has_exact_observation_density(self) -> bool:
        """Whether `log_density` is exact, not a linearization."""


class LogLikelihoodFunction(Protocol):
    """Terms and health of one evaluation.

    ``noise`` is a seed and a vector of stored normals, of which a deterministic filter reads
    neither; where the vector is empty the seed counts.
    """

    def __call__(
        self, theta: Array, steps: Integers, observed: Array, inputs: Array, t0: float,
        noise: tuple[int, Array],
    ) -> tuple[Array, Array]:  # fmt: skip
        """Evaluate."""


class HealthFunction(Protocol):
    """Terms and health of one evaluation, and between them the effective number of each term.

    A term is the log of a mean over members, and the number (J,) that of the weights of this mean;
    NaN where there is no term.
    """

    def __call__(
        self, theta: Array, steps: Integers, observed: Array, inputs: Array, t0: float, seed: int
    ) -> tuple[Array, Array, Array]:
        """Evaluate."""


class PredictionsFunction(Protocol):
    """The law of every observation given those before it.

    Mean (J, p), covariance (J, p, p), and the logs (J, p) of the probabilities that a component is
    below and above what was observed. NaN for a missing component, and from a failure on.
    """

    def __call__(
        self, theta: Array, steps: Integers, observed: Array, inputs: Array, t0: float, seed: int
    ) -> tuple[Array, Array, Array, Array]:
        """Evaluate."""


class StatesFunction(Protocol):
    """Mean, sd and a draw (R, n) of the state at ``rows``; n_effective (R,); and health.

    The draws of one ``draw_seed`` belong together. From a failing observation on all are NaN.
    """

    def __call__(
        self, theta: Array, steps: Integers, observed: Array, inputs: Array, t0: float, seed: int,
        rows: Integers, draw_seed: int,
    ) -> tuple[Array, Array, Array, Array, Array]:  # fmt: skip
        """Evaluate."""


class RunFunction(Protocol):
    """Terms, health, and the filtered state at the steps ``rows``.

    The state is mean (R, n), covariance (R, n, n), members (R, N, n) and weights (R, N), given the
    observations up to each row; N is 0 for a filter without members.
    """

    def __call__(
        self, theta: Array, steps: Integers, observed: Array, inputs: Array, t0: float, seed: int,
        rows: Integers,
    ) -> tuple[Array, Array, Array, Array, Array, Array]:  # fmt: skip
        """Evaluate."""


class GradientFunction(Protocol):
    """Vector-Jacobian product: the cotangent of theta (k,) from that of the terms (J,)."""

    def __call__(
        self, theta: Array, steps: Integers, observed: Array, inputs: Array, t0: float, seed: int,
        terms_bar: Array,
    ) -> Array:  # fmt: skip
        """Evaluate."""


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

    def compile(self, system: System) -> Compiled[LogLikelihoodFunction]:
        """Compile the log-likelihood."""


@runtime_checkable
class RunFilter(Filter, Protocol):
    """A filter that `run_filter` can show.

    With an attribute ``resumes`` that is true, it is planned and can go on from its state after
    earlier rows, see `plan.RequestSlots`.
    """

    def compile_run(self, system: System) -> Compiled[RunFunction]:
        """Compile one run with all that it computes."""


@runtime_checkable
class StatesFilter(Filter, Protocol):
    """A filter that gives states at draws: `filtered_states`, `smoothed_states`, `forecast`."""

    def compile_states(self, system: System, moment: str) -> Compiled[StatesFunction]:
        """Compile "predicted", "filtered" or "smoothed" states."""
        ...

    def smoothing_method(self, system: System) -> str:
        """Name the method of the smoothed states."""


@runtime_checkable
class HealthFilter(Filter, Protocol):
    """A filter that tells how many of its members are behind every term."""

    def compile_health(self, system: System) -> Compiled[HealthFunction]:
        """Compile the effective number of every term."""


@runtime_checkable
class PredictionFilter(Filter, Protocol):
    """A filter that knows the law of every observation given those before it."""

    def compile_predictions(self, system: System) -> Compiled[PredictionsFunction]:
        """Compile the law of every observation, for systems with additive Gaussian noise."""


@runtime_checkable
class BatchFilter(Filter, Protocol):
    """A filter that evaluates many parameter points side by side."""

    def compile_batch(self, system: System) -> PlannedFunction:
        """Compile the log-likelihood of theta (B, k): terms (B, J), health (B, 3)."""


@runtime_checkable
class DifferentiableFilter(Filter, Protocol):
    """A filter whose likelihood has a gradient.

    A gradient is a forward pass, which leaves a tape, and a backward pass over it. A graph that
    holds the likelihood too shares the forward pass. The tape has a row before each prediction and
    before each update; without rows, the filter has failed. If a row is the mean of the state and
    the lower triangle of its covariance, `filter_diagnostics` reads the predictions from it; for a
    deterministic system the mean is enough.
    """

    def compile_gradient(self, system: System) -> Compiled[GradientFunction]:
        """Compile both passes as one function."""

    def compile_taped(self, system: System) -> Compiled:
        """Compile the forward pass: terms, health and the tape."""

    def compile_pullback(self, system: System) -> Compiled:
        """Compile the backward pass: (theta .. seed, tape, terms_bar) -> theta_bar."""


@runtime_checkable
class PanelFilter(DifferentiableFilter, Protocol):
    """A filter that evaluates the records of a panel side by side.

    ``theta`` (G, k) has a row for each record, and ``rows`` (J, 3), see `system.panel`, take the
    place of the steps. Every record has the terms that it has alone. Health is that of the panel:
    inf, the code of the first failing record, and the index of its failing row.
    """

    def compile_panel(self, system: System) -> PlannedFunction:
        """Compile terms and health: (theta, rows, observed, inputs, t0, seed)."""

    def compile_panel_gradient(self, system: System) -> PlannedFunction:
        """Compile both passes as one function: (theta .. seed, terms_bar) -> theta_bar (G, k)."""

    def compile_panel_taped(self, system: System) -> PlannedFunction:
        """Compile the forward pass: terms, health and a tape of two dimensions."""

    def compile_panel_pullback(self, system: System) -> PlannedFunction:
        """Compile the backward pass: (theta .. seed, tape, terms_bar) -> theta_bar (G, k)."""


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
