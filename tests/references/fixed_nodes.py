"""Densities of one state at fixed Gauss-Legendre nodes: sums over dense matrices."""

from typing import NamedTuple

import numpy as np
from scipy.stats import norm


def nodes(edges):
    """Points and weights, sixteen between any two edges."""
    z, w = np.polynomial.legendre.leggauss(16)
    half = 0.5 * np.diff(edges)[:, None]
    centre = 0.5 * (edges[1:] + edges[:-1])[:, None]
    return (centre + half * z).ravel(), (half * w).ravel()


class Law(NamedTuple):
    """Densities (steps, points), their means and standard deviations."""

    density: np.ndarray
    mean: np.ndarray
    sd: np.ndarray


class FixedNodes:
    """Filter and smoother of x' = N(mean(x), sd(x)^2); a point where either is NaN is lost.

    ``start`` is the density at step 0, or the state itself if it is known. ``likelihoods`` has a
    function of x for each step, or None.
    """

    def __init__(self, edges, mean, sd, start, likelihoods):
        self.x, self.weights = nodes(np.asarray(edges, float))
        with np.errstate(invalid="ignore", divide="ignore"):
            self.to, self.scale = mean(self.x), sd(self.x) + 0.0 * self.x
        self.lost = ~(np.isfinite(self.to) & np.isfinite(self.scale))
        self.kernel = self._kernel(self.to, self.scale)
        self.kernel[:, self.lost] = 0.0
        self.factors = [np.ones(self.x.size) if f is None else f(self.x) for f in likelihoods]
        self.observes = [f is not None for f in likelihoods]
        self.laws = {}
        self._forward(mean, sd, start, likelihoods[0])

    def _kernel(self, mean, sd):
        """In place: as many numbers as there are pairs of nodes."""
        with np.errstate(invalid="ignore", divide="ignore"):
            density = np.subtract.outer(self.x, mean)
            density /= sd
            np.square(density, out=density)
            density *= -0.5
            np.exp(density, out=density)
            density /= np.sqrt(2.0 * np.pi) * sd
        return density

    def _forward(self, mean, sd, start, first):
        self.predicted_density, self.filtered_density, self.terms = [], [], []
        known, log_left = not callable(start), 0.0
        predicted = np.full(self.x.size, np.nan) if known else start(self.x)
        for k, factor in enumerate(self.factors):
            if k == 0 and known:
                total = 1.0 if first is None else first(start)
                filtered, after = predicted, norm.pdf(self.x, mean(start), sd(start))
            else:
                product = predicted * factor
                total = product @ self.weights
                filtered = product / total
                after = self.kernel @ (filtered * self.weights)
            log_left += np.log(total)
            self.terms.append(log_left if self.observes[k] else 0.0)
            log_left = 0.0 if self.observes[k] else log_left
            self.predicted_density.append(predicted)
            self.filtered_density.append(filtered)
            predicted = after

    def law(self, moment):
        """Of "predicted", "filtered" or "smoothed" states."""
        if moment not in self.laws:
            self.laws[moment] = self._law(moment)
        return self.laws[moment]

    def _law(self, moment):
        if moment == "predicted":
            density = np.array(self.predicted_density)
        elif moment == "filtered":
            density = np.array(self.filtered_density)
        else:
            density = np.array(self.filtered_density) * self.ratios()
        density = density / (density @ self.weights)[:, None]
        mean = density @ (self.x * self.weights)
        variance = np.sum(density * (self.x - mean[:, None]) ** 2 * self.weights, axis=1)
        return Law(density, mean, np.sqrt(variance))

    def ratios(self):
        """Smoothed over filtered densities, up to a factor at each step."""
        ratio, out = np.ones(self.x.size), []
        for factor in reversed(self.factors):
            out.append(ratio)
            ratio = (factor * ratio * self.weights) @ self.kernel
            ratio /= ratio.max()
        return np.array(out[::-1])

    def mean_product(self, k):
        """E[x_k x_{k+1}] given the whole record."""
        before = self.filtered_density[k] * self.weights
        after = self.factors[k + 1] * self.ratios()[k + 1] * self.weights
        total = after @ self.kernel @ before
        return (after * self.x) @ self.kernel @ (before * self.x) / total
