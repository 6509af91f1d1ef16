"""Whether a posterior has mirror images: its density is the same with some signs turned together.

As where a state that is not measured may have either sign, with all coefficients that are odd in
it. The signs are found at any draw. Where the elements that are symmetric about zero are zero, a
point is its own image, and the density tells of any one of them, beside those whose signs are
known, whether it turns with these. So all signs follow from that of a first element.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .copies import DIP

# Draws by which signs are found, by which they are proved, and of which the image is seen.
N_FOUND, N_PROVED, N_SIDES = 2, 8, 200
SAME = 1e-8  # relative difference of the log-densities of images, by rounding
LEAST, NEAR = 0.02, 1.0  # so few draws are nearer to the middle between images, in nats
CLEAR = 2.5  # mean size in standard deviations; of a normal distribution around zero it is 1.3
TINY = 1e-100  # in place of zero
MOST_FAILED = 10  # searches from one element that the density has not ended at once
SIDE = 0.02  # of the draws in the rarer image, at least, if they are in both

Array = NDArray[np.float64]
type Density = Callable[[Array], Array]
"""Log-densities (m,) at points (m, k), without noise."""


class Mirror(NamedTuple):
    """Two images of a posterior that are apart."""

    turned: NDArray[np.int64]  # elements whose signs differ between them, the clearest first
    is_clear: bool  # whether the first of these is clear of zero
    share: Array  # (chain,), of the draws of each chain that are in one of them
    folded: Array  # (chain, draw, k), all draws in the other one; also of mirrors found before

    @property
    def is_split(self) -> bool:
        """Whether there are draws in both images."""
        return bool(SIDE < self.share.mean() < 1 - SIDE)


def mirrors_of(draws: Array, symmetric: NDArray[np.bool_], evaluate: Density) -> Iterator[Mirror]:
    """The mirrors of a posterior with draws (chain, draw, k); signs of ``symmetric`` (k,) may turn.

    In which image a draw is, relative to another one, is seen half way to this and to its image.
    """
    found, n_failed = set[int](), 0
    flat = draws.reshape(-1, draws.shape[-1])
    few, some = (flat[np.linspace(0, len(flat) - 1, n).astype(int)] for n in (N_PROVED, N_SIDES))
    for first in np.argsort(-_clear(draws)):
        if first in found or not symmetric[first] or n_failed == MOST_FAILED:
            continue
        signs, n_sweeps = _signs(few[:N_FOUND], first, symmetric, evaluate)
        n_failed += signs is None and n_sweeps > 0
        if signs is None or not _are_same(evaluate(signs * few), at_few := evaluate(few)).all():
            continue
        best = few[at_few.argmax()]
        side = _sides(some, best, signs, evaluate)
        low, middle = np.quantile(np.abs(side), [LEAST, 0.5])
        if low < NEAR or middle < DIP:  # one mode around zero
            continue
        is_image = np.zeros(draws.shape[:2], dtype=bool)
        if (is_other := side < 0).any():
            tell = (((some < 0) != (best < 0)) == is_other[:, np.newaxis]).all(axis=0) & (signs < 0)
            votes = (draws < 0)[..., tell] != (best < 0)[tell]
            is_image = votes.all(axis=-1)
            unsure = is_image != votes.any(axis=-1)  # all draws, where no single sign tells
            if unsure.any():
                is_image[unsure] = _sides(draws[unsure], best, signs, evaluate) < 0
        folded = np.where(is_image[..., np.newaxis], signs * draws, draws)
        clear, turned = _clear(folded), np.flatnonzero(signs < 0)
        turned = turned[np.argsort(-clear[turned], kind="stable")]
        yield Mirror(turned, bool(clear[turned[0]] > CLEAR), is_image.mean(axis=1), folded)
        found.update(turned.tolist())
        draws, symmetric = folded, symmetric & (np.arange(len(symmetric)) != first)


def _clear(draws: Array) -> Array:
    """By how many standard deviations (k,) the sizes of elements are clear of zero."""
    sizes = np.abs(draws).reshape(-1, draws.shape[-1])
    return np.asarray(sizes.mean(axis=0) / np.maximum(sizes.std(axis=0), TINY))


def _sides(x: Array, reference: Array, signs: Array, evaluate: Density) -> Array:
    """How much nearer, in nats, points (m, k) are to a reference than to its image."""
    here, there = (evaluate((x + end) / 2) for end in (reference, signs * reference))
    with np.errstate(invalid="ignore"):  # both may be -inf
        return np.nan_to_num(here - there)


def _signs(
    x: Array, first: int, symmetric: NDArray[np.bool_], evaluate: Density
) -> tuple[Array | None, int]:
    """The signs (k,) of the mirror in which an element turns, from points (m, k), if there is one.

    And the number of sweeps over the other elements. A sign that the density does not tell is kept,
    as of another mirror.
    """
    k, n_kept, n_sweeps = x.shape[1], 1, 0
    signs, known = np.ones(k), ~symmetric
    signs[first], known[first] = -1.0, True
    start = np.where(known, x, 0.0)
    if not _are_same(evaluate(signs * start), evaluate(start)).all():
        return None, n_sweeps
    while not known.all():
        n_sweeps += 1
        others = np.flatnonzero(~known)
        one = np.eye(k, dtype=bool)[others][:, np.newaxis]  # (other, 1, k), beside the known ones
        points = np.where(known | one, x, 0.0)
        images = points, signs * points, np.where(one, -signs, signs) * points
        at, *of_images = (evaluate(y.reshape(-1, k)).reshape(len(others), -1) for y in images)
        keeps, turns = (_are_same(values, at).all(axis=1) for values in of_images)
        if not (keeps | turns).all():
            return None, n_sweeps
        told = keeps != turns
        if not told.any():
            told[:n_kept] = True
            n_kept *= 2
        signs[others[told & ~keeps]] = -1.0
        known[others[told]] = True
    return signs, n_sweeps


def _are_same(a: Array, b: Array) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return (a == b) | (np.abs(a - b) <= SAME * (1 + np.abs(b)))
