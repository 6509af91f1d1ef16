"""The seeded records on which filters meet their truths."""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.references.grid import PointMassFilter

Array = NDArray[np.float64]


class Record(NamedTuple):
    """Observations (J,) or (J, p) at integer steps (J,)."""

    steps: NDArray[np.int64]
    observed: Array


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """x' = A x + B q, q ~ N(0, I); d = C x + e, e ~ N(0, R); x_0 ~ N(mean, cov)."""

    A: Array
    B: Array
    C: Array
    R: Array
    mean: Array
    cov: Array

    def start(self, n: int, rng: np.random.Generator) -> Array:
        """States (n, 2) at step 0."""
        return rng.multivariate_normal(self.mean, self.cov, size=n, method="svd")

    def move(self, x: Array, rng: np.random.Generator) -> Array:
        """States one step later."""
        return x @ self.A.T + rng.standard_normal((len(x), self.B.shape[1])) @ self.B.T

    def kalman_arguments(self) -> tuple[Array, ...]:
        """Positional arguments of `kalman_log_likelihood`."""
        return self.A, self.B @ self.B.T, self.C, self.R, self.mean, self.cov


def simulate(
    system: "LinearSystem | DoubleWell", steps: NDArray[np.int64], rng: np.random.Generator
) -> Array:
    """Observations (J, p) at the given steps."""
    x, now, observed = system.start(1, rng), 0, []
    for step in steps:
        for _ in range(step - now):
            x = system.move(x, rng)
        now = step
        noise = rng.multivariate_normal(np.zeros(len(system.R)), system.R)
        observed.append(system.C @ x[0] + noise)
    return np.array(observed)


# A damped oscillator driven through its velocity (singular process noise), seen through two
# correlated sensors.
OSCILLATOR = LinearSystem(
    A=np.array([[1.0, 0.2], [-0.4, 0.85]]),
    B=np.array([[0.0], [0.5]]),
    C=np.array([[1.0, 0.0], [0.3, 1.0]]),
    R=np.array([[0.30, 0.06], [0.06, 0.40]]),
    mean=np.array([0.5, 0.0]),
    cov=np.array([[0.6, 0.1], [0.1, 0.4]]),
)


@cache
def oscillator_with_gaps() -> Record:
    """Twelve irregular observations of OSCILLATOR, some of one sensor only, one wholly missing."""
    steps = np.array([0, 2, 3, 6, 7, 11, 12, 14, 19, 20, 22, 25])
    observed = simulate(OSCILLATOR, steps, np.random.default_rng(20250101))
    observed[[2, 8], 0] = np.nan
    observed[[4, 9], 1] = np.nan
    observed[6] = np.nan
    return Record(steps, observed)


@dataclass(frozen=True)
class DoubleWell:
    """dx = (alpha x + beta x^3) dt + sigma dW, seen as d = x + e, e ~ N(0, noise_var)."""

    alpha: float = 4.0
    beta: float = -4.0
    sigma: float = 0.6
    dt: float = 0.01
    noise_var: float = 0.08
    initial_mean: float = 1.0
    initial_var: float = 0.5

    def drift(self, x: Array) -> Array:
        """Rate of change of the state."""
        return self.alpha * x + self.beta * x**3

    @property
    def C(self) -> Array:
        """Observation matrix."""
        return np.ones((1, 1))

    @property
    def R(self) -> Array:
        """Observation covariance."""
        return np.array([[self.noise_var]])

    def start(self, n: int, rng: np.random.Generator) -> Array:
        """States (n, 1) at step 0."""
        return self.initial_mean + np.sqrt(self.initial_var) * rng.standard_normal((n, 1))

    def move(self, x: Array, rng: np.random.Generator) -> Array:
        """States one step later."""
        kick = self.sigma * np.sqrt(self.dt) * rng.standard_normal(x.shape)
        return x + self.dt * self.drift(x) + kick

    def point_mass_filter(self, n_points: int = 551) -> PointMassFilter:
        """The exact answer for this system."""
        return PointMassFilter(
            self.drift,
            sigma=self.sigma,
            dt=self.dt,
            noise_var=self.noise_var,
            initial_mean=self.initial_mean,
            initial_var=self.initial_var,
            n_points=n_points,
        )


DOUBLE_WELL = DoubleWell()
PRECISE_DOUBLE_WELL = DoubleWell(noise_var=0.06**2)
# Both wells probable for most of the time: an ensemble Kalman update is wrong here, and weights
# must repair it.
BROAD_DOUBLE_WELL = DoubleWell(sigma=1.0, noise_var=0.5, initial_mean=0.0)


@cache
def double_well() -> Record:
    """Twenty seconds, 2000 transitions, an observation every 20 steps from step 0 on: J = 101.

    The seed was chosen so that the state crosses the barrier once (after six seconds), for good.
    """
    steps = np.arange(0, 2001, 20)
    return Record(steps, simulate(DOUBLE_WELL, steps, np.random.default_rng(20250122))[:, 0])


@cache
def broad_double_well() -> Record:
    """Twenty observations of BROAD_DOUBLE_WELL, 40 steps apart."""
    steps = np.arange(0, 800, 40)
    return Record(steps, simulate(BROAD_DOUBLE_WELL, steps, np.random.default_rng(1))[:, 0])


# Which observations of the record with surprises are replaced, and by how many predicted standard
# deviations.
SURPRISES = {250: 5.0, 500: -6.0, 750: 7.0}


@cache
def double_well_with_surprises() -> Record:
    """A thousand precise observations, three of them 5, 6 and 7 predicted deviations off.

    "Predicted" is the exact predictive distribution given everything before, earlier surprises
    included.
    """
    steps = np.arange(0, 20_000, 20)
    observed = simulate(PRECISE_DOUBLE_WELL, steps, np.random.default_rng(20250106))[:, 0]
    grid = PRECISE_DOUBLE_WELL.point_mass_filter()
    for j, n_deviations in SURPRISES.items():
        answer = grid.run(steps[: j + 1], observed[: j + 1])
        observed[j] = answer.predicted_mean[j] + n_deviations * answer.predicted_sd[j]
    return Record(steps, observed)
