"""Mixtures of multivariate Student-t distributions fitted to draws.

The tails are heavier than those of most posteriors, as the density of an importance sample or of an
independence proposal needs. A mixture is fitted by expectation-maximisation with fixed degrees of
freedom (Peel and McLachlan 2000); the scale matrices are regularised towards the covariance of all
draws, so that no component can shrink to a point. A wide defensive component bounds the weights in
the tails (Hesterberg 1995).
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from .importance import log_sum, normalised

DEGREES_OF_FREEDOM = 5.0
N_STEPS, MIN_STEP = 200, 1e-3  # EM iterations; smallest gain in nats per draw
ROUNDING = 1e-10  # of the largest eigenvalue, the least one of a conditional scale matrix
WIDE_WEIGHT, WIDE_SCALE = 0.1, 1.5  # of the defensive component; scale in those of the draws

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StudentMixture:
    """A mixture of J multivariate Student-t distributions in k dimensions."""

    weights: Array  # (J,)
    means: Array  # (J, k)
    chols: Array  # (J, k, k), lower factors of the scale matrices

    def log_density(self, x: Array) -> Array:
        """Log-density at points x (m, k), shape (m,)."""
        return log_sum(self.log_joint(x), axis=0)

    def log_joint(self, x: Array) -> Array:
        """Log-density of each component times its weight at x (m, k), shape (J, m)."""
        nu, k = DEGREES_OF_FREEDOM, x.shape[-1]
        tail = 0.5 * (nu + k) * np.log1p(self.squared_distances(x) / nu)
        return self.log_factors[:, None] - tail

    @property
    def log_factors(self) -> Array:
        """Log of the weight of each component times its density at its mean, (J,)."""
        nu, k = DEGREES_OF_FREEDOM, self.means.shape[-1]
        log_det = np.log(np.diagonal(self.chols, axis1=1, axis2=2)).sum(axis=1)
        constant = gammaln((nu + k) / 2) - gammaln(nu / 2) - 0.5 * k * math.log(nu * math.pi)
        return np.asarray(np.log(self.weights) - log_det + constant)

    def squared_distances(self, x: Array) -> Array:
        """Squared Mahalanobis distances of x (m, k) from each component, shape (J, m)."""
        z = np.linalg.inv(self.chols) @ np.swapaxes(x - self.means[:, None], 1, 2)
        return np.asarray((z**2).sum(axis=1))

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw independent points, shape (count, k)."""
        component = rng.choice(len(self.weights), size=count, p=self.weights)
        normals = rng.standard_normal((count, self.means.shape[-1]))
        spread = np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, count))
        moves = np.einsum("mij,mj->mi", self.chols[component], normals)
        return self.means[component] + spread[:, None] * moves

    def with_defensive_component(self) -> "StudentMixture":
        """Add a component wider than the standardised draws."""
        k = self.means.shape[-1]
        wide = StudentMixture(np.ones(1), np.zeros((1, k)), WIDE_SCALE * np.eye(k)[None])
        return self.mixed_with(wide, WIDE_WEIGHT)

    def widened(self, scale: float) -> "StudentMixture":
        """The same with wider components."""
        return replace(self, chols=scale * self.chols)

    def conditioned(
        self, kept: NDArray[np.int64], given: NDArray[np.int64], values: Array
    ) -> "StudentMixture":
        """Near the law of the coordinates ``kept`` where others, ``given``, have these values.

        Each component has the conditional mean and scale of a normal law, and the weight that its
        marginal density at the values gives it.
        """
        gap = values - self.means[:, given]
        scales = self.chols @ np.swapaxes(self.chols, 1, 2)
        marginal = scales[:, given][:, :, given]
        gain = scales[:, kept][:, :, given] @ np.linalg.inv(marginal)
        means = self.means[:, kept] + np.einsum("jab,jb->ja", gain, gap)
        left = scales[:, kept][:, :, kept] - gain @ scales[:, given][:, :, kept]
        there = replace(self, means=self.means[:, given], chols=np.linalg.cholesky(marginal))
        log_weights = there.log_joint(values[None])[:, 0]
        weights = normalised(log_weights)
        # The units of coordinates may differ by any factor, so each has a floor of its own.
        units = np.sqrt(np.diagonal(scales[:, kept][:, :, kept], axis1=1, axis2=2))[:, :, None]
        factors = units * _factors(left / units / np.swapaxes(units, 1, 2))
        return replace(self, weights=weights, means=means, chols=factors)

    def tilted(self, slope: Array) -> "StudentMixture":
        """Near the law of a density that is this one times exp(slope x), with slope (k,).

        Each component has the mean and the weight that a normal law would have.
        """
        roots = np.swapaxes(self.chols, 1, 2) @ slope
        moves = np.einsum("jab,jb->ja", self.chols, roots)
        log_weights = np.log(self.weights) + self.means @ slope + 0.5 * (roots**2).sum(axis=1)
        weights = normalised(log_weights)
        return replace(self, weights=weights, means=self.means + moves)

    def with_wide_parts(self, parts: Mapping[float, float]) -> "StudentMixture":
        """A mixture of this one and wider copies of it, of these scales with these weights."""
        mixture, share = self, 1 - sum(parts.values())
        for scale, weight in parts.items():
            share += weight
            mixture = mixture.mixed_with(self.widened(scale), weight / share)
        return mixture

    def mixed_with(self, other: "StudentMixture", weight: float) -> "StudentMixture":
        """A mixture of this one and another, which has this weight."""
        return replace(
            self,
            weights=np.concatenate([(1 - weight) * self.weights, weight * other.weights]),
            means=np.concatenate([self.means, other.means]),
            chols=np.concatenate([self.chols, other.chols]),
        )

    def affine(self, mean: Array, chol: Array) -> "StudentMixture":
        """The distribution of mean + chol x."""
        return replace(self, means=mean + self.means @ chol.T, chols=chol @ self.chols)


class Standardised(NamedTuple):
    """Draws x (n, k) as mean + chol z, with z of mean zero and covariance one."""

    mean: Array
    chol: Array
    z: Array


def standardised(x: Array) -> Standardised | None:
    """Draws (n, k) as `fit_mixture` takes them; None if they do not vary in every direction."""
    mean, cov = x.mean(axis=0), np.atleast_2d(np.cov(x, rowvar=False))
    try:
        chol = np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        return None
    return Standardised(mean, chol, (x - mean) @ np.linalg.inv(chol).T)


def _factors(scales: Array) -> Array:
    """Cholesky factors of differences (J, k, k) that rounding may have made indefinite."""
    values, vectors = np.linalg.eigh((scales + np.swapaxes(scales, 1, 2)) / 2)
    least = ROUNDING * np.max(values, axis=-1, keepdims=True, initial=ROUNDING)
    roots = vectors * np.sqrt(np.maximum(values, least))[:, None, :]
    return np.linalg.cholesky(roots @ np.swapaxes(roots, 1, 2))


def place_components(x: Array, n_components: int, rng: np.random.Generator) -> StudentMixture:
    """Place components at draws x (n, k) far from each other (k-means++ initialisation)."""
    chosen = [x[rng.integers(len(x))]]
    while len(chosen) < n_components:
        nearest = np.min([((x - point) ** 2).sum(axis=1) for point in chosen], axis=0)
        if not nearest.any():
            break  # fewer distinct draws than components
        chosen.append(x[rng.choice(len(x), p=nearest / nearest.sum())])
    scale = np.eye(x.shape[-1]) * len(chosen) ** (-1 / x.shape[-1])
    return StudentMixture(
        np.full(len(chosen), 1 / len(chosen)), np.stack(chosen), np.tile(scale, (len(chosen), 1, 1))
    )


def likeliest_mixture(
    first: Array,
    second: Array,
    numbers: Iterable[int],
    rng: np.random.Generator,
    *,
    least_gain: float = 0.0,
) -> StudentMixture:
    """The fit to standardised draws that makes other draws most probable.

    Of these `numbers` of components, each is tried as long as it gains more than ``least_gain``
    nats per draw of the second set. To fit all draws, start from the result.
    """
    best, highest = place_components(first, 1, rng), -np.inf
    for n_components in numbers:
        fitted = fit_mixture(first, place_components(first, n_components, rng))
        held_out = float(fitted.log_density(second).mean())
        if held_out <= highest + least_gain:
            break
        best, highest = fitted, held_out
    return best


def mixture_of(x: Array, n_components: int, rng: np.random.Generator) -> StudentMixture | None:
    """So many components, fitted to draws (n, k); None if these do not vary in every direction."""
    if (draws := standardised(x)) is None:
        return None
    fitted = fit_mixture(draws.z, place_components(draws.z, n_components, rng))
    return fitted.affine(draws.mean, draws.chol)


def fit_mixture(x: Array, mixture: StudentMixture) -> StudentMixture:
    """Fit to standardised draws x (n, k) by expectation-maximisation."""
    reached = -np.inf
    for _ in range(N_STEPS):
        log_joint = mixture.log_joint(x)
        log_density = log_sum(log_joint, axis=0)
        if log_density.mean() < reached + MIN_STEP:
            break
        reached = log_density.mean()
        mixture = _m_step(mixture, x, np.exp(log_joint - log_density))
    return mixture


def _m_step(mixture: StudentMixture, x: Array, responsibilities: Array) -> StudentMixture:
    """Maximisation step of EM, given the responsibilities (J, n) of the components."""
    nu, k = DEGREES_OF_FREEDOM, x.shape[-1]
    # Draws in the tail of a component get little weight.
    weighted = responsibilities * (nu + k) / (nu + mixture.squared_distances(x))
    sizes = responsibilities.sum(axis=1)
    means = (weighted @ x) / weighted.sum(axis=1, keepdims=True)
    centred = x - means[:, None]
    scatter = np.swapaxes(centred, 1, 2) @ (weighted[..., None] * centred)
    # Regularise by k + 1 pseudo-draws of covariance one, that of all standardised draws.
    scales = (scatter + (k + 1) * np.eye(k)) / (sizes + k + 1)[:, None, None]
    weights = (sizes + 1) / (sizes + 1).sum()
    return replace(mixture, weights=weights, means=means, chols=np.linalg.cholesky(scales))
