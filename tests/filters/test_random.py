"""The generator: known answers, laws, and that a number depends on nothing but its place."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest
from numba import njit
from scipy import stats

from pymc_statespace_filters.compiler.numerics import (
    normals as _normals,
)
from pymc_statespace_filters.compiler.numerics import (
    philox as _philox,
)
from pymc_statespace_filters.compiler.numerics import (
    restricted_domain as _elementary,
)
from pymc_statespace_filters.compiler.numerics.normals import (
    BLOCK,
    exponential,
    fill_normals,
    padded,
    uniform,
)
from pymc_statespace_filters.compiler.numerics.philox import (
    INITIAL,
    OBSERVATION,
    PROCESS,
    RESAMPLING,
)
from tests.waiting import LIMIT


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
def scalar_philox(counter, key):
    words = _philox.philox(counter[0], counter[1], counter[2], counter[3], key[0], key[1])
    return [word & _philox.LOW_WORD for word in words]


def box_muller(word, of_direction):
    """The normals of two words, as the module's docstring says, in double precision."""
    radius = np.sqrt(-2 * np.log((word + 0.5) / 2**32))
    angle = np.pi * (of_direction + 0.5 - 2**31) / 2**32
    sign = -1 if of_direction % 2 else 1
    return np.array([sign * radius * np.sin(angle), sign * radius * np.cos(angle)])


@njit
def _made_of(of_radius, of_direction, made):
    for i in range(of_radius.size):
        radius = _normals.radius_of(_normals.number_of(of_radius[i]))
        made[i] = _normals.point_at(radius, _normals.number_of(of_direction[i]))


def made_of(of_radius, of_direction):
    made = np.empty((of_radius.size, 2))
    _made_of(of_radius, of_direction, made)
    return made


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


# ---- the generator


@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [
        ("00000000 00000000 00000000 00000000", "00000000 00000000",
         "5f6fb709 0d893f64 4f121f81 4f730a48"),
        ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff",
         "5207ddc2 45165e59 4d8ee751 8c52f662"),
        ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0",
         "4dfccaba 190a87f0 c47362ba b6b5242a"),
    ],
)  # fmt: skip
def test_philox_gives_the_published_known_answers(counter, key, answer):
    def words(text):
        return np.array([int(word, 16) for word in text.split()], dtype=np.uint64)

    assert np.array_equal(np.array(scalar_philox(words(counter), words(key))), words(answer))


def test_normals_are_box_muller_of_the_documented_philox_counter():
    seed, step, component, call = -7, 12, 1, 24  # call 24 is lane 8 of block 1
    key = np.array([seed & 0xFFFFFFFF, (seed >> 32) & 0xFFFFFFFF], dtype=np.uint64)
    Z = normals(seed, PROCESS, step, components=2, members=128)
    for call in range(16, 32):
        counter = np.array([call, component, step, PROCESS], dtype=np.uint64)
        words = [int(word) for word in scalar_philox(counter, key)]
        lane = 64 + call - 16
        for first, two_words in ((lane, words[:2]), (lane + 16, words[2:])):
            expected = box_muller(*two_words)
            assert np.abs(Z[1, [first, first + 32]] - expected).max() < 4e-8


def test_all_words_make_normals_as_accurate_as_stated():
    corners = [0, 1, 2, 2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1]
    words = np.concatenate([corners, np.random.default_rng(1).integers(0, 2**32, 4000)])
    for of_radius, of_direction in ((words, words[::-1]), (words, np.roll(words, 5))):
        made = made_of(of_radius.astype(np.uint64), of_direction.astype(np.uint64))
        exact = np.array(
            [box_muller(int(a), int(b)) for a, b in zip(of_radius, of_direction, strict=True)]
        )
        radius = np.hypot(*exact.T)
        assert np.abs(np.hypot(*made.T) / radius - 1).max() < 2e-8
        assert np.abs((made - exact).T / radius).max() < 2e-8


def digest_of_normals():
    return hashlib.sha256(normals(-7, PROCESS, 11, components=3, members=1250)).hexdigest()


def test_normals_are_the_same_to_the_bit_on_every_machine():
    # Computed with vectors of 2, 4 and 8 numbers.
    assert digest_of_normals() == "a0272b7f8bc9ebce1b5475f90321e02f1466dd49eb3d55699fad7cde78594a90"


def test_normals_do_not_depend_on_the_width_of_vectors():
    # A processor without a fused multiply-add, and with vectors of two numbers.
    plain = {**os.environ, "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    program = "from tests.filters.test_random import digest_of_normals as d; print(d())"
    run = subprocess.run(
        [sys.executable, "-c", program],
        env=plain,
        capture_output=True,
        timeout=LIMIT,
        text=True,
        check=True,
    )
    assert run.stdout.strip() == digest_of_normals()


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
    assert njit(lambda w: _philox.open_unit(w, w))(word) == expected


@pytest.mark.parametrize(("n", "expected"), [(2, 64), (64, 64), (65, 128), (1250, 1280)])
def test_padding(n, expected):
    assert padded(n) == expected
