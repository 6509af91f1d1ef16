"""What a Gaussian filter is made of: a linearisation of its system, and Kalman's algebra on it.

The state of the filter is one vector: the mean, then the lower triangle of the covariance. Filters
differ in how they linearise a function of a Gaussian state; prediction, update and smoother are
the same for all. Where tangents are exact, all take them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
import pytensor.tensor as pt
from pytensor.tensor.linalg import cholesky, solve_triangular
from pytensor.tensor.variable import TensorVariable

from ...compiler.codegen.semidefinite import regular_factor
from ...compiler.lowering.observation import log_normal, without_missing
from ...compiler.lowering.structure import has_linear_observation, has_linear_transition
from ...compiler.lowering.symbols import call, jacobian_of, observation_moments, process_noise_cov
from ...system.model import StateSpaceModel
from .censoring import truncate

Symbols = Mapping[str, TensorVariable]


def state_size(n: int) -> int:
    """Length of the vector (mean, lower triangle of the covariance) for n states."""
    return n + n * (n + 1) // 2


def pack(mean: TensorVariable, cov: TensorVariable) -> TensorVariable:
    """Concatenate a vector and the lower triangle of a symmetric matrix."""
    rows, columns = np.tril_indices(mean.type.shape[0])
    return pt.concatenate([mean, cov[rows, columns]])


def unpack(s: TensorVariable, n: int) -> tuple[TensorVariable, TensorVariable]:
    """The vector (n,) and the matrix (n, n): the inverse of `pack`."""
    position = np.zeros((n, n), dtype="int64")
    position[np.tril_indices(n)] = np.arange(n * (n + 1) // 2)
    position = np.maximum(position, position.T)
    return s[:n], s[n:][position]


class GaussianState(NamedTuple):
    """The state as x = mean + root xi with xi ~ N(0, cov); a matrix that is None is the identity.

    Jacobians of a filter are derivatives by xi. The EKF has xi = x - mean; sigma points need a
    root of the covariance, and xi is white.
    """

    mean: TensorVariable
    root: TensorVariable | None
    cov: TensorVariable | None

    def by_state(self, jac: TensorVariable) -> TensorVariable:
        """The derivative by x for that by xi; in directions without spread any would do."""
        if self.root is None:
            return jac
        return solve_triangular(regular_factor(self.root).T, jac.T, lower=False, b_ndim=2).T


class Linear(NamedTuple):
    """A linearised function: y = mean + jac xi + noise, noise ~ N(0, noise_cov).

    ``noise_cov`` includes what the line does not describe, and is None without noise. Where
    ``noise_jac`` is given, the noise is noise_jac q with the process noise q of the system.
    """

    mean: TensorVariable
    jac: TensorVariable
    noise_cov: TensorVariable | None
    noise_jac: TensorVariable | None = None


class Seen(NamedTuple):
    """A linearised observation: residual = jac xi + e, e ~ N(0, noise_cov).

    Missing components have zero residuals and rows of ``jac``, and independent unit noise; for
    censored ones see `censoring`. ``term`` is log p(d_j | d_1 .. d_{j-1}), None where it is the
    density of the residual.
    """

    residual: TensorVariable
    observed: TensorVariable
    jac: TensorVariable
    noise_cov: TensorVariable
    term: TensorVariable | None = None


class Linearization(Protocol):
    """How a filter linearises a system: an immutable, hashable object.

    ``has_short_rows`` says whether a row of the Jacobian of a prediction takes few operations.
    """

    has_short_rows: ClassVar[bool]

    def __hash__(self) -> int: ...

    def state(self, mean: TensorVariable, cov: TensorVariable) -> GaussianState:
        """The Gaussian state in the coordinates of this linearisation."""

    def transition(self, system: StateSpaceModel, values: Symbols, state: GaussianState) -> Linear:
        """The next state."""

    def observation(self, system: StateSpaceModel, values: Symbols, state: GaussianState) -> Seen:
        """The observation ``values["d"]``."""


class Linearizations(NamedTuple):
    """How the two equations of a system are linearised."""

    transition: Linearization
    observation: Linearization


class Innovation(NamedTuple):
    """Kalman's gain K for a linearised observation.

    ``chol`` is the lower factor of the covariance of the residual, ``innovation_cov``;
    ``update`` = root - K jac maps xi to the error that the update leaves.
    """

    innovation_cov: TensorVariable
    chol: TensorVariable
    gain: TensorVariable
    update: TensorVariable


def seen(system: StateSpaceModel, values: Symbols, state: GaussianState, linear: Linear) -> Seen:
    """Compare a linearised observation with the datum, NaN where missing."""
    residual, noise_cov, observed = without_missing(values["d"], linear.mean, linear.noise_cov)
    jac = linear.jac * observed[:, None]
    if system.equations.censoring is None:
        return Seen(residual, observed, jac, noise_cov)
    flags = call(system.equations.censoring, system, values)
    cov = product(jac, state.cov, jac.T) + noise_cov
    residual, more_noise, term = truncate(residual, cov, observed, flags)
    return Seen(residual, observed, jac, noise_cov + pt.diag(more_noise), term)


def innovation_of(state: GaussianState, observation: Seen) -> Innovation:
    """Eqs. 4.3-4.7 for the state before the observation."""
    jac = observation.jac
    innovation_cov = product(jac, state.cov, jac.T) + observation.noise_cov
    chol = cholesky(innovation_cov, lower=True)
    # K = P C^T S^-1 by two triangular solves.
    root = None if state.root is None else state.root.T
    half = solve_triangular(chol, product(jac, state.cov, root), lower=True, b_ndim=2)
    gain = solve_triangular(chol.T, half, lower=False, b_ndim=2).T
    root = pt.eye(state.mean.type.shape[0]) if state.root is None else state.root
    return Innovation(innovation_cov, chol, gain, root - gain @ jac)


def start(system: StateSpaceModel, values: Symbols) -> TensorVariable:
    """The state of the filter at step 0."""
    mean = call(system.equations.initial_mean, system, values)
    return pack(mean, call(system.equations.initial_cov, system, values))


def predict(
    linearization: Linearization, system: StateSpaceModel, values: Symbols
) -> TensorVariable:
    """Eqs. 4.8-4.11: one step from the state ``values["s"]``."""
    return predict_with_cross(linearization, system, values)[0]


def predict_with_cross(
    linearization: Linearization, system: StateSpaceModel, values: Symbols
) -> tuple[TensorVariable, TensorVariable]:
    """The same, and the covariance (n, n) of the states before and after the step."""
    state = linearization.state(*unpack(values["s"], system.n))
    step = linearization.transition(system, values, state)
    forecast_cov = product(step.jac, state.cov, step.jac.T)
    if step.noise_cov is not None:
        forecast_cov += step.noise_cov
    return pack(step.mean, forecast_cov), product(state.root, state.cov, step.jac.T)


def update(
    linearization: Linearization, system: StateSpaceModel, values: Symbols
) -> tuple[TensorVariable, TensorVariable]:
    """Eqs. 4.3-4.7 and 4.14: the analysis, and log p(d_j | d_1 .. d_{j-1})."""
    state = linearization.state(*unpack(values["s"], system.n))
    observation = linearization.observation(system, values, state)
    innovation = innovation_of(state, observation)
    gain, left = innovation.gain, innovation.update
    analysis_cov = product(left, state.cov, left.T) + gain @ observation.noise_cov @ gain.T
    term = observation.term
    if term is None:
        term = log_normal(observation.residual, innovation.innovation_cov, observation.observed)
    return pack(state.mean + gain @ observation.residual, analysis_cov), term


def product(*matrices: TensorVariable | None) -> TensorVariable:
    """The matrix product; None is the identity."""
    return reduce(lambda a, b: a @ b, [matrix for matrix in matrices if matrix is not None])


@dataclass(frozen=True)
class Tangent:
    """Linearisation at the mean of the state, by exact Jacobians."""

    has_short_rows: ClassVar[bool] = True

    def state(self, mean: TensorVariable, cov: TensorVariable) -> GaussianState:
        """The state itself."""
        return GaussianState(mean, None, cov)

    def transition(self, system: StateSpaceModel, values: Symbols, state: GaussianState) -> Linear:
        """Eqs. 4.8-4.10: A and B at the analysis of this step."""
        q = pt.zeros((system.m,))
        forecast = call(system.equations.transition, system, {**values, "x": state.mean, "q": q})
        noise_jac = jacobian_of(forecast, q)
        noise_cov = process_noise_cov(system, values, noise_jac) if system.m else None
        return Linear(forecast, jacobian_of(forecast, state.mean), noise_cov, noise_jac)

    def observation(self, system: StateSpaceModel, values: Symbols, state: GaussianState) -> Seen:
        """Eq. 4.4: C and D at the forecast."""
        expected, noise_cov = observation_moments(system, {**values, "x": state.mean})
        linear = Linear(expected, jacobian_of(expected, state.mean), noise_cov)
        return seen(system, values, state, linear)


@lru_cache(maxsize=256)
def linearizations_of(system: StateSpaceModel, linearization: Linearization) -> Linearizations:
    """Those of transition and observation: the tangent of what is linear, in fewer operations."""
    return Linearizations(
        Tangent() if has_linear_transition(system) else linearization,
        Tangent() if has_linear_observation(system) else linearization,
    )
