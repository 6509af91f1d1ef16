"""The generator: known answers, laws, and that a number depends on nothing but its place."""

import numpy as np
import pytest
from numba import njit
from scipy import stats

from pymc_statespace_filters.compiler.numerics import (
    philox as _random,
)
from pymc_statespace_filters.compiler.numerics import (
    restricted_domain as _elementary,
)
from pymc_statespace_filters.compiler.numerics.philox import (
    BLOCK,
    INITIAL,
    OBSERVATION,
    PROCESS,
    RESAMPLING,
    exponential,
    fill_normals,
    padded,
    uniform,
)


def normals(seed=1, purpose=PROCESS, step=0, components=1, members=BLOCK):
    Z = np.full((components, padded(members)), np.nan)
    fill_normals(seed, purpose, step, Z)
    return Z


@njit
def elementwise_exp(x, out):
    for i in range(x.size):
        out[i] = _elementary.exp(x[i])


@njit
def elementwise_log(x, out):
    for i in range(x.size):
        out[i] = _elementary.log(x[i])


@njit
def elementwise_sin_cos(x, sine, cosine):
    for i in range(x.size):
        sine[i], cosine[i] = _elementary.sin_cos_quarter(x[i])


@njit
def scalar_philox(counter, key):
    return _random.philox(counter[0], counter[1], counter[2], counter[3], key[0], key[1])


@njit
def box_muller(words):
    return _random.box_muller(words[0], words[1], words[2], words[3])


def relative_error(value, exact):
    return np.max(np.abs((value - exact) / exact)).astype(float)


# ---- elementary functions


def test_exp_is_accurate_to_rounding():
    x = np.concatenate([-np.logspace(-12, np.log10(708), 20_000), np.linspace(-50, 0, 20_001)])
    out = np.empty_like(x)
    elementwise_exp(x, out)
    assert relative_error(out, np.exp(x.astype(np.longdouble))) < 1e-15


def test_exp_of_what_is_out_of_range_is_negligible_and_not_nan():
    x = np.array([-709.0, -1e300, -np.inf, np.nan])
    out = np.empty_like(x)
    elementwise_exp(x, out)
    assert np.all((out >= 0) & (out < 1e-300))


def test_log_is_accurate_to_rounding_also_near_one():
    rng = np.random.default_rng(0)
    near_one = 1 - 2.0 ** -np.arange(1, 54)
    x = np.concatenate([rng.uniform(size=20_000), near_one, np.logspace(-300, 300, 5001)])
    x = x[x != 1]
    out = np.empty_like(x)
    elementwise_log(x, out)
    assert relative_error(out, np.log(x.astype(np.longdouble))) < 1e-15


def test_sin_and_cos_are_accurate_to_rounding():
    x = np.concatenate([np.linspace(-0.5, 0.5, 20_000), np.logspace(-16, -1, 100)])
    sine, cosine = np.empty_like(x), np.empty_like(x)
    elementwise_sin_cos(x, sine, cosine)
    angle = x.astype(np.longdouble) * np.arctan(np.longdouble(1)) * 2
    assert relative_error(sine, np.sin(angle)) < 1e-15
    assert relative_error(cosine, np.cos(angle)) < 1e-15


# ---- the generator


@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [
        ("00000000 00000000 00000000 00000000", "00000000 00000000",
         "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff",
         "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0",
         "d16cfe09 94fdcceb 5001e420 24126ea1"),
    ],
)  # fmt: skip
def test_philox_gives_the_published_known_answers(counter, key, answer):
    def words(text):
        return np.array([int(word, 16) for word in text.split()], dtype=np.uint64)

    assert np.array_equal(np.array(scalar_philox(words(counter), words(key))), words(answer))


def test_normals_are_box_muller_of_the_documented_philox_counter():
    seed, step, component, pair = -7, 12, 1, 40  # pair 40 is lane 8 of block 1
    key = np.array([seed & 0xFFFFFFFF, (seed >> 32) & 0xFFFFFFFF], dtype=np.uint64)
    counter = np.array([pair, component, step, PROCESS], dtype=np.uint64)
    expected = box_muller(np.array(scalar_philox(counter, key), dtype=np.uint64))
    Z = normals(seed, PROCESS, step, components=2, members=128)
    assert (Z[1, 64 + 8], Z[1, 64 + 8 + 32]) == expected


def test_a_number_does_not_depend_on_how_many_members_or_components_there_are():
    few, many = normals(components=2, members=50), normals(components=5, members=1250)
    assert few.shape == (2, 64)
    assert many.shape == (5, 1280)
    assert np.array_equal(few, many[:2, :64])


def test_every_seed_step_purpose_and_component_has_numbers_of_its_own():
    seeds = [0, 1, -1, 2**32, 2**62, -(2**63), 2**63 - 1]
    variants = [normals(seed=s) for s in seeds]
    variants += [normals(step=k) for k in (1, 2, 2000)]
    variants += [normals(purpose=purpose) for purpose in (INITIAL, OBSERVATION, RESAMPLING)]
    variants += [normals(components=3)[2:]]
    numbers = np.concatenate(variants).ravel()
    assert np.unique(numbers).size == numbers.size


def test_normals_are_standard_normal_with_their_tails():
    Z = normals(seed=3, components=8, members=64_000).ravel()  # 512 000 numbers
    n = Z.size
    # Kolmogorov-Smirnov; one false alarm in 1000 seeds
    assert stats.kstest(Z, "norm").pvalue > 1e-3
    # moments 1 to 4 within 4 standard errors (one in 16 000 each)
    for power, mean, variance in [(1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)]:
        assert abs((Z**power).mean() - mean) < 4 * np.sqrt(variance / n)
    # beyond 3 and 4 standard deviations, either side: Poisson counts within 4 sd
    for bound in (3.0, 4.0):
        for tail in (np.sum(bound < Z), np.sum(Z < -bound)):
            expected = n * stats.norm.sf(bound)
            assert abs(tail - expected) < 4 * np.sqrt(expected)


def test_directions_of_a_pair_are_uniform_on_the_circle():
    Z = normals(seed=5, members=64_000).reshape(-1, 2, 32)
    angle = np.arctan2(Z[:, 1], Z[:, 0]).ravel()
    radius = np.hypot(Z[:, 1], Z[:, 0]).ravel()
    octants = np.histogram(angle, bins=8, range=(-np.pi, np.pi))[0]
    assert stats.chisquare(octants).pvalue > 1e-3
    assert stats.kstest(angle, "uniform", args=(-np.pi, 2 * np.pi)).pvalue > 1e-3
    assert stats.kstest(radius, "rayleigh").pvalue > 1e-3


def test_streams_are_uncorrelated():
    n = 12_800
    streams = [normals(seed=s, members=n) for s in (0, 1, -1, 2**40)]
    streams += [normals(step=k, members=n) for k in (0, 1)]
    streams += [normals(purpose=purpose, members=n) for purpose in (INITIAL, OBSERVATION)]
    streams += [normals(step=9, components=3, members=n)]
    Z = np.concatenate([*streams[:1], *streams[2:]])  # streams[1] is streams[4]
    stacked = np.concatenate([Z, Z**2 - 1, np.roll(Z, 1, axis=1)])  # also squares and neighbours
    correlation = np.corrcoef(stacked) - np.eye(len(stacked))
    # 435 pairs, sd 1/sqrt(n) = 0.0088: 4.5 sd is one false alarm in 340 seeds
    assert np.abs(correlation).max() < 4.5 / np.sqrt(n)


def test_uniforms_are_uniform_and_differ_by_step_and_seed():
    Z = np.empty((1, 64))
    u = []
    for seed in range(40):
        for step in range(50):
            fill_normals(seed, RESAMPLING, step, Z)
            u.append(uniform(Z[0, 0], Z[0, 1]))
    u = np.array(u)
    assert np.all((u > 0) & (u < 1))
    assert stats.kstest(u, "uniform").pvalue > 1e-3


def test_exponentials_are_exponential():
    Z = np.empty((2, 20_032))
    fill_normals(11, RESAMPLING, 4, Z)
    e = np.array([exponential(z0, z1) for z0, z1 in Z.T])
    assert np.all(e > 0)
    assert stats.kstest(e, "expon").pvalue > 1e-3


@pytest.mark.parametrize(
    ("words", "expected"), [(0, 2.0**-53), (0xFFFFFFFF, 1 - 2.0**-53)], ids=["lowest", "highest"]
)
def test_the_unit_interval_is_open_and_symmetric(words, expected):
    word = np.uint64(words)
    assert njit(lambda w: _random.open_unit(w, w))(word) == expected


@pytest.mark.parametrize(("n", "expected"), [(2, 64), (64, 64), (65, 128), (1250, 1280)])
def test_padding(n, expected):
    assert padded(n) == expected
