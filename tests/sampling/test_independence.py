"""Independence proposals: the density is that of the draws, and the chain is exact.

The mixture is deliberately far from the posterior, so that a wrong acceptance probability shows.
"""

from threading import Event

import numpy as np
import pymc as pm
import pytest
from numba import njit
from scipy.integrate import quad
from scipy.stats import chi2, kstest

import pymc_statespace_filters as psf
from pymc_statespace_filters.sampling.kernel import proposal_mixture
from pymc_statespace_filters.sampling.kernel.delayed_rejection import (
    SMALL_SHARE,
    SMALLEST,
    walk_size,
)
from pymc_statespace_filters.sampling.kernel.independence import (
    N_COMPONENTS,
    SHARE,
    draw_from_mixture,
    log_mixture_density,
    no_mixture,
    unpack_mixture,
)
from pymc_statespace_filters.sampling.kernel.proposal_mixture import (
    FIRST_SHARE,
    LEAST_ACCEPTANCE,
    LEAST_SHARE,
    LEAST_WITH_NOISE,
    MOST_SHARE,
    fitted_mixture,
    improved_mixture,
    next_share,
    warmup_parts,
)
from pymc_statespace_filters.sampling.kernel.state import (
    INDEPENDENT,
    N_COUNTS,
    N_EVALUATIONS,
    N_NUMBERS,
    STAGE,
    Draws,
    random_block,
)
from pymc_statespace_filters.sampling.run.chain_task import ChainTask
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from pymc_statespace_filters.sampling.target.target import Target
from pymc_statespace_filters.statistics.student_mixture import DEGREES_OF_FREEDOM, StudentMixture
from tests.compiled import from_python


@njit
def density_at(packed, points):
    mixture = unpack_mixture(packed, points.shape[1])
    values = np.empty(len(points))
    for i in range(len(points)):
        values[i] = log_mixture_density(mixture, points[i])
    return values


@njit
def draws_of(packed, normals, spreads, uniforms):
    mixture, points = unpack_mixture(packed, normals.shape[1]), np.empty_like(normals)
    for i in range(len(normals)):
        draw_from_mixture(mixture, normals[i], spreads[i], uniforms[i], points[i])
    return points


def some_mixture(dim=3):
    rng = np.random.default_rng(1)
    chols = np.tril(rng.standard_normal((3, dim, dim)))
    chols[:, range(dim), range(dim)] = rng.uniform(0.5, 2.0, (3, dim))
    means = 3.0 * rng.standard_normal((3, dim))
    return StudentMixture(np.array([0.2, 0.5, 0.3]), means, chols)


def drawn(packed, dim, n, seed):
    rng = np.random.default_rng(seed)
    spreads = np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, n))
    return draws_of(packed, rng.standard_normal((n, dim)), spreads, rng.random(n))


def test_density_in_machine_code_is_that_of_the_mixture():
    mixture = some_mixture()
    x = 5.0 * np.random.default_rng(2).standard_normal((50, 3))
    found = density_at(proposal_mixture._packed(mixture), x)
    np.testing.assert_allclose(found, mixture.log_density(x), rtol=1e-12)


def test_draws_have_the_density():
    """Kolmogorov-Smirnov against draws of the mixture itself, in six directions, at 0.1 %."""
    mixture = some_mixture()
    mine = drawn(proposal_mixture._packed(mixture), 3, 20_000, 3)
    others = mixture.sample(20_000, np.random.default_rng(4))
    for direction in np.random.default_rng(5).standard_normal((6, 3)):
        assert kstest(mine @ direction, others @ direction).pvalue > 0.001


def test_spreads_of_a_block_are_those_of_a_student_t():
    """A spread times a normal has nu degrees of freedom; Kolmogorov-Smirnov at 0.1 %."""
    key = np.array([3, 4], dtype=np.uint64)
    blocks = [random_block(key, i, 1, 1, 0) for i in range(40)]
    spreads = np.concatenate([block.spreads for block in blocks])
    squared = DEGREES_OF_FREEDOM / spreads**2
    assert kstest(squared, chi2(DEGREES_OF_FREEDOM).cdf).pvalue > 0.001
    choices = np.concatenate([block.choices for block in blocks])
    assert kstest(choices.ravel(), "uniform").pvalue > 0.001
    assert abs(np.corrcoef(choices.T)[0, 1]) < 0.05


# The chain, on a posterior of one dimension with two unequal modes, known by quadrature.


def density(x):
    return 0.8 * np.exp(-0.5 * ((x + 2.0) / 0.4) ** 2) / 0.4 + 0.2 * np.exp(-0.5 * (x - 2.0) ** 2)


def chain_on_two_modes(share, *, stages=1, n=40_000):
    """Draws of a chain whose mixture is wide, shifted and of wrong weights, and never fitted."""
    with pm.Model() as model:
        x = pm.Flat("x")
        narrow, wide = -0.5 * ((x + 2.0) / 0.4) ** 2, -0.5 * (x - 2.0) ** 2
        terms = [np.log(0.8 / 0.4) + narrow, np.log(0.2) + wide]
        pm.Potential("two", pm.math.logaddexp(*terms))
    target = Target(model, None, RandomWalkSettings(stages=stages), [[0.5]])
    target.prepare()
    mixture = StudentMixture(
        np.array([0.15, 0.85]), np.array([[-1.0], [3.0]]), np.array([[[1.0]], [[2.0]]])
    )
    packed = proposal_mixture._packed(mixture)
    packed[SHARE] = share
    task = ChainTask(
        target, 0, n, lambda rng: [np.zeros(1)], np.random.SeedSequence(7), n_rows=n, mixture=packed
    )
    task.run(Event())
    return task.chain.draws


@pytest.mark.parametrize(("share", "stages"), [(1.0, 1), (0.5, 1), (0.5, 2)])
def test_a_chain_with_a_poor_mixture_is_exact(share, stages):
    """Probabilities of five intervals, to four standard errors of a chain's effective draws.

    Without the densities of the mixture in the acceptance probability, the mode on the right has
    far too much, see below.
    """
    draws = chain_on_two_modes(share, stages=stages)
    x = draws.positions[:, 0]
    total = quad(density, -6, 8, points=[-2, 2], limit=200)[0]
    for left, right in ((-6, -2.2), (-2.2, -1.8), (-1.8, 0), (0, 2), (2, 8)):
        expected = quad(density, left, right, limit=200)[0] / total
        inside = (left < x) & (x < right)
        blocks = inside[: len(inside) // 50 * 50].reshape(50, -1).mean(axis=1)
        assert abs(inside.mean() - expected) < 4.0 * blocks.std() / 50**0.5
    assert (draws.counts[:, INDEPENDENT] == 1).mean() == pytest.approx(share, abs=0.01)


def test_without_the_densities_of_the_mixture_the_test_above_fails():
    """A rule that forgets them, on the same posterior: what the bounds above would see."""
    rng, mixture = np.random.default_rng(8), [(-1.0, 1.0), (3.0, 2.0)]
    x, kept = 0.0, []
    for _ in range(40_000):
        mean, sd = mixture[int(rng.random() > 0.15)]
        z = mean + sd * rng.standard_t(DEGREES_OF_FREEDOM)
        if rng.random() * density(x) < density(z):
            x = z
        kept.append(x)
    total = quad(density, -6, 8, points=[-2, 2], limit=200)[0]
    expected = quad(density, 0, 8, limit=200)[0] / total
    assert abs(np.mean(np.array(kept) > 0) - expected) > 0.05


# Small walks.


def test_a_tenth_of_the_walks_are_smaller():
    uniforms = np.random.default_rng(1).random(20_000)
    size_of = from_python(walk_size)
    sizes = np.array([size_of(u) for u in uniforms])
    small = sizes[sizes < 1.0]
    assert len(small) / len(sizes) == pytest.approx(SMALL_SHARE, abs=0.01)
    assert kstest(np.log(small), "uniform", (np.log(SMALLEST), -np.log(SMALLEST))).pvalue > 0.001


@pytest.mark.parametrize("stages", [1, 2])
def test_a_chain_leaves_a_corner_that_is_smaller_than_its_walk(stages):
    """The walk is fifty times too wide: it accepts 2 % of its proposals, 6 % with small ones.

    The distribution is exact, by Kolmogorov-Smirnov at 0.1 % for one draw in a hundred.
    """
    with pm.Model() as model:
        pm.Normal("x", 0.0, 1.0)
    target = Target(model, None, RandomWalkSettings(stages=stages, stage_scale=0.5), [[50.0**2]])
    target.prepare()
    n = 60_000
    task = ChainTask(
        target, 0, n, lambda rng: [np.zeros(1)], np.random.SeedSequence(3), n_rows=n,
        mixture=no_mixture(1),
    )  # fmt: skip
    task.run(Event())
    draws = task.chain.draws
    assert (draws.counts[:, STAGE] > 0).mean() > 0.05
    assert kstest(draws.positions[::100, 0], "norm").pvalue > 0.001


# What is learnt.


def record(jumps_free, jumps_walk, dim=2, n=400, seed=9):
    """Draws of a chain whose accepted proposals make jumps of these lengths, each kind in turn."""
    rng = np.random.default_rng(seed)
    counts = np.zeros((n, N_COUNTS), dtype=np.int64)
    counts[:, N_EVALUATIONS] = 1
    counts[::2, INDEPENDENT] = 1
    length = np.where(counts[:, INDEPENDENT] == 1, jumps_free, jumps_walk)
    counts[:, STAGE] = length > 0
    side = np.where(rng.random((n, dim)) < 0.5, -1.0, 1.0)
    positions = np.empty((n, dim))
    positions[0] = 0.0
    for i in range(1, n):  # towards the origin, so that the variance stays that of the jumps
        turn = np.where(np.abs(positions[i - 1]) > 1.0, -np.sign(positions[i - 1]), side[i])
        positions[i] = positions[i - 1] + turn * length[i]
    empty = np.empty((n, 0), dtype=np.int64)
    return Draws(positions, np.empty((n, N_NUMBERS)), counts, empty, np.empty((0, dim, dim)))


def share_of(draws, least=LEAST_ACCEPTANCE):
    return next_share(0.5, [draws], 0, 400, least)


def test_the_share_follows_the_squared_jumps():
    assert share_of(record(1.0, 1.0)) == pytest.approx(0.5, abs=0.01)
    # A third of the length is a ninth of the square: 1 / (1 + 81).
    assert share_of(record(0.6, 0.2)) == MOST_SHARE
    third = share_of(record(0.5, 0.65))
    assert third == pytest.approx(0.25**2 / (0.25**2 + 0.65**4), abs=0.02)
    assert share_of(record(0.1, 0.6)) == 0.0
    assert share_of(record(0.0, 0.6)) == 0.0


def test_fewer_acceptances_are_enough_where_noise_makes_all_moves_rare():
    """Of 200 proposals of the mixture four count as accepted."""
    draws, free = record(1.0, 0.02), slice(0, None, 2)
    draws.counts[free, STAGE] = np.arange(200) % 50 == 0
    assert share_of(draws) == 0.0
    assert share_of(draws, LEAST_WITH_NOISE) > 0.2


def test_a_mixture_that_is_never_accepted_keeps_only_its_least_share_while_tuning():
    rng = np.random.default_rng(10)
    packed = fitted_mixture([rng.standard_normal((100, 2))], rng)
    assert packed[SHARE] == FIRST_SHARE
    rest = {"population": np.empty((0, 2)), "thin": 1, "is_noisy": True}
    for tuning, expected in ((True, LEAST_SHARE), (False, 0.0)):
        new = improved_mixture(packed, [record(0.0, 0.6)], 0, 400, rng, tuning=tuning, **rest)
        assert new[SHARE] == expected


def test_thinned_draws_leave_the_population_its_weight():
    """Of 200 draws of a chain near 0 the mixture has one in ten, beside 80 points near 50."""
    rng = np.random.default_rng(12)
    population = 50.0 + rng.standard_normal((80, 2))
    chains, rest = [record(1.0, 1.0)], {"population": population, "tuning": True, "is_noisy": False}
    shares = []
    for thin in (1, 10):
        packed = improved_mixture(no_mixture(2), chains, 0, 400, rng, thin=thin, **rest)
        points = drawn(packed, 2, 4000, 13)
        shares.append((points[:, 0] > 25.0).mean())
    assert shares == pytest.approx([80 / 280, 80 / 100], abs=0.15)


def test_many_dimensions_take_more_draws(monkeypatch):
    """Components of 2000 draws of 25 numbers hardly differ from what they are regularised by."""
    seen, likeliest, rng = [], proposal_mixture._likeliest, np.random.default_rng(14)

    def noted(parts, rng):
        seen.append(sum(map(len, parts)))
        return likeliest(parts, rng)

    monkeypatch.setattr(proposal_mixture, "_likeliest", noted)
    for dim in (2, 25):
        fitted_mixture([rng.standard_normal((4000, dim))], rng)
    assert seen == [2000, 4000]


def test_few_or_constant_draws_give_no_mixture():
    rng = np.random.default_rng(11)
    assert fitted_mixture([rng.standard_normal((19, 2))], rng) is None
    flat = rng.standard_normal((100, 2)) * [1.0, 0.0]
    assert fitted_mixture([flat], rng) is None
    assert no_mixture(2)[N_COMPONENTS] == 0
    assert fitted_mixture([rng.standard_normal((50, 2))], rng)[N_COMPONENTS] >= 2


@pytest.mark.parametrize(
    ("tune", "parts"),
    [(0, ()), (1, (1,)), (2, (1, 2)), (4, (1, 2, 3, 4)), (1000, (250, 500, 750, 1000))],
)
def test_parts_of_the_warm_up(tune, parts):
    assert warmup_parts(tune) == parts


def test_chains_jump_between_modes_that_a_random_walk_never_leaves():
    """Two modes forty standard deviations apart: all chains have both, in the right proportion."""
    with pm.Model():
        x = pm.Normal("x", 0.0, 10.0)
        left, right = -0.5 * ((x + 4.0) / 0.2) ** 2, -0.5 * ((x - 4.0) / 0.2) ** 2
        pm.Potential("two", pm.math.logaddexp(np.log(0.7) + left, np.log(0.3) + right))
        idata = psf.sample_dram(
            2000, tune=400, random_seed=1, progressbar=False, compute_convergence_checks=False
        )
    above = (idata["posterior"]["x"].values > 0).mean(axis=1)
    np.testing.assert_allclose(above, 0.3, atol=0.1)
