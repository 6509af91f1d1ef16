r"""Coordinates in which a posterior with slabs of an unknown scale is no funnel.

With a slab :math:`c \sim N(0, \tau)` and data that say little about c, the posterior of c is as
wide as :math:`\tau`, over all magnitudes of it: no mixture of a few components is like that. The
coordinate

.. math::

    y = a + (c - a)\, p(a \mid \rho)^\lambda

has with :math:`\lambda = 1` a width that does not depend on the other variables :math:`\rho`, as
the prior density at the value a where the term vanishes is the inverse of the scale of the slab.
Where the data determine c, :math:`\lambda = 0` is right. Each candidate has the power that makes
the draws most normal given the scale; it is zero if the prior density at a is constant.
"""

from dataclasses import dataclass

import numpy as np

from .submodel_density import Array, Columns, SubmodelDensity

POWERS = np.linspace(0.0, 1.0, 5)


@dataclass(frozen=True)
class Coordinates:
    """The map between the unconstrained vector x and coordinates y, both (n, k)."""

    density: SubmodelDensity
    power: Array  # (k,), zero for columns that stay as they are
    power_of_values: Array  # (k,), the same for the variables as they are, without a transform
    centre: Array  # (k,), the values a

    def log_scale(self, x: Array) -> Array:
        """The log of dy / dx of every column, (n, k); it depends on columns that stay."""
        if not self.power.any():
            return np.zeros_like(x)
        return np.asarray(self.power * self.density.log_prior_held(x))

    def forward(self, x: Array) -> Array:
        """The coordinates of x."""
        return np.asarray(self.centre + (x - self.centre) * np.exp(self.log_scale(x)))

    def of_values(self, values: Array, x: Array) -> Array:
        """The coordinates of the variables as they are, (n, k), at points x."""
        log_scale = self.power_of_values * self.density.log_prior_held(x)
        return np.asarray(self.centre + (values - self.centre) * np.exp(log_scale))

    def backward(self, y: Array, has: Columns) -> tuple[Array, Array]:
        """The points of y, and the log of the volume of dy / dx by the columns ``has``, (n,)."""
        log_scale = self.log_scale(y)
        x = self.centre + (y - self.centre) * np.exp(-log_scale)
        return x, np.asarray(log_scale[:, has].sum(axis=1))


def fitted_coordinates(density: SubmodelDensity, draws: Array, constrained: Array) -> Coordinates:
    """The coordinates that suit draws (n, k); ``constrained`` has the variables as they are."""
    size = draws.shape[1]
    switches = density.candidates.switches
    power, of_values, centre = np.zeros(size), np.zeros(size), switches.held_at(size)
    log_prior = density.log_prior_held(draws)
    for column in density.scaled_columns:
        h, values = log_prior[:, column], constrained[:, column]
        if np.isfinite(h).all() and np.ptp(h) > 0:
            of_values[column] = _best_power(values - centre[column], h)
            # A quantity with a transform has a scale of its own, such as the logarithm.
            has_none = np.array_equal(draws[:, column], values)
            power[column] = of_values[column] if has_none else 0.0
    return Coordinates(density, power, of_values, centre)


def _best_power(distance: Array, h: Array) -> float:
    """The power with the largest likelihood of a linear regression on h."""
    design = np.column_stack([np.ones_like(h), h])

    def score(power: float) -> float:
        y = distance * np.exp(power * (h - h.mean()))
        residual = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
        return float(-np.log(residual.std()))

    return float(max(POWERS, key=score))
