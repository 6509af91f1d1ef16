"""A defence against guides that are wrong: in some intervals one particle in ten moves unguided.

Where the equations bend over what is known of the state, a linear guide may leave out a way that
the state can take. The few particles that take it have large weights, and most estimates are too
low, a few far too high. With a share of unguided particles, and weights that divide by the
mixture of both densities, no weight of an interval is above ten (Hesterberg 1995, "Weighted average
importance sampling and defensive mixture distributions", Technometrics 37, 185-194). Resampling in
front of such an interval draws with the same share from the weights without psi.

The unguided are every tenth particle from a random place. Each is unguided with probability 1/10,
which is all that an unbiased estimate needs. In front of the first observation, where no normals
are left for a place, they begin with the first particle, and the mixture has their share of N.
"""

import numpy as np

from ...compiler.native.jit import copy_into, njit_internal
from ...compiler.numerics.exponential import exp, log
from ...compiler.numerics.normals import uniform

STRIDE = 10
UNGUIDED = 1.0 / STRIDE
_LARGEST_MISFIT = 1e-3  # nats in an interval; zero for linear equations

NOBODY = np.int64(-1)
"""In place of the first unguided particle: all are guided."""


@njit_internal
def is_doubtful(guide, j):
    """Whether the guide may be wrong in the interval that ends at observation j."""
    return j < guide.misfit.size and guide.misfit[j] > _LARGEST_MISFIT


@njit_internal
def unguided_at_start(n_particles):
    """The share of every tenth of the particles, the first included."""
    return ((n_particles + STRIDE - 1) // STRIDE) / n_particles


@njit_internal
def first_unguided(z):
    """Draw who is unguided, from the two normals of a resampling that its scheme leaves."""
    place = np.int64(STRIDE * uniform(z[z.size // 2 - 1], z[z.size - 1]))
    return min(place, np.int64(STRIDE - 1))


@njit_internal
def undo_guide(gains, X, Z, first, out):
    """Copy normals to ``out`` and replace those of the unguided, so that the guide moves them by Z.

    ``gains`` are those of `lowering.guidance.guided_noise`, ``first`` is the first unguided. The
    normals z of theirs solve a - K x + R z = Z, and the ratio of the densities comes out right.
    """
    n, m = X.shape[0], Z.shape[0]
    place = gains.size
    for r in range(m - 1, -1, -1):
        copy_into(out[r], Z[r])
        place -= m - r
        row = m + r * n
        for i in range(first, X.shape[1], STRIDE):
            value = Z[r, i] - gains[r]
            for a in range(n):
                value += gains[row + a] * X[a, i]
            for c in range(r + 1, m):
                value -= gains[place + c - r] * out[c, i]
            out[r, i] = value / gains[place]


@njit_internal
def mixture_weight(log_ratio, share):
    """Log of prior over mixture, from that of prior over guide and the share of the prior."""
    small = exp(-abs(log_ratio))
    negative = log_ratio < 0.0
    larger = 1.0 - share if negative else share
    smaller = share if negative else 1.0 - share
    return (log_ratio if negative else 0.0) - log(larger + smaller * small)
