"""What is asked of a density that is known by its masses on a lattice: moments, and a draw."""

import math

from pymc_statespace_filters.compiler.native.jit import inline_always, njit_internal, njit_reassoc

_HALVINGS = 40  # of a cell, in which a draw is looked for


@njit_internal
def mean_and_sd(low, spacing, mass):
    """Mean and standard deviation, by the trapezoidal rule; masses need not sum to one."""
    whole = mass_of(mass)
    centre = _moment(mass, 0.0, 1) / whole
    variance = _moment(mass, centre, 2) / whole
    return (low + centre) * spacing, abs(spacing) * math.sqrt(variance)


@njit_reassoc
def mass_of(mass):
    """Sum of the masses."""
    whole = 0.0
    for i in range(mass.size):
        whole += mass[i]
    return whole


@njit_reassoc
def _moment(mass, centre, power):
    """Sum of the masses times a power of the distance, in points, from point ``centre``."""
    result = 0.0
    for i in range(mass.size):
        distance = i - centre
        result += mass[i] * (distance if power == 1 else distance * distance)
    return result


@njit_internal
def draw(low, spacing, mass, u):
    """Draw by inversion of the distribution function at u, in (0, 1).

    In the cell around each point the density is the parabola through it and its two neighbours.
    The parabolas' mean and variance are those of the masses: summed by parts, what they add
    cancels. Where the density falls so fast that a parabola is negative, in the tails, its
    integral is read as the nearest one that grows: on the coarsest lattice in use, of 1.2 points
    to the deviation, this makes the variance 0.1 % too large.
    """
    n = mass.size
    if n == 1:
        return low * spacing
    # A cell's share is its mass and 1/24 of the second difference, which telescopes in sums.
    whole = mass_of(mass) - (mass[0] + mass[-1]) / 24.0
    wanted = u * whole
    i, before, masses = 0, 0.0, mass[0]
    end = masses + (mass[1] - mass[0] - mass[0]) / 24.0
    while i + 2 < n and end < wanted:
        i += 1
        masses += mass[i]
        before, end = end, masses + (mass[i + 1] - mass[i] - mass[0]) / 24.0
    if end < wanted:
        i, before = n - 1, end
    return (low + i + _place(mass, i, wanted - before)) * spacing


@inline_always
def _place(mass, i, wanted):
    """The v in [-1/2, 1/2] up to which the parabola's integral over the cell is as wanted."""
    here = mass[i]
    before = mass[i - 1] if i > 0 else 0.0
    after = mass[i + 1] if i + 1 < mass.size else 0.0
    slope, bend = 0.5 * (after - before), 0.5 * (before - 2.0 * here + after)
    low, high = -0.5, 0.5
    for _ in range(_HALVINGS):
        v = 0.5 * (low + high)
        integral = here * (v + 0.5) + slope / 2.0 * (v * v - 0.25) + bend / 3.0 * (v**3 + 0.125)
        if integral < wanted:
            low = v
        else:
            high = v
    return 0.5 * (low + high)
