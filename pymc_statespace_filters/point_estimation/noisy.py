r"""The maximum of an estimated likelihood, by quadratics fitted to estimates (response surfaces).

The quadratic is fitted by least squares to estimates at points around the last maximum, in rounds
that adapt centre and scale of these points (Box and Wilson 1951). At every point the last round
averages several estimates of the likelihood: the logarithm of one is too small by half the variance
of the logarithm, which varies over the parameters. The covariance of the fitted coefficients gives
the error of the maximum that is due to the noise (Ionides and others 2017). Pure cubic terms in the
fit keep the skewness of the likelihood out of the slope.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..evidence.estimators.largest_likelihood import maximize_noisy
from ..evidence.estimators.newton import BatchFunction, EdgeError
from ..sampling.starts.annealing import Population
from ..statistics.importance import log_mean_of_independent
from .estimate import EDGE, HIDDEN, Lost, Peak, unconstrained_hessian
from .smooth import population_scale, rescaled

MIN_CURVATURE = 0.2  # below, a direction counts as one without curvature
MAX_STEP = 2.0  # standard errors, from the centre of a round to the next
NEAR = 0.5  # standard errors, of the last centre to its maximum
N_ROUNDS, N_LAST = 8, 3  # most rounds; with the settings of the last, at least
MAX_LENGTH = 1.0  # of a scale, in standard deviations of the population
SIGNIFICANT, KNOWN = 3.0, 2.0  # standard errors, of a slope and of a curvature
N_VALUING = 200  # fresh estimates at the maximum
TOO_NOISY = 0.2  # nats, standard error of their mean: the log-likelihood has a variance above 2

Array = NDArray[np.float64]


class _Round(NamedTuple):
    """Where a round estimates the likelihood."""

    sd: float  # of the points, in standard errors
    n_averaged: int  # estimates at a point
    n_least: int  # points
    n_per_coefficient: int


_FIRST, _LAST = _Round(1.0, 1, 200, 4), _Round(0.6, 12, 240, 6)


class _Surface(NamedTuple):
    """A quadratic in coordinates z of x = centre + scale z, fitted to estimates."""

    centre: Array  # (k,)
    scale: Array  # (k, k)
    slope: Array  # (k,) at the centre
    hessian: Array  # (k, k)
    coefficient_cov: Array  # (q, q)
    n_estimates: int

    def spectrum(self) -> tuple[Array, Array]:
        """Curvatures (k,) and their directions (k, k), in columns."""
        return np.linalg.eigh(-self.hessian)

    def curvature_errors(self) -> Array:
        """Standard errors (k,) of the curvatures, from those of the coefficients."""
        directions = self.spectrum()[1]
        k = len(directions)
        i, j = np.triu_indices(k)
        slopes = 2 * directions[i] * directions[j]  # (products, k)
        cov = self.coefficient_cov[1 + k : 1 + k + len(i), 1 + k : 1 + k + len(i)]
        return np.sqrt(np.einsum("pk,pq,qk->k", slopes, cov, slopes))

    def has_curvature(self) -> NDArray[np.bool_]:
        """Along which directions (k,) the curvature is larger than its noise."""
        least = np.maximum(MIN_CURVATURE, KNOWN * self.curvature_errors())
        return np.asarray(self.spectrum()[0] > least)

    def inverse(self) -> Array:
        """Inverse (k, k) of minus the Hessian along the directions with curvature."""
        (curvature, directions), kept = self.spectrum(), self.has_curvature()
        return directions[:, kept] / curvature[kept] @ directions[:, kept].T

    def maximum(self) -> tuple[Array, float]:
        """Maximum (k,) in z, at most `MAX_STEP` away, and how far away it would be.

        Along a direction without curvature it is `MAX_STEP` uphill, if the slope is significant.
        """
        curvature, directions = self.spectrum()
        slopes = directions.T @ self.slope
        k = len(slopes)
        errors = np.sqrt(
            np.diag(directions.T @ self.coefficient_cov[1 : k + 1, 1 : k + 1] @ directions)
        )
        uphill = np.where(np.abs(slopes) > SIGNIFICANT * errors, MAX_STEP * np.sign(slopes), 0.0)
        steps = np.where(curvature > MIN_CURVATURE, slopes / np.abs(curvature), uphill)
        distance = float(np.linalg.norm(steps))
        return directions @ steps / max(1.0, distance / MAX_STEP), distance

    def maximum_cov(self, z: Array) -> Array:
        """Covariance (k, k) of the maximum z, from the errors of the coefficients."""
        slopes = self.inverse() @ _feature_slopes(z)
        return slopes @ self.coefficient_cov @ slopes.T


def maximize_estimated(
    log_likelihood: BatchFunction, population: Population, rng: np.random.Generator
) -> Peak:
    """Find the largest maximum of a log-likelihood that is a random estimate.

    ``log_likelihood`` takes fresh noise for every point.
    """
    spread, mean = population_scale(population.x), population.x.mean(axis=0)
    z = (population.x - mean) @ np.linalg.inv(spread).T
    _, best = maximize_noisy(lambda z: log_likelihood(mean + z @ spread.T), z, population.log_ratio)
    point, scale = mean + spread @ best, spread
    settings = _FIRST
    for remaining in reversed(range(N_ROUNDS)):
        try:
            surface = _fitted(log_likelihood, point, scale, settings, rng)
        except EdgeError:
            return _unfitted(log_likelihood, point, scale)
        z, distance = surface.maximum()
        if remaining == 0 or (settings is _LAST and distance < NEAR):
            break
        if (distance < MAX_STEP and remaining < N_ROUNDS - 1) or remaining <= N_LAST:
            settings = _LAST
        point = point + scale @ z
        scale = rescaled(scale, *surface.spectrum(), spread, MAX_LENGTH)
    return _peak(log_likelihood, surface, spread)


def _fitted(
    function: BatchFunction, centre: Array, scale: Array, settings: _Round, rng: np.random.Generator
) -> _Surface:
    """Fit a quadratic to estimates around a point.

    Raises `EdgeError` if too many of the estimates are zero.
    """
    k = len(centre)
    q = 1 + 2 * k + k * (k + 1) // 2
    count = max(settings.n_least, settings.n_per_coefficient * q)
    z = settings.sd * rng.standard_normal((count, k))
    estimates = function(np.repeat(centre + z @ scale.T, settings.n_averaged, axis=0))
    averages = [log_mean_of_independent(row) for row in estimates.reshape(count, -1)]
    # the logarithm of an average is too small by half its relative variance
    values = np.array([one.value + 0.5 * min(one.error, 1.0) ** 2 for one in averages])
    found = np.isfinite(values)
    if found.sum() < 2 * q:
        raise EdgeError
    features = _features(z[found])
    inverse = np.linalg.pinv(features.T @ features)
    coefficients = inverse @ (features.T @ values[found])
    residual = values[found] - features @ coefficients
    variance = residual @ residual / (found.sum() - q)
    i, j = np.triu_indices(k)
    form = np.zeros((k, k))
    form[i, j] = coefficients[1 + k : 1 + k + len(i)]
    return _Surface(
        centre, scale, coefficients[1 : k + 1], form + form.T, variance * inverse, estimates.size
    )


def _features(z: Array) -> Array:
    """Terms (m, q) of the fit at points z (m, k): 1, z, products of two, cubes."""
    i, j = np.triu_indices(z.shape[1])
    return np.column_stack([np.ones(len(z)), z, z[:, i] * z[:, j], z**3])


def _feature_slopes(z: Array) -> Array:
    """Derivatives (k, q) of the terms at one point z (k,)."""
    k = len(z)
    i, j = np.triu_indices(k)
    one = np.eye(k)
    products = one[:, i] * z[j] + one[:, j] * z[i]
    return np.column_stack([np.zeros(k), one, products, np.diag(3 * z**2)])


def _peak(function: BatchFunction, surface: _Surface, spread: Array) -> Peak:
    """The maximum of the last surface, with fresh estimates there."""
    scale, (z, distance) = surface.scale, surface.maximum()
    point = surface.centre + scale @ z
    value = log_mean_of_independent(function(np.repeat(point[None], N_VALUING, axis=0)))
    (curvature, directions), kept = surface.spectrum(), surface.has_curvature()
    hidden = scale @ directions[:, ~kept]
    # The maximum may be anywhere in the population along a direction whose curvature is hidden.
    hidden = hidden / np.linalg.norm(np.linalg.solve(spread, hidden), axis=0)
    lost = tuple(Lost(direction, HIDDEN) for direction in hidden.T)
    cov = surface.maximum_cov(z)
    notes = list(_doubts(len(lost), len(z), distance, value.error))
    if notes:  # the errors of a maximum do not hold elsewhere
        cov[:] = np.nan
    else:
        in_errors = np.einsum("ki,kl,li->i", directions, cov, directions) * curvature
        notes = [
            f"the likelihood is estimated: the point is the maximum of a quadratic fitted to "
            f"{surface.n_estimates} estimates, and their noise displaces it by up to "
            f"{np.sqrt(in_errors.max()):.2g} standard errors"
        ]
    return Peak(
        point,
        value.value,
        value.error,
        scale @ directions[:, kept] / np.sqrt(curvature[kept]),
        lost,
        unconstrained_hessian(scale, surface.hessian),
        scale @ cov @ scale.T,
        tuple(notes),
    )


def _doubts(n_lost: int, k: int, distance: float, value_error: float) -> Iterator[str]:
    """Why the point may not be the maximum."""
    if n_lost:
        yield (
            "the maximum was not found: the noise of the likelihood hides its curvature along "
            f"{n_lost} of {k} directions, so that the log-likelihood is that of the best point "
            "found; take more particles (see suggest_particles)"
        )
    elif distance > NEAR:
        yield f"the search did not converge: its last step was {distance:.2g} standard errors long"
    if value_error > TOO_NOISY:
        yield (
            "the likelihood is so noisy that the standard errors are too small: take more "
            "particles (see suggest_particles)"
        )


def _unfitted(function: BatchFunction, point: Array, scale: Array) -> Peak:
    """The best point found, around which too many estimates are zero for a quadratic."""
    k = len(point)
    value = log_mean_of_independent(function(np.repeat(point[None], N_VALUING, axis=0)))
    return Peak(
        point,
        value.value,
        value.error,
        np.zeros((k, 0)),
        tuple(Lost(column, EDGE) for column in scale.T),
        np.full((k, k), np.nan),
        np.full((k, k), np.nan),
        ("most estimates of the likelihood around the point are zero",),
    )
