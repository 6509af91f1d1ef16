"""Mirror images are found with all signs that turn, and no other posterior has any."""

import numpy as np
import pytest

from pymc_statespace_filters.checks.coverage.mirrors import mirrors_of

K, CHAINS, N = 40, 4, 500
RNG = np.random.default_rng(1)
TURNED = np.sort(RNG.choice(K, 17, replace=False))
WEIGHTS = RNG.normal(size=(3, K, 60))


class Hidden:
    """A density of 60 numbers, each with elements that do not turn and products of two that do.

    ``evaluated`` counts the points; a ``tilt`` makes one of two images lower.
    """

    def __init__(self, centre, tilt=0.0):
        self.is_turned, self.tilt, self.evaluated = np.isin(np.arange(K), TURNED), tilt, 0
        self.data = self.numbers(centre)

    def numbers(self, x):
        odd, even = np.where(self.is_turned, x, 0.0), np.where(self.is_turned, 0.0, x)
        return (odd @ WEIGHTS[0]) * (odd @ WEIGHTS[1]) + even @ WEIGHTS[2]

    def __call__(self, x):
        self.evaluated += len(x)
        squares = ((self.numbers(x) - self.data) ** 2).sum(-1) + (x**2).sum(-1)
        return -0.5 * squares + self.tilt * np.tanh(x[:, TURNED[0]])


def draws_of(centre, width=0.1, sides=(1, 1, -1, 1)):
    """Chains around a centre, and around its mirror image where the side is -1."""
    x = centre + width * np.random.default_rng(2).normal(size=(CHAINS, N, K))
    signs = np.where(np.isin(np.arange(K), TURNED), -1.0, 1.0)
    return np.stack([x[i] * (signs if side < 0 else 1.0) for i, side in enumerate(sides)])


CENTRE = np.random.default_rng(3).normal(size=K)
ALL = np.ones(K, dtype=bool)


@pytest.mark.parametrize("sides", [(1, 1, -1, 1), (1, 1, 1, 1), (-1, -1, -1, -1)])
def test_all_signs_are_found_from_chains_in_both_images_or_in_one(sides):
    """Though half of the elements are near zero, with draws of either sign."""
    centre = CENTRE.copy()
    centre[::2] *= 0.01
    target, draws = Hidden(centre), draws_of(centre, sides=sides)
    (found,) = mirrors_of(draws, ALL, target)
    np.testing.assert_array_equal(np.sort(found.turned), TURNED)
    assert found.is_split == (len(set(sides)) > 1)
    assert found.is_clear
    one, two = (draws_of(centre, sides=[side] * CHAINS) for side in (1, -1))
    is_one = np.array_equal(found.folded, one)
    np.testing.assert_array_equal(found.folded, one if is_one else two)
    np.testing.assert_array_equal(found.share, np.array(sides) != (1 if is_one else -1))
    assert target.evaluated < 60 * K + 2 * 200  # none for each draw, where a sign tells


def test_all_that_turn_decide_in_which_image_a_draw_is():
    """Of each of these, some draws in one image have the sign of the other."""
    centre = np.sign(CENTRE)
    (found,) = mirrors_of(draws_of(centre, width=0.36), ALL, Hidden(centre))
    one, two = (draws_of(centre, width=0.36, sides=[side] * CHAINS) for side in (1, -1))
    assert (one * centre < 0)[..., TURNED].any(axis=(0, 1)).all()
    is_one = np.array_equal(found.folded, one)
    np.testing.assert_array_equal(found.folded, one if is_one else two)
    np.testing.assert_array_equal(found.share, [0, 0, 1, 0] if is_one else [1, 1, 0, 1])


def test_images_of_different_heights_are_none():
    """By so little as a thousandth of a nat."""
    assert len(list(mirrors_of(draws_of(CENTRE), ALL, Hidden(CENTRE)))) == 1
    assert list(mirrors_of(draws_of(CENTRE), ALL, Hidden(CENTRE, tilt=1e-3))) == []


def test_a_sign_that_may_not_turn_ends_the_search():
    """As that of a logarithm."""
    for i in TURNED:
        assert list(mirrors_of(draws_of(CENTRE), np.arange(K) != i, Hidden(CENTRE))) == []


def test_a_density_of_one_image_alone_has_none():
    """Zero where something that turns is negative, and at zero, as with a potential."""
    target, weights = Hidden(CENTRE), np.where(np.isin(np.arange(K), TURNED), CENTRE, 0.0)

    def walled(x):
        return np.where(x @ weights > 0, target(x), -np.inf)

    assert list(mirrors_of(draws_of(CENTRE, sides=[1] * CHAINS), ALL, walled)) == []


def ridge(x):
    """Normal priors, and a sum of two elements that is known to be zero."""
    return -0.5 * (x**2).sum(-1) - 0.5 * ((x[:, 0] + x[:, 1]) / 0.01) ** 2


def normal(x):
    return -0.5 * (x**2).sum(-1)


@pytest.mark.parametrize(
    ("target", "centre"), [(ridge, [1.0, -1.0, 0.2]), (normal, [1.5, 0.5, 0.0])]
)
def test_one_symmetric_mode_has_no_image(target, centre):
    """Though chains are too short to leave the side that each is on."""
    centre = np.array(centre)
    z = 0.01 * np.random.default_rng(4).normal(size=(CHAINS, N, 3))
    sides = np.array([1.0, -1.0, 1.0, -1.0])[:, np.newaxis, np.newaxis]
    assert list(mirrors_of(sides * (centre + z), np.ones(3, dtype=bool), target)) == []


def test_several_mirrors_at_once():
    """Of two hidden states, with two elements each, and of a product of three elements."""

    def two(x):
        return -50 * ((x[:, 0] * x[:, 2] - 1) ** 2 + (x[:, 1] * x[:, 3] - 1) ** 2) + normal(x)

    def triple(x):
        return -50 * (x[:, 0] * x[:, 1] * x[:, 2] - 1) ** 2 - 0.05 * (x**2).sum(-1)

    z = 0.05 * np.random.default_rng(5).normal(size=(CHAINS, N, 4))
    z += 1 + 0.1 * np.arange(4)
    z[1, :, [0, 2]] *= -1
    z[2, :, [1, 3]] *= -1
    z[3] *= -1
    found = list(mirrors_of(z, np.ones(4, dtype=bool), two))
    assert sorted(sorted(mirror.turned.tolist()) for mirror in found) == [[0, 2], [1, 3]]
    assert (found[-1].folded * found[-1].folded[0, 0] > 0).all()
    x = 1 + 0.1 * np.arange(3) + 0.02 * np.random.default_rng(6).normal(size=(CHAINS, N, 3))
    one, two = mirrors_of(x, np.ones(3, dtype=bool), triple)
    assert set(one.turned) != set(two.turned)
    assert len(one.turned) == len(two.turned) == 2


def bent(x):
    """One mode around zero in the first element, of which the second is nearly the square."""
    return normal(x) - 0.5 * ((x[:, 1] - x[:, 0] ** 2) / 0.01) ** 2


def test_a_bent_mode_that_chains_pass_through_has_no_image():
    x = np.random.default_rng(8).normal(size=(CHAINS, N, 2))
    x[..., 1] = x[..., 0] ** 2 + 0.01 * x[..., 1]
    assert list(mirrors_of(x, np.ones(2, dtype=bool), bent)) == []


def test_signs_that_the_density_tells_together_alone_are_proved():
    """Those of the last three are free beside the first, until all three are there."""

    def four(x):
        odd = np.stack([x[:, 0] * x[:, 1], x[:, 0] * x[:, 2] * x[:, 3] * x[:, 4]])
        return -50 * ((odd - 1) ** 2).sum(0) - 0.05 * (x**2).sum(-1)

    x = 1 + 0.02 * np.random.default_rng(7).normal(size=(CHAINS, N, 5))
    for mirror in mirrors_of(x, np.ones(5, dtype=bool), four):
        signs = np.where(np.isin(np.arange(5), mirror.turned), -1.0, 1.0)
        np.testing.assert_allclose(four(signs * x[0]), four(x[0]), rtol=1e-12)
