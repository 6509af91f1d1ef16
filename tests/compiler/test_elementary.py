"""The functions of vector loops: against 64-bit mantissas, and NumPy's answers at the edges."""

import warnings
from functools import cache

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from numba import njit
from scipy.special import polygamma

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen.emitter import INLINED
from pymc_statespace_filters.compiler.codegen.trigamma import trigamma
from pymc_statespace_filters.compiler.native.jit import FAST_MATH
from pymc_statespace_filters.compiler.numerics.intrinsics import fma, polynomial, sqrt
from pymc_statespace_filters.compiler.numerics.order import stable_order

N = 40_000
LARGEST, SMALLEST = np.finfo(float).max, 5e-324
EDGES = np.array([
    0.0, np.inf, np.nan, 1.0, 0.5, 2.0, 3.0, 1e-310, SMALLEST, 2.3e-308, 1e-17, 1e-8, LARGEST,
    1e300, 709.78, 709.79, 710.4, 710.5, 745.1, 745.2, 1023.9, 1024.0, 1074.9, 1076.0, 40.0,
])  # fmt: skip
EDGES = np.concatenate([EDGES, -EDGES])


def signed(magnitudes):
    return np.concatenate([magnitudes, -magnitudes])


def points():
    """Where each function is measured: its whole domain, and where it is delicate."""
    rng = np.random.default_rng(0)
    uniform = lambda low, high: rng.uniform(low, high, N)  # noqa: E731
    decades = lambda low, high: 10.0 ** rng.uniform(low, high, N)  # noqa: E731
    small = signed(decades(-323, 0))
    positive = np.concatenate([decades(-323, 308), 1 + signed(decades(-16, -0.6))])
    angles = np.concatenate([
        small, uniform(-10, 10), signed(2.0 ** rng.uniform(0, 47, N)), uniform(2**46, 2**47),
        np.arange(-20_000, 20_001) * np.pi / 2,
    ])  # fmt: skip
    real_line = np.concatenate([uniform(-746, 711), uniform(-2, 2), small])
    return {
        "exp": np.concatenate([real_line, uniform(-746, -707)]),
        "exp2": np.concatenate([uniform(-1076, 1025), uniform(-2, 2), small]),
        "expm1": np.concatenate([real_line, uniform(709, 709.8)]),
        "log": positive, "log2": np.concatenate([positive, 2.0 ** np.arange(-1074, 1024)]),
        "log10": np.concatenate([positive, 10.0 ** np.arange(23)]),
        "log1p": np.concatenate([decades(-300, 308), uniform(-1, 3), -decades(-16, 0) - 0.0]),
        "sin": angles, "cos": angles, "tan": angles,
        "arctan": np.concatenate([signed(decades(-300, 300)), uniform(-3, 3)]),
        "sinh": real_line, "cosh": real_line,
        "tanh": np.concatenate([uniform(-22, 22), uniform(-1, 1), small]),
    }  # fmt: skip


POINTS = points()
LARGEST_ERROR = {"tan": 2.2}  # ulp; next to its poles
NEEDS_LONG_DOUBLE = pytest.mark.skipif(
    np.finfo(np.longdouble).nmant < 63, reason="no wider floating-point type here"
)


@cache
def elementwise(name):
    """The function in a loop that is compiled as generated loops are."""
    function = (INLINED | {"sqrt": sqrt})[name]
    options = {"fastmath": FAST_MATH, "error_model": "numpy"}

    @njit(**options)
    def one(x, out):
        for i in range(x.size):
            out[i] = function(x[i])

    @njit(**options)
    def two(x, y, out):
        for i in range(x.size):
            out[i] = function(x[i], y[i])

    def apply(*arrays):
        out = np.empty(arrays[0].size)
        (one if len(arrays) == 1 else two)(*arrays, out)
        return out

    return apply


def unit(value):
    """The unit in the last place."""
    return np.spacing(np.minimum(np.abs(value), LARGEST / 2))


def ulps(value, exact):
    """Distances in units in the last place of the exact result, rounded."""
    with np.errstate(all="ignore"):
        rounded = exact.astype(float)
        distance = np.abs(value - exact) / unit(rounded)
    return np.where(np.isinf(rounded) & (value == rounded), 0, distance).astype(float)


def long(array):
    return array.astype(np.longdouble)


@NEEDS_LONG_DOUBLE
@pytest.mark.parametrize("name", POINTS)
def test_every_result_is_within_two_units_in_the_last_place(name):
    x = POINTS[name]
    with np.errstate(all="ignore"):
        exact = getattr(np, name)(long(x))
    assert ulps(elementwise(name)(x), exact).max() < LARGEST_ERROR.get(name, 2.0)


@NEEDS_LONG_DOUBLE
def test_powers_are_within_two_units_in_the_last_place():
    rng = np.random.default_rng(1)
    x = np.concatenate([10.0 ** rng.uniform(-320, 308, N), rng.uniform(0, 3, N)])
    reach = 745 / np.maximum(np.abs(np.log(x)), 1e-300)  # from underflow to overflow
    y = np.clip(reach, 0, 1e300) * rng.uniform(-1, 1, x.size)
    near_one, large = 1 + signed(10.0 ** rng.uniform(-15, -1, N)), 700 * rng.uniform(-1, 1, 2 * N)
    x, y = np.concatenate([x, near_one]), np.concatenate([y, large / np.log(near_one)])
    with np.errstate(all="ignore"):
        exact = long(x) ** long(y)
    assert ulps(elementwise("power")(x, y), exact).max() < 2.0


@NEEDS_LONG_DOUBLE
def test_angles_of_points_are_within_two_units_in_the_last_place():
    rng = np.random.default_rng(2)
    y = np.concatenate([rng.normal(size=N), signed(10.0 ** rng.uniform(-300, 308, N))])
    x = np.concatenate([rng.normal(size=N), rng.permutation(y[N:])])
    assert ulps(elementwise("arctan2")(y, x), np.arctan2(long(y), long(x))).max() < 2.0


def assert_like_numpy(value, expected, *arguments):
    """Equal to two units in the last place, and NaN, infinity and the sign of zero the same."""
    same = (value == expected) & (np.signbit(value) == np.signbit(expected))
    both_nan = np.isnan(value) & np.isnan(expected)
    with np.errstate(invalid="ignore"):
        near = np.isfinite(value) & (np.abs(value - expected) <= 2 * unit(expected))
    wrong = ~(same | both_nan | (near & (expected != 0)))
    assert not wrong.any(), [a[wrong] for a in (*arguments, value, expected)]


@pytest.mark.parametrize("name", [*POINTS, "sqrt"])
def test_edges_are_those_of_numpy(name):
    x = EDGES
    if name in ("sin", "cos", "tan"):
        x = x[(np.abs(x) < 2**47) | ~np.isfinite(x)]
    with np.errstate(all="ignore"):
        expected = getattr(np, name)(x)
    assert_like_numpy(elementwise(name)(x), expected, x)


@pytest.mark.parametrize(("name", "of_numpy"), [("power", np.power), ("arctan2", np.arctan2)])
def test_edges_of_two_arguments_are_those_of_numpy(name, of_numpy):
    numbers = np.concatenate([EDGES, [7.0, -7.0, 2.5, -2.5, 2.0**53 + 2, 2.0**52 + 1]])
    x, y = (a.ravel().copy() for a in np.meshgrid(numbers, numbers))
    with np.errstate(all="ignore"):
        expected = of_numpy(x, y)
    assert_like_numpy(elementwise(name)(x, y), expected, x, y)


@pytest.mark.parametrize(("name", "value"), [("sin", 0.0), ("cos", 1.0), ("tan", 0.0)])
def test_angles_too_large_to_have_a_direction_count_as_zero(name, value):
    assert (elementwise(name)(np.array([2.0**47, -(2.0**60), LARGEST])) == value).all()


def test_division_with_a_remainder_is_numpys():
    rng = np.random.default_rng(3)
    x = np.concatenate([rng.normal(size=N) * 10.0 ** rng.uniform(-3, 6, N), [3.0, -3.0, 0.0]])
    y = np.concatenate([rng.normal(size=N), [np.inf, np.inf, 2.0]])
    # multiples, which a rounded quotient would miss
    y = np.concatenate([y, signed(np.full(1000, 0.1)), [3.0]])
    x = np.concatenate([x, 0.1 * np.arange(2000), [-1e-20]])
    quotient, rest = elementwise("floor_divide")(x, y), elementwise("modulo")(x, y)
    np.testing.assert_array_equal(quotient, np.floor_divide(x, y))
    np.testing.assert_array_equal(rest, np.mod(x, y))


def test_a_fused_multiplication_rounds_once():
    a = 1 + 2.0**-30

    @njit
    def lost(a):
        return fma(a, a, -(a * a))

    assert lost(a) == 2.0**-60


def test_a_polynomial_begins_with_its_highest_power():
    coefficients = (2.0, 3.0, 5.0)
    assert njit(lambda x: polynomial(x, coefficients))(10.0) == 235.0


# The second derivative of log Γ in machine code.


def test_it_is_that_of_scipy():
    x = np.concatenate([np.geomspace(1e-8, 1e8, 200), -np.arange(0.05, 4.0, 0.1), [9.999, 10.0]])
    np.testing.assert_allclose([trigamma(v) for v in x], polygamma(1, x), rtol=1e-13)
    assert np.isnan(trigamma(np.nan))
    assert trigamma(np.inf) == 0.0


def test_a_guide_of_counts_whose_shape_depends_on_the_state_is_machine_code():
    """It ran in Python. With hardly any noise the terms are those of a known state."""
    system = psf.StateSpaceModel(
        lambda x, q: [x[0] + 1e-6 * q[0]],
        process_noise=[[1.0]],
        observation_dist=lambda x: [pm.NegativeBinomial.dist(mu=3.0, alpha=pt.exp(x[0]))],
        initial_mean=[0.5],
        initial_cov=[[1e-12]],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        terms = psf.log_likelihood(system, psf.GuidedPF(50), {}, [2.0, 5.0], steps=[1, 2])
    exact = pm.logp(pm.NegativeBinomial.dist(mu=3.0, alpha=np.exp(0.5)), np.array([2.0, 5.0]))
    assert terms == pytest.approx(exact.eval(), abs=1e-4)


# The order of keys against NumPy's stable one.


@njit
def order_of(keys):
    return stable_order(keys)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 7, 8, 9, 100])
def test_equal_keys_keep_their_order(n):
    for keys in (np.random.default_rng(n).integers(0, 4, n), -np.arange(n), np.arange(n)):
        np.testing.assert_array_equal(order_of(keys), np.argsort(keys, kind="stable"))
