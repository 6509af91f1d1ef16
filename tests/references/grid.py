"""Point-mass filter for a scalar stochastic differential equation stepped by Euler-Maruyama.

The state's density is carried on a uniform grid and moved by the exact one-step kernel
N(x + f(x) dt, sigma^2 dt). All integrands are smooth and vanish at both ends, where the trapezoidal
rule converges faster than any power of the spacing: once the spacing is half the kernel's standard
deviation (0.06 for the double well) the error is rounding.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class GridAnswer(NamedTuple):
    """What the point-mass filter knows about each observation before it has seen it."""

    terms: Array  # (J,) log p(d_j | d_1 .. d_{j-1})
    predicted_mean: Array  # (J,)
    predicted_sd: Array  # (J,), observation noise included


def normal_density(x: Array, mean: Array | float, variance: float) -> Array:
    """N(x; mean, variance)."""
    return np.exp(-0.5 * (x - mean) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance)


class PointMassFilter:
    """Filter dx = f(x) dt + sigma dW, x_0 ~ N(m_0, v_0), seen as d = x + e, e ~ N(0, noise_var)."""

    def __init__(
        self,
        drift: Callable[[Array], Array],
        *,
        sigma: float,
        dt: float,
        noise_var: float,
        initial_mean: float,
        initial_var: float,
        low: float = -5.0,
        high: float = 6.0,
        n_points: int = 551,
    ) -> None:
        self.x, self.spacing = np.linspace(low, high, n_points, retstep=True)
        self.noise_var = noise_var
        self.prior = normal_density(self.x, initial_mean, initial_var)
        mean_next = self.x + dt * drift(self.x)
        self.kernel = normal_density(self.x[:, None], mean_next, sigma**2 * dt) * self.spacing
        self._kernels: dict[int, Array] = {0: np.eye(n_points)}

    def predict(self, density: Array, n_steps: int) -> Array:
        """Density n_steps later."""
        return self._kernel(n_steps) @ density

    def predict_back(self, function: Array, n_steps: int) -> Array:
        """Mean of a function of the state n_steps later, given the state now."""
        return self._kernel(n_steps).T @ function

    def _kernel(self, n_steps: int) -> Array:
        """Kernel of a gap; that of each distinct one is computed once."""
        if n_steps not in self._kernels:
            self._kernels[n_steps] = np.linalg.matrix_power(self.kernel, n_steps)
        return self._kernels[n_steps]

    def moments(self, density: Array) -> tuple[float, float]:
        """Predictive mean and standard deviation of an observation of a state with this density."""
        mean = self.spacing * density @ self.x
        variance = self.spacing * density @ (self.x - mean) ** 2 + self.noise_var
        return float(mean), float(np.sqrt(variance))

    def update(self, density: Array, observation: float) -> tuple[float, Array]:
        """Log predictive density of the observation, and the state's density given it."""
        joint = density * normal_density(self.x, observation, self.noise_var)
        evidence = self.spacing * joint.sum()
        return float(np.log(evidence)), joint / evidence

    def run(self, steps: NDArray[np.int64], observed: Array) -> GridAnswer:
        """Terms and predictive moments for a record; NaN is a missing observation with term 0."""
        terms, means, sds = (np.zeros(len(steps)) for _ in range(3))
        density, now = self.prior, 0
        for j, (step, observation) in enumerate(zip(steps, observed, strict=True)):
            density, now = self.predict(density, int(step) - now), int(step)
            means[j], sds[j] = self.moments(density)
            if not np.isnan(observation):
                terms[j], density = self.update(density, observation)
        return GridAnswer(terms, means, sds)
