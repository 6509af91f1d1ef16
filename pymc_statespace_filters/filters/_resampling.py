"""Resampling: draw N ancestors in proportion to the weights (thesis, section 4.4.1), in O(N).

Both schemes are a set of N increasing points in (0, 1) and the same walk along the cumulative
weights.

Differences from the source: the thesis copies particle n when v_n <= u < v_{n+1}, an interval that
belongs to particle n + 1; here it is v_{n-1} <= u < v_n with v_0 = 0. It also draws N + 1 times;
here N.
"""

from pymc_statespace_filters.filters._compile import compiled
from pymc_statespace_filters.filters._random import RESAMPLING, fill_exponentials, uniform


@compiled
def systematic(seed, step, points):
    """Points (i + u) / N with one uniform u; the last of the N + 1 places is not used."""
    n = points.size - 1
    u = uniform(seed, RESAMPLING, step)
    for i in range(n):
        points[i] = (i + u) / n


@compiled
def multinomial(seed, step, points):
    """N sorted uniforms: partial sums of N + 1 exponentials over their total."""
    n = points.size - 1
    fill_exponentials(seed, RESAMPLING, step, points)
    for i in range(1, n + 1):
        points[i] += points[i - 1]
    for i in range(n):
        points[i] /= points[n]


POINTS = {"systematic": systematic, "multinomial": multinomial}


@compiled
def choose_ancestors(w, points, ancestors):
    """Ancestor of each point: the n with v_{n-1} <= u < v_n, v the cumulative weights (Eq. 4.44).

    A particle of zero weight has an empty interval. The end is the last particle that has weight,
    whatever rounding makes of the last cumulative sum.
    """
    last = w.size - 1
    while last > 0 and not w[last] > 0.0:
        last -= 1
    total = 0.0
    for weight in w:
        total += weight
    n, cumulative = 0, w[0]
    for i in range(ancestors.size):
        while n < last and points[i] * total >= cumulative:
            n += 1
            cumulative += w[n]
        ancestors[i] = n


@compiled
def copy_ancestors(ancestors, X, buffer):
    """Replace the columns of X (states, particles) by those of their ancestors."""
    for a in range(X.shape[0]):
        row, old = X[a], buffer[a]
        for i in range(row.size):
            old[i] = row[i]
        for i in range(row.size):
            row[i] = old[ancestors[i]]
