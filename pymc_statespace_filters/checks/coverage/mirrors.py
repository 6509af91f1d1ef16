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

N_FOUND, N_PROVED = 2, 8  # draws by which signs are found, and by which they are proved
SAME = 1e-8  # relative difference of the log-densities of images, by rounding
APART, LEAST = 0.2, 0.02  # of the median size, if fewer of the draws are nearer to zero
SIDE = 0.02  # of the draws in the rarer image, at least, if they are in both

Array = NDArray[np.float64]
type Density = Callable[[Array], Array]
"""Log-densities (m,) at points (m, k), without noise."""


class Mirror(NamedTuple):
    """Two images of a posterior that are apart."""

    turned: NDArray[np.int64]  # elements whose signs differ between them, the clearest first
    share: Array  # (chain,), of the draws of each chain that are in one of them
    folded: Array  # (chain, draw, k), all draws in the other one; also of mirrors found before

    @property
    def is_split(self) -> bool:
        """Whether there are draws in both images."""
        return bool(SIDE < self.share.mean() < 1 - SIDE)


def mirrors_of(draws: Array, symmetric: NDArray[np.bool_], evaluate: Density) -> Iterator[Mirror]:
    """The mirrors of a posterior with draws (chain, draw, k); signs of ``symmetric`` (k,) may turn.

    One of the elements that turn has to stay away from zero.
    """
    found, sizes = set[int](), np.abs(draws).reshape(-1, draws.shape[-1])
    clear = np.quantile(sizes, LEAST, axis=0) / np.maximum(np.median(sizes, axis=0), 1e-300)
    x = draws.reshape(sizes.shape)[np.linspace(0, len(sizes) - 1, N_PROVED).astype(int)]
    for first in np.argsort(-clear):
        if first in found or not symmetric[first] or clear[first] < APART:
            continue
        signs = _signs(x[:: N_PROVED // N_FOUND], first, symmetric, evaluate)
        if signs is None or not _are_same(evaluate(signs * x), at_x := evaluate(x)).all():
            continue
        is_image = draws[..., first] < 0
        folded = np.where(is_image[..., np.newaxis], signs * draws, draws)
        ends = np.stack([folded.mean(axis=(0, 1)), x[at_x.argmax()]])
        # Images that are not apart are one mode around zero.
        if (evaluate(np.where(signs < 0, 0.0, ends)) < evaluate(ends) - DIP).any():
            turned = np.flatnonzero(signs < 0)
            turned = turned[np.argsort(-clear[turned], kind="stable")]
            yield Mirror(turned, is_image.mean(axis=1), folded)
            found.update(turned.tolist())
            draws, symmetric = folded, symmetric & (np.arange(len(symmetric)) != first)


def _signs(x: Array, first: int, symmetric: NDArray[np.bool_], evaluate: Density) -> Array | None:
    """The signs (k,) of the mirror in which an element turns, from points (m, k), if there is one.

    A sign that the density does not tell is kept, as of another mirror.
    """
    k, n_kept = x.shape[1], 1
    signs, known = np.ones(k), ~symmetric
    signs[first], known[first] = -1.0, True
    start = np.where(known, x, 0.0)
    if not _are_same(evaluate(signs * start), evaluate(start)).all():
        return None
    while not known.all():
        others = np.flatnonzero(~known)
        one = np.eye(k, dtype=bool)[others][:, np.newaxis]  # (other, 1, k), beside the known ones
        points = np.where(known | one, x, 0.0)
        images = points, signs * points, np.where(one, -signs, signs) * points
        at, *of_images = (evaluate(y.reshape(-1, k)).reshape(len(others), -1) for y in images)
        keeps, turns = (_are_same(values, at).all(axis=1) for values in of_images)
        if not (keeps | turns).all():
            return None
        told = keeps != turns
        if not told.any():
            told[:n_kept] = True
            n_kept *= 2
        signs[others[told & ~keeps]] = -1.0
        known[others[told]] = True
    return signs


def _are_same(a: Array, b: Array) -> NDArray[np.bool_]:
    return (a == b) | (np.abs(a - b) <= SAME * (1 + np.abs(b)))
