"""A defence against wrong guides: in some intervals a share of the particles is unguided.

Where the equations bend over what is known of the state, or a sensor folds, a linear guide may
leave out a way that the state can take. The few particles that take it have large weights, and most
estimates are too low, a few far too high. With a share s of unguided particles, and weights that
divide by the mixture of both densities, no weight of an interval is above 1 / s (Hesterberg 1995,
"Weighted average importance sampling and defensive mixture distributions", Technometrics 37,
185-194). Resampling in front of such an interval draws with the same share from the weights without
psi.

Who is unguided is drawn once per interval, at even distances from a random place. Each particle is
unguided with probability s, which is all that an unbiased estimate needs. In front of the first
observation, where no normals are left for a place, they begin with the first particle, and the
mixture has their share of N.
"""

import math

import numpy as np

from ...compiler.native.jit import njit_internal
from ...compiler.numerics.exponential import exp, log
from ...compiler.numerics.normals import uniform

LEAST_SHARE, _SHARE_OF_DIVERGED = 0.1, 0.5
_LARGEST_MISFIT = 1e-3  # nats in an interval; zero for linear equations


@njit_internal
def least_share(guide, j):
    """The share in the interval that ends at observation j, if nothing else speaks for a larger.

    Half where the guide is the first of an iteration that diverged.
    """
    misfit, evidence = guide.sums[j]
    if evidence == -np.inf:
        return _SHARE_OF_DIVERGED
    return LEAST_SHARE if misfit > _LARGEST_MISFIT else 0.0


@njit_internal
def place_of_unguided(z):
    """Draw a place in [0, 1), from the two normals of a resampling that its scheme leaves."""
    return 1.0 - uniform(z[z.size // 2 - 1], z[z.size - 1])


@njit_internal
def choose_unguided(share, place, first, unguided):
    """Choose the unguided among particles from number ``first`` on."""
    for i in range(unguided.size):
        number = first + i
        unguided[i] = math.ceil((number + 1) * share - place) > math.ceil(number * share - place)


@njit_internal
def share_at_start(share, n_particles):
    """The share of the unguided among all particles if their place is 0."""
    return math.ceil(n_particles * share) / n_particles


@njit_internal
def undo_guide(gains, X, Z, unguided, out):
    """Copy normals to ``out`` and replace those of the unguided, so that the guide moves them by Z.

    ``gains`` are those of `lowering.guidance.guided_noise`. The normals z of the unguided solve
    a - K x + R z = Z, and the ratio of the densities comes out right.
    """
    n, m, N = X.shape[0], Z.shape[0], X.shape[1]
    place = gains.size
    for r in range(m - 1, -1, -1):
        place -= m - r
        row, z, given = m + r * n, out[r], Z[r]
        scale, shift = 1.0 / gains[place], gains[r]
        for i in range(N):
            z[i] = given[i] - shift + gains[row] * X[0, i]
        for a in range(1, n):
            gain = gains[row + a]
            for i in range(N):
                z[i] += gain * X[a, i]
        for c in range(r + 1, m):
            gain = gains[place + c - r]
            for i in range(N):
                z[i] -= gain * out[c, i]
        for i in range(N):
            z[i] = scale * z[i] if unguided[i] else given[i]


@njit_internal
def mixture_weight(log_ratio, share):
    """Log of prior over mixture, from that of prior over guide and the share of the prior."""
    small = exp(-abs(log_ratio))
    negative = log_ratio < 0.0
    larger = 1.0 - share if negative else share
    smaller = share if negative else 1.0 - share
    return (log_ratio if negative else 0.0) - log(larger + smaller * small)
