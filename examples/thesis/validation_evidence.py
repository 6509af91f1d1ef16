"""Exact evidences of the four models of the validation under flat priors, by quadrature.

The likelihood of a linear Gaussian system is Gaussian in a_1, so its integral over the support of
a_1 follows from three evaluations. The rest, over sigma and a_2, is integrated on a grid.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, logsumexp

Array = NDArray[np.float64]

# The a_1 of the three evaluations, far enough apart that their differences exceed rounding error.
A1_STEP = 10.0


class Rule(NamedTuple):
    """Nodes and logarithms of weights of a quadrature, each of shape (n,)."""

    nodes: Array
    log_weights: Array

    def and_image(self, image: Callable[[Array], Array]) -> "Rule":
        """The rule for two ranges: its own, and its image under a reflection."""
        return Rule(
            np.concatenate([self.nodes, image(self.nodes)]),
            np.concatenate([self.log_weights, self.log_weights]),
        )


def gauss_legendre(n: int, low: float, high: float, power: int) -> Rule:
    """Return Gauss-Legendre for u, where the variable is u^power: nodes are dense near zero."""
    left, right = np.sign([low, high]) * np.abs([low, high]) ** (1 / power)
    nodes, weights = np.polynomial.legendre.leggauss(n)
    u = (left + right) / 2 + (right - left) / 2 * nodes
    slope = power * np.abs(u) ** (power - 1)
    return Rule(np.sign(u) * np.abs(u) ** power, np.log((right - left) / 2 * weights * slope))


def flat_evidences(
    log_likelihood: Callable[[Array, Array, Array], Array], sigma: Rule, a1_bound: float, a2: Rule
) -> Array:
    """Return log-evidences of M1 to M4 under priors of density one.

    Parameters
    ----------
    log_likelihood : callable
        ``log_likelihood(sigma, a1, a2)`` of arrays that broadcast to a shape S: array S + (n,), of
        n records.
    sigma, a2 : Rule
        For their supports.
    a1_bound : float
        The support of a_1 is from minus to plus this.

    Returns
    -------
    ndarray, shape (4, n)
    """
    # The last a_2 is that of the models without it.
    a2_nodes = np.append(a2.nodes, 0.0)
    a1 = A1_STEP * np.array([-1.0, 0.0, 1.0])
    below, at_zero, above = log_likelihood(sigma.nodes[:, None], a1[:, None, None], a2_nodes)
    over_a1 = _integral_of_gaussian(below, at_zero, above, a1_bound)
    w1 = sigma.log_weights[:, None]
    w2 = w1[:, None] + a2.log_weights[:, None]
    return np.array([
        logsumexp(at_zero[:, -1] + w1, axis=0),
        logsumexp(over_a1[:, -1] + w1, axis=0),
        logsumexp(at_zero[:, :-1] + w2, axis=(0, 1)),
        logsumexp(over_a1[:, :-1] + w2, axis=(0, 1)),
    ])  # fmt: skip


def _integral_of_gaussian(below: Array, at_zero: Array, above: Array, bound: float) -> Array:
    """Return the log-integral, over (-bound, bound), of exp of a parabola known at 3 points.

    The points are -A1_STEP, 0 and A1_STEP.
    """
    slope = (above - below) / (2 * A1_STEP)
    # The curvature is zero where a_1 has no effect: two steps with 1 + a_2 dt = -1 cancel.
    precision = np.maximum((2 * at_zero - above - below) / A1_STEP**2, 1e-12)
    mean, sd = slope / precision, precision**-0.5
    # Compute the mass between the bounds from the tail that contains it: no difference of ones.
    near = (-bound - np.abs(mean)) / sd
    far = (bound - np.abs(mean)) / sd
    log_mass = log_ndtr(far) + np.log1p(-np.exp(log_ndtr(near) - log_ndtr(far)))
    return at_zero + slope * mean / 2 + np.log(np.sqrt(2 * np.pi) * sd) + log_mass
