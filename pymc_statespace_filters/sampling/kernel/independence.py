"""Independence proposals: points drawn from a mixture of Student-t distributions.

A proposal z from the density q, wherever the chain is, is accepted with probability (Hastings
1970)::

    min(1, pi(z) q(y) / (pi(y) q(z)))

An iteration makes one with a probability that, like q, is constant after warm-up. The chain is then
reversible, because each of the two kernels is. Where the mixture is close to the posterior, most of
these proposals are accepted, and each is an independent draw. The random walk moves on where it is
not.

`proposal_mixture` fits q to draws of the warm-up.

References
----------
W. K. Hastings (1970). Monte Carlo sampling methods using Markov chains and their applications.
Biometrika 57, 97-109.
L. Tierney (1994). Markov chains for exploring posterior distributions. Annals of Statistics 22,
1701-1728.
"""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from ...compiler.native.jit import linked
from ...statistics.student_mixture import DEGREES_OF_FREEDOM

MOST_COMPONENTS = 9

# Cells of the numbers of a mixture. SHARE is the probability of an independence proposal.
SHARE, N_COMPONENTS = range(2)
# Columns of a component: cumulative weight, log of weight over normalisation, mean, lower factor.
CUMULATIVE, LOG_FACTOR, MEAN = range(3)


class ProposalMixture(NamedTuple):
    """The mixture that a chain draws proposals from, as views of one vector."""

    numbers: np.ndarray  # (2,)
    components: np.ndarray  # (MOST_COMPONENTS, 2 + d + d^2)


def no_mixture(dim: int) -> np.ndarray:
    """The packed mixture of a chain that makes no independence proposals."""
    return np.zeros(2 + MOST_COMPONENTS * (MEAN + dim + dim**2))


@register_jitable
def unpack_mixture(packed: np.ndarray, dim: int) -> ProposalMixture:
    """View a vector of the length of `no_mixture` as a mixture."""
    return ProposalMixture(packed[:2], packed[2:].reshape(MOST_COMPONENTS, MEAN + dim + dim * dim))


_internal = linked()


@_internal
def draw_from_mixture(mixture, normals, spread, uniform, point):
    """Set ``point`` to a draw of the mixture.

    ``normals`` (d,) are standard normal, ``spread`` is the square root of nu over a chi-square of
    nu degrees of freedom, ``uniform`` chooses the component.
    """
    dim, row = point.size, 0
    while (
        row < mixture.numbers[N_COMPONENTS] - 1 and uniform >= mixture.components[row, CUMULATIVE]
    ):
        row += 1
    component = mixture.components[row]
    for i in range(dim):
        value = component[MEAN + i]
        for j in range(i + 1):
            value += component[MEAN + dim + i * dim + j] * normals[j] * spread
        point[i] = value


@_internal
def log_mixture_density(mixture, point):
    """Log-density of the mixture at a point (d,)."""
    dim = point.size
    z = np.empty(dim)
    largest, total = -np.inf, 0.0
    for row in range(int(mixture.numbers[N_COMPONENTS])):
        component, distance = mixture.components[row], 0.0
        for i in range(dim):
            rest = point[i] - component[MEAN + i]
            for j in range(i):
                rest -= component[MEAN + dim + i * dim + j] * z[j]
            z[i] = rest / component[MEAN + dim + i * dim + i]
            distance += z[i] * z[i]
        tail = 0.5 * (DEGREES_OF_FREEDOM + dim) * np.log1p(distance / DEGREES_OF_FREEDOM)
        value = component[LOG_FACTOR] - tail
        if value > largest:
            total = total * np.exp(largest - value) + 1.0
            largest = value
        else:
            total += np.exp(value - largest)
    return largest + np.log(total)
