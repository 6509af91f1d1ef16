"""Directions in which data leave the prior nearly as it is, and combinations that they determine.

The combinations are products of small powers of positive parameters, and sums of small multiples
of others.
"""

from itertools import combinations, product
from math import gcd
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

WEAK = 0.5  # share of a prior's sd from which a parameter, or a direction, is hardly determined
GAIN = 0.5  # share of the ratios of its members that a combination has at most
ALIKE = 2.0  # ratios of combinations within this factor are alike, so that the simplest is taken
POWERS = (-2, -1, 0, 1, 2)
MOST_MEMBERS, MOST_PARAMETERS = 3, 12  # of a combination; among which they are searched
LOG_PERCENT = 0.3  # sd of a logarithm from which it is no percentage

Array = NDArray[np.float64]
Exponents = NDArray[np.int64]


def weak_directions(covs: Array, prior: Array, labels: list[str]) -> pd.DataFrame:
    """The weak directions, weakest first: a row for each.

    Of posterior covariances (m, k, k) whitened by that of the prior, the axes of the mean.
    ``remains`` is the share of the prior's sd along one; the other columns are the parts of the
    parameters in it, in sds of their priors, of which the largest is one.
    """
    factor = np.linalg.cholesky(prior)
    inverse = np.linalg.inv(factor)
    shares, axes = np.linalg.eigh(inverse @ covs.mean(axis=0) @ inverse.T)
    parts = (factor @ axes) / np.sqrt(np.diagonal(prior))[:, None]
    parts = parts / np.take_along_axis(parts, np.abs(parts).argmax(axis=0)[None], axis=0)
    order = np.flatnonzero(shares >= WEAK**2)[::-1]
    table = pd.DataFrame(parts[:, order].T, columns=labels)
    table.insert(0, "remains", np.sqrt(shares[order]))
    table.index = pd.RangeIndex(1, len(order) + 1, name="direction")
    return table


class Combinations(NamedTuple):
    """Exponents (n, k) of combinations, their mean sds (n,) and ratios (n,), the best first."""

    exponents: Exponents
    sd: Array
    ratio: Array


def determined_combinations(
    covs: Array, prior: Array, kinds: NDArray[np.str_], chosen: NDArray[np.int64]
) -> Combinations:
    """What the data determine of ``chosen`` parameters that they do not determine one by one."""
    ratio = _ratios(covs, prior, np.eye(len(prior), dtype=np.int64))[1]
    weak = chosen[(ratio[chosen] >= WEAK) & (kinds[chosen] != "unconstrained")]
    weak = weak[np.argsort(-ratio[weak], kind="stable")][:MOST_PARAMETERS]
    tried = _tried(weak, kinds)
    if not len(tried):
        return Combinations(tried, np.empty(0), np.empty(0))
    sd, ratios = _ratios(covs, prior, tried)
    members = np.where(tried != 0, ratio, np.inf).min(axis=1)
    good = [int(i) for i in np.flatnonzero(ratios < GAIN * members)]
    picked: list[int] = []
    for rank in range(1, _n_determined(covs, prior, weak) + 1):
        # Those that are no combinations of the ones before.
        good = [i for i in good if np.linalg.matrix_rank(tried[[*picked, i]]) == rank]
        if not good:
            break
        alike = [i for i in good if ratios[i] <= ALIKE * ratios[good].min()]
        picked.append(min(alike, key=lambda i: (np.abs(tried[i]).sum(), ratios[i])))
    return Combinations(tried[picked], sd[picked], ratios[picked])


def _tried(weak: NDArray[np.int64], kinds: NDArray[np.str_]) -> Exponents:
    """Exponents (n, k) of all combinations of some parameters, each but for a common power."""
    found = []
    for size in range(2, MOST_MEMBERS + 1):
        powers = [
            p
            for p in product(POWERS, repeat=size)
            if all(p) and p[0] > 0 and gcd(*map(abs, p)) == 1
        ]
        for members in combinations(sorted(weak), size):
            if len({kinds[i] for i in members}) == 1:
                rows = np.zeros((len(powers), len(kinds)), dtype=np.int64)
                rows[:, members] = powers
                found.append(rows)
    return np.concatenate(found) if found else np.zeros((0, len(kinds)), dtype=np.int64)


def _ratios(covs: Array, prior: Array, exponents: Exponents) -> tuple[Array, Array]:
    """Mean sds (n,) of combinations, and those over the sds of the prior."""
    c = exponents.astype(np.float64)
    variances = np.einsum("nj,mjl,nl->mn", c, covs, c, optimize=True)
    sd = np.sqrt(np.maximum(variances, 0.0)).mean(axis=0)
    return sd, sd / np.sqrt(np.einsum("nj,jl,nl->n", c, prior, c))


def _n_determined(covs: Array, prior: Array, weak: NDArray[np.int64]) -> int:
    """How many directions among parameters are not weak."""
    at = np.ix_(weak, weak)
    inverse = np.linalg.inv(np.linalg.cholesky(prior[at]))
    shares = np.linalg.eigvalsh(inverse @ covs.mean(axis=0)[at] @ inverse.T)
    return int((shares < WEAK**2).sum())


def combination_label(exponents: Exponents, labels: list[str], *, is_log: bool) -> str:
    """A combination in the names of its parameters, such as ``"r / K"`` or ``"a - 2 b"``."""
    members = [(int(c), labels[i]) for i, c in enumerate(exponents) if c]
    if not is_log:
        terms = [(c, f"{abs(c)} {label}" if abs(c) > 1 else label) for c, label in members]
        first, *others = terms
        return first[1] + "".join(f" {'-' if c < 0 else '+'} {term}" for c, term in others)
    powers = [(c, f"{label}^{abs(c)}" if abs(c) > 1 else label) for c, label in members]
    above = " * ".join(power for c, power in powers if c > 0)
    below = [power for c, power in powers if c < 0]
    if not below:
        return above
    return f"{above} / {below[0] if len(below) == 1 else f'({" * ".join(below)})'}"


def precision(sd: float, *, is_log: bool) -> str:
    """How well a quantity of this sd, or sd of the logarithm, is determined."""
    if not is_log:
        return f"within {sd:.2g}"
    if sd < LOG_PERCENT:
        return f"to {100 * sd:.2g} %"
    return f"within a factor of {np.exp(sd):.2g}"
