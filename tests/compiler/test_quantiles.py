"""Quantile functions of a standard normal: exact against extended precision."""

from functools import cache

import numpy as np
import pytest
from numba import njit
from scipy import special

from pymc_statespace_filters.compiler.codegen.emitter import QUANTILES
from pymc_statespace_filters.compiler.codegen.members import BLOCKS
from pymc_statespace_filters.compiler.numerics.normals import fill_normals
from pymc_statespace_filters.compiler.numerics.quantiles.binomial import exact_binomial
from pymc_statespace_filters.compiler.numerics.quantiles.poisson import exact_poisson
from pymc_statespace_filters.system import quantiles
from tests.references import count_laws

N = 1_000_000
MEANS = (0.001, 0.1, 0.7, 2.99, 3.0, 5.0, 7.999, 8.0, 9.3, 20.0, 74.2, 333.0, 1e4, 2e5)
TRIALS = (
    (1, 0.3), (5, 0.5), (16, 0.5), (17, 0.47), (10, 0.99), (50, 0.92), (100, 0.0799), (100, 0.081),
    (1000, 0.5), (12345, 0.9999), (1e6, 1e-6), (1e6, 0.1), (1e9, 1e-8), (1e9, 3e-5),
)  # fmt: skip
HUGE_MEANS = (9.99e5, 1.001e6, 2865033.952834834, 3e7)
HUGE_TRIALS = ((4e6, 0.4), (1e9, 0.002), (1e9, 0.02))
SLOW = pytest.mark.slow
SHAPES = (1e-6, 1e-3, 0.05, 0.3, 1.0, 1.999, 2.001, 4.0, 7.999, 8.001, 20.0, 150.0, 1e4)
OPS = {
    "poisson_quantile": quantiles.PoissonQuantile(),
    "binomial_quantile": quantiles.BinomialQuantile(),
    "bernoulli_quantile": quantiles.BernoulliQuantile(),
    "gamma_quantile": quantiles.GammaQuantile(),
    "normal_probability": quantiles.NormalProbability(),
}


@cache
def scalar(name):
    """The compiled function of numbers, as one of arrays."""
    arguments = [f"a{i}" for i in range(OPS[name].nin)]
    elements = ", ".join(f"{a}[i]" for a in arguments)
    source = f"""
def apply(out, {", ".join(arguments)}):
    for i in range(out.size):
        out[i] = function({elements})
"""
    scope = {"function": QUANTILES[name]}
    exec(source, scope)
    return called(njit(error_model="numpy")(scope["apply"]))


@cache
def in_blocks(name):
    """The vector code, as a function of arrays."""
    n = OPS[name].nin
    arguments = [f"a{i}" for i in range(n)]
    fill = "\n".join(
        f"            buffer[{i}, j] = {a}[first + j]" for i, a in enumerate(arguments)
    )
    rows = ", ".join(f"np.uint64({i})" for i in range(n + 1))
    source = f"""
def apply(out, {", ".join(arguments)}):
    buffer = np.empty(({n + 1}, 64))
    for first in range(0, out.size, 64):
        size = min(64, out.size - first)
        for j in range(size):
{fill}
        block(buffer, {rows}, size)
        for j in range(size):
            out[first + j] = buffer[{n}, j]
"""
    scope = {"block": BLOCKS[name], "np": np}
    exec(source, scope)
    return called(njit(error_model="numpy")(scope["apply"]))


def called(apply):
    def call(*arguments):
        arrays = [np.ascontiguousarray(a, float) for a in np.broadcast_arrays(*arguments)]
        out = np.empty(arrays[0].size)
        apply(out, *arrays)
        return out

    return call


FORMS = pytest.mark.parametrize("form", [scalar, in_blocks])


@pytest.fixture(scope="module")
def normals():
    Z = np.empty((2, N + 64 - N % 64))
    fill_normals(7, np.uint64(3), 11, Z)
    return Z[:, :N]


def delicate(law):
    """Normals on a grid, and close to those at which the quantile jumps."""
    rng = np.random.default_rng(0)
    grid = np.linspace(-8.5, 8.5, 401)
    lower, upper = law.lower.astype(float), law.upper.astype(float)
    with np.errstate(divide="ignore"):
        jumps = np.where(lower < 0.5, special.ndtri(lower), -special.ndtri(upper))
    jumps = jumps[abs(jumps) < 8.0]
    jumps = jumps[np.linspace(0, len(jumps) - 1, min(len(jumps), 400)).astype(int)]
    offsets = 10.0 ** rng.uniform(-9, -1, (4, len(jumps))) * [[1.0], [1.0], [-1.0], [-1.0]]
    return np.concatenate([grid, (jumps + offsets * np.minimum(1.0, 1 / law.sd)).ravel()])


def agrees(form, name, law, parameters):
    z = delicate(law)
    expected, close = law.quantiles(z)
    assert close.mean() < 0.05  # normals at which rounding of Φ(z) decides
    got = form(name)(z, *parameters)
    np.testing.assert_array_equal(got[~close], expected[~close])


@FORMS
@pytest.mark.parametrize("mean", [*MEANS, *(pytest.param(m, marks=SLOW) for m in HUGE_MEANS)])
def test_poisson_quantiles_are_exact(form, mean):
    agrees(form, "poisson_quantile", count_laws.poisson(mean), (mean,))


@FORMS
@pytest.mark.parametrize(
    ("n", "p"), [*TRIALS, *(pytest.param(*t, marks=SLOW) for t in HUGE_TRIALS)]
)
def test_binomial_quantiles_are_exact(form, n, p):
    agrees(form, "binomial_quantile", count_laws.binomial(n, p), (n, p))


def test_what_the_vector_code_decides_is_what_exact_probabilities_decide(normals):
    """Parameters change from member to member, so that a block has all sorts of them."""
    rng = np.random.default_rng(1)
    z, mean = 1.5 * normals[0, :50_000], 10.0 ** rng.uniform(-3, 3, 50_000)
    n, p = np.ceil(10.0 ** rng.uniform(0, 4, 50_000)), rng.uniform(0, 1, 50_000) ** 2
    by_two, by_three = njit(lambda z, m: exact_poisson(z, m)), njit(lambda *a: exact_binomial(*a))
    for name, exact, arguments in (
        ("poisson_quantile", by_two, (z, mean)),
        ("binomial_quantile", by_three, (z, n, p)),
    ):
        expected = [exact(*row) for row in zip(*arguments, strict=True)]
        np.testing.assert_array_equal(in_blocks(name)(*arguments), expected)
        np.testing.assert_array_equal(scalar(name)(*arguments), expected)


@FORMS
@pytest.mark.parametrize("shape", SHAPES)
def test_gamma_quantiles_are_right_to_nine_digits(form, shape):
    z = np.linspace(-8.0, 8.0, 801)
    got = form("gamma_quantile")(z, shape, 2.0)
    lower, upper = special.ndtr(z), special.ndtr(-z)
    expected = 2.0 * np.where(
        z < 0.0, special.gammaincinv(shape, lower), special.gammainccinv(shape, upper)
    )
    shown = expected > 1e-290
    np.testing.assert_allclose(got[shown], expected[shown], rtol=2e-9)
    assert (got[~shown] < 1e-280).all()


@pytest.mark.parametrize("shape", [30.0, 1000.0, 40_000.0, 1_000_000.0])
def test_gamma_quantiles_have_the_poisson_probabilities(shape):
    """P(X > x) is the probability of less than ``shape`` Poisson events of mean x."""
    for z in (-6.5, -2.0, 0.3, 6.0):
        (x,) = scalar("gamma_quantile")(np.array([z]), shape, 1.0)
        law = count_laws.poisson(x)
        i = int(shape - 1.0 - law.first)
        tail, sought = (
            (law.upper[i], special.ndtr(z)) if z < 0 else (law.lower[i], special.ndtr(-z))
        )
        assert float(tail) == pytest.approx(sought, rel=1e-7)


@FORMS
@pytest.mark.parametrize("name", ["poisson_quantile", "gamma_quantile"])
@pytest.mark.parametrize("parameter", [0.4, 1.99, 3.0, 7.999, 8.0, 25.0, 1e3, 1e6, 1e12])
def test_quantiles_grow_with_the_normal(form, name, parameter):
    z = np.linspace(-8.5, 8.5, 20_001)
    x = form(name)(z, parameter, *([1.0] if name == "gamma_quantile" else []))
    assert (np.diff(x) >= 0.0).all()


@FORMS
@pytest.mark.parametrize(("n", "p"), [(3, 0.5), (40, 0.2), (40, 0.8), (1e5, 0.3), (1e9, 0.7)])
def test_binomial_quantiles_grow_with_the_normal(form, n, p):
    x = form("binomial_quantile")(np.linspace(-8.5, 8.5, 20_001), n, p)
    assert (np.diff(x) >= 0.0).all()
    assert x.min() >= 0.0
    assert x.max() <= n


def test_bernoulli_draws_and_probabilities(normals):
    for p in (0.003, 0.5, 0.97):
        draws = scalar("bernoulli_quantile")(normals[0], p)
        assert set(draws) == {0.0, 1.0}
        assert abs(draws.mean() - p) < 5.0 * np.sqrt(p * (1.0 - p) / N)
    z = np.array([-8.0, -1.0, 0.0, 2.0, 8.0])
    np.testing.assert_allclose(scalar("normal_probability")(z), special.ndtr(z), rtol=1e-14)


EDGES = {
    "poisson_quantile": [(0.3, 0.0, 0.0), (8.0, 0.0, 0.0), (-np.inf, 5.0, 0.0)],
    "binomial_quantile": [
        (1.0, 0.0, 0.3, 0.0), (1.0, 7.0, 0.0, 0.0), (-1.0, 7.0, 1.0, 7.0), (np.inf, 7.0, 0.3, 7.0),
        (5.0, 1e9, 0.0, 0.0), (-np.inf, 40.0, 0.5, 0.0),
    ],
    "bernoulli_quantile": [(9.0, 0.0, 0.0), (-9.0, 1.0, 1.0), (0.3, 0.5, 1.0), (-0.3, 0.5, 0.0)],
    "gamma_quantile": [(1.0, 2.0, 0.0, 0.0), (-37.0, 1e-6, 1.0, 0.0)],
}  # fmt: skip
INVALID = {
    "poisson_quantile": [(0.0, -1.0), (0.0, np.nan), (0.0, np.inf), (np.nan, 1.0)],
    "binomial_quantile": [
        (0.0, -1.0, 0.5), (0.0, 2.5, 0.5), (0.0, np.inf, 0.5), (0.0, 3.0, -1e-9),
        (0.0, 3.0, 1.0 + 1e-9), (0.0, 3.0, np.nan), (0.0, np.nan, 0.5), (np.nan, 3.0, 0.5),
        (0.0, 1e9, 1.5), (0.0, 1e9, -0.5),
    ],
    "bernoulli_quantile": [(0.0, -0.1), (0.0, 1.1), (0.0, np.nan), (np.nan, 0.5)],
    "gamma_quantile": [
        (0.0, 0.0, 1.0), (0.0, -1.0, 1.0), (0.0, np.inf, 1.0), (0.0, 1.0, -1.0),
        (0.0, 1.0, np.nan), (np.nan, 1.0, 1.0), (0.0, np.nan, 1.0),
    ],
    "normal_probability": [(np.nan,)],
}  # fmt: skip


@pytest.mark.parametrize("name", OPS)
def test_edges_are_exact_and_invalid_parameters_are_nan(name):
    forms = [scalar(name)] + ([in_blocks(name)] if name in BLOCKS else [])
    impl = OPS[name].impl
    for *arguments, expected in EDGES.get(name, ()):
        assert impl(*arguments) == expected
        for form in forms:
            assert form(*np.transpose([arguments])) == [expected]
    for arguments in INVALID[name]:
        assert np.isnan(impl(*arguments))
        for form in forms:
            assert np.isnan(form(*np.transpose([arguments]))).all(), arguments
