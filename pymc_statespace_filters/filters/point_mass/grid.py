"""Densities of one variable on a uniform grid, propagated by Gaussian transitions.

Point ``i`` of a grid is ``(low + i) * spacing`` and carries a mass: density times spacing. All
integrals are trapezoidal sums. For smooth integrands that vanish at both ends their error falls
faster than any power of the spacing: it is the integrand's spectrum beyond 2 pi / spacing.
"""

import math

import numpy as np

from ...compiler.native.jit import njit_internal, njit_reassoc
from ...compiler.numerics.restricted_domain import exp

MAX_POINTS = 8192
"""A grid of more points is a failure, see `filters.outcomes`."""

_MAX_PAIRS = 2**20  # of a source and a target point: a kernel of 8 MB

_ONE_OVER_ROOT_TWO_PI = 1.0 / math.sqrt(2.0 * math.pi)
_LARGEST_INDEX = 2.0**50
_BLOCK = 8  # the targets of a source are a multiple of this, so that vector loops have no remainder


@njit_internal
def grid_points(low, n, spacing):
    """Coordinates of the points in the layout of an ensemble, (1, n)."""
    X = np.empty((1, n))
    for i in range(n):
        X[0, i] = (low + i) * spacing
    return X


@njit_internal
def extent_of(mean, sd, mass, spacing, reach):
    """The grid of all points within ``reach`` standard deviations of some mean: (low, number).

    Sources without mass and sources that are not finite are ignored. The number is 0 if no source
    remains; any number above `MAX_POINTS` is reported as `MAX_POINTS` + 1.
    """
    lowest, highest, width = np.inf, -np.inf, 0.0
    for i in range(mass.size):
        if mass[i] > 0.0 and np.isfinite(mean[i]) and np.isfinite(sd[i]):
            lowest = min(lowest, mean[i] - reach * sd[i])
            highest = max(highest, mean[i] + reach * sd[i])
            width += 2.0 * reach * sd[i]
    if lowest > highest:
        return np.int64(0), np.int64(0)
    lowest, highest = lowest / spacing, highest / spacing
    too_many = highest - lowest > MAX_POINTS or width > _MAX_PAIRS * spacing
    if too_many or not max(-lowest, highest) < _LARGEST_INDEX:
        return np.int64(0), np.int64(MAX_POINTS + 1)
    low = np.int64(math.floor(lowest))
    return low, np.int64(math.ceil(highest)) - low + 1 + _BLOCK


@njit_internal
def add_gaussian(first, spacing, mean, sd, mass, out):
    """Add the masses of mass * N(mean, sd^2) to ``out``, whose first point is number ``first``."""
    scale = spacing / sd
    height = mass * scale * _ONE_OVER_ROOT_TWO_PI
    start = (first * spacing - mean) / sd
    for b in range(out.size):
        z = start + b * scale
        out[b] += height * exp(-0.5 * z * z)


@njit_internal
def _target(mean, sd, spacing, reach):
    """The range [first, last) of points within ``reach`` standard deviations of a source."""
    if not (np.isfinite(mean) and np.isfinite(sd)):
        return 0.0, 0.0  # a diverged source has no targets
    first = math.ceil((mean - reach * sd) / spacing)
    blocks = math.ceil((mean + reach * sd - first * spacing) / (_BLOCK * spacing))
    return first, first + _BLOCK * max(blocks, 1.0)


@njit_internal
def scatter(low, n, spacing, mean, sd, mass, reach):
    """Masses on a grid of the mixture sum_i mass_i N(mean_i, sd_i^2), truncated at ``reach``."""
    out = np.zeros(n)
    for i in range(mass.size):
        first, last = _target(mean[i], sd[i], spacing, reach)
        first, last = max(first, float(low)), min(last, float(low + n))
        if mass[i] > 0.0 and first < last:
            target = out[np.int64(first) - low : np.int64(last) - low]
            add_gaussian(first, spacing, mean[i], sd[i], mass[i], target)
    return out


@njit_reassoc
def _mean_over_gaussian(first, spacing, mean, sd, values):
    """Sum of ``values`` times the masses that `add_gaussian` gives a unit mass."""
    scale = spacing / sd
    start = (first * spacing - mean) / sd
    result = 0.0
    for b in range(values.size):
        z = start + b * scale
        result += exp(-0.5 * z * z) * values[b]
    return scale * _ONE_OVER_ROOT_TWO_PI * result


@njit_internal
def gather(low, spacing, values, mean, sd, reach):
    """Means of ``values`` on a grid under N(mean_i, sd_i^2): the transpose of `scatter`."""
    out = np.zeros(mean.size)
    for i in range(mean.size):
        first, last = _target(mean[i], sd[i], spacing, reach)
        first, last = max(first, float(low)), min(last, float(low + values.size))
        if first < last:
            target = values[np.int64(first) - low : np.int64(last) - low]
            out[i] = _mean_over_gaussian(first, spacing, mean[i], sd[i], target)
    return out


@njit_internal
def significant(mass, fraction):
    """The range [first, last) outside of which masses are below ``fraction`` of the largest."""
    largest = 0.0
    for value in mass:
        largest = max(largest, value)
    first, last = np.int64(0), np.int64(mass.size)
    while first < last and not mass[first] > fraction * largest:
        first += 1
    while last > first and not mass[last - 1] > fraction * largest:
        last -= 1
    return first, last


@njit_internal
def aliasing(mean, sd, source_spacing, spacing):
    """Aliasing error of the trapezoidal rule in one step, relative to each source's mass.

    As a function of the source, the mass that arrives at a point is a density at least as wide as
    the noise, sd, times a Gaussian of sd over the slope of the mean. The error is the spectrum of
    this product at 2 pi / spacing, of the coarser grid if the sources are on another one. Infinite
    where there is no noise.
    """
    n = mean.size
    spacing = max(source_spacing, spacing) if n > 1 else spacing
    errors = np.zeros(n)
    for i in range(n):
        if not (np.isfinite(mean[i]) and np.isfinite(sd[i])):
            continue
        before, after = max(i - 1, 0), min(i + 1, n - 1)
        slope = (mean[after] - mean[before]) / (source_spacing * (after - before)) if n > 1 else 1.0
        noise = sd[i] / spacing
        if noise > 0.0 and np.isfinite(slope):
            width = noise * noise / (1.0 + slope * slope)
            errors[i] = (1.0 + 1.0 / noise) * math.exp(-2.0 * math.pi**2 * width)
        else:
            errors[i] = np.inf if noise == 0.0 else 1.0 + 1.0 / noise
    return errors


@njit_reassoc
def total(mass, errors):
    """Sum of mass * error over the points with mass; errors elsewhere may be infinite."""
    result = 0.0
    for i in range(mass.size):
        result += mass[i] * errors[i] if mass[i] > 0.0 else 0.0
    return result


@njit_internal
def weigh(mass, log_density):
    """Log of sum_i mass_i exp(log_density_i), and its terms over the largest; NaN, inf give 0."""
    terms = np.empty(mass.size)
    largest = -np.inf
    for i in range(mass.size):
        value = math.log(mass[i]) + log_density[i] if mass[i] > 0.0 else -np.inf
        terms[i] = value if value < np.inf else -np.inf
        largest = max(largest, terms[i])
    if largest == -np.inf:
        return largest, terms
    whole = 0.0
    for i in range(mass.size):
        terms[i] = math.exp(terms[i] - largest)
        whole += terms[i]
    return largest + math.log(whole), terms


@njit_internal
def highest(log_density):
    """The largest value that is not infinite or NaN."""
    largest = -np.inf
    for value in log_density:
        if value > largest and value < np.inf:
            largest = value
    return largest


@njit_internal
def normalise(mass):
    """Scale the masses to sum to one, in place."""
    whole = 0.0
    for value in mass:
        whole += value
    for i in range(mass.size):
        mass[i] /= whole


@njit_internal
def coarseness(mass):
    """Relative disagreement of the sums over every third point: the spectrum at 2 pi / (3 spacing).

    It bounds the error of the sum over all points, wherever a peak lies between the points.
    """
    a, b, c = 0.0, 0.0, 0.0
    for value in mass:
        a, b, c = b, c, a + value
    return math.sqrt(0.5 * ((a - b) ** 2 + (b - c) ** 2 + (c - a) ** 2)) / (a + b + c)
