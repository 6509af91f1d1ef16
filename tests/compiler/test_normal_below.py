"""The moments of a standard normal below a limit, in both tails, against extended precision."""

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from numba import njit
from scipy import special

from pymc_statespace_filters.compiler.codegen.emitter import INLINED
from pymc_statespace_filters.system import normal_below

FUNCTIONS = {
    "normal_log_probability": normal_below.log_probability,
    "normal_hazard": normal_below.hazard,
    "normal_excess": normal_below.excess,
    "normal_variance_below": normal_below.variance,
}
# z, log Φ, φ / Φ, z + φ / Φ, and the variance below z; computed with 900 digits.
TABLE = np.array([
    (-1000000.0, -500000000014.73445, 1000000.000001, 9.99999999998e-7, 9.99999999994e-13),
    (-40.0, -804.60844201375379, 40.024968847207264, 0.024968847207263723, 0.00062266837859138877),
    (-12.5, -81.575967870743883, 12.579007304406976, 0.079007304406976089, 0.0061665407631423027),
    (-4.0, -10.360101486527291, 4.2256071444894711, 0.22560714448947107, 0.046672838397422631),
    (-3.0, -6.6077262215103495, 3.2830986549304365, 0.28309865493043651, 0.070559186785268117),
    (-2.0, -3.7831843336820319, 2.3732155328228409, 0.37321553282284087, 0.11427910041408126),
    (-0.5, -1.1759117615936186, 1.1410777703680645, 0.64107777036806448, 0.26848040715587895),
    (0.0, -0.69314718055994531, 0.79788456080286536, 0.79788456080286536, 0.36338022763241866),
    (0.3, -0.4814101615884812, 0.61722085361273444, 0.91722085361273444, 0.43387216178174711),
    (2.0, -0.023012909328963488, 0.055247862678989959, 2.05524786267899, 0.88645194831142355),
    (6.5, -4.0160005839397591e-11, 2.6695566148700613e-10, 6.5000000002669557, 0.9999999982647882),
    (20.0, -2.7536241186062337e-89, 5.5209483621597632e-88, 20.0, 1.0),
    (37.0, -5.7255712225245768e-300, 2.1200065515246056e-298, 37.0, 1.0),
])  # fmt: skip
# z, and the derivatives of the four, by differences with 900 digits.
SLOPES = np.array([
    (-40.0, 40.024968847207, -0.99937733162141, 0.00062266837859139, 3.1017440396486e-5),
    (-12.5, 12.579007304407, -0.99383345923686, 0.0061665407631423, 0.00095114134127408),
    (-4.0, 4.2256071444895, -0.95332716160258, 0.046672838397423, 0.017856339307658),
    (-3.0, 3.2830986549304, -0.92944081321473, 0.070559186785268, 0.031470672830842),
    (-2.0, 2.3732155328228, -0.88572089958592, 0.11427910041408, 0.059355861291566),
    (-0.5, 1.1410777703681, -0.73151959284412, 0.26848040715588, 0.16260392517612),
    (0.0, 0.79788456080287, -0.63661977236758, 0.36338022763242, 0.21801361414499),
    (0.3, 0.61722085361273, -0.56612783821825, 0.43387216178175, 0.25146931297075),
    (2.0, 0.05524786267899, -0.11354805168858, 0.88645194831142, 0.18439481503248),
    (6.5, 2.6695566148701e-10, -1.7352117997368e-9, 0.99999999826479, 1.1011921037729e-8),
    (20.0, 5.5209483621598e-88, -1.104189672432e-86, 1.0, 2.2028583965017e-85),
    (37.0, 2.1200065515246e-298, -7.844024240641e-297, 1.0, 2.9001689624857e-295),
])  # fmt: skip
Z = np.concatenate([np.linspace(-40, 38, 2000), np.linspace(-1, 1, 200)])


@pytest.fixture(scope="module")
def machine_code():
    """The four functions of a vector."""
    parts = [INLINED[name] for name in FUNCTIONS]
    scope = {f"f{i}": part for i, part in enumerate(parts)}
    lines = [f"        out[{i}, j] = f{i}(z[j])" for i in range(4)]
    exec("\n".join(["def apply(z, out):", "    for j in range(z.size):", *lines]), scope)
    apply = njit(error_model="numpy")(scope["apply"])

    def call(z):
        out = np.empty((4, len(z)))
        apply(np.asarray(z, float), out)
        return out

    return call


def test_machine_code_has_all_digits_in_both_tails(machine_code):
    np.testing.assert_allclose(machine_code(TABLE[:, 0]).T, TABLE[:, 1:], rtol=3e-15)


def test_machine_code_agrees_with_scipy_between_the_points_of_the_table(machine_code):
    log_p, hazard, excess, variance = machine_code(Z)
    np.testing.assert_allclose(log_p, special.log_ndtr(Z), rtol=1e-12, atol=1e-300)
    expected = np.sqrt(2 / np.pi) / special.erfcx(-Z / np.sqrt(2))
    np.testing.assert_allclose(hazard, expected, rtol=1e-12, atol=1e-300)
    # Laplace's continued fraction where differences cancel
    rest = np.zeros_like(Z)
    for k in range(300, 1, -1):
        rest = k / (np.maximum(-Z, 2.0) + rest)
    far = Z < -2.0
    fraction = 1.0 / (rest - Z)
    np.testing.assert_allclose(excess, np.where(far, fraction, Z + expected), rtol=1e-12)
    expected = np.where(far, fraction * (rest - fraction), 1.0 - expected * (Z + expected))
    np.testing.assert_allclose(variance, expected, rtol=1e-12)


def test_edges(machine_code):
    found = machine_code([np.nan, np.inf, -np.inf])
    assert np.isnan(found[:, 0]).all()
    assert list(found[:, 1]) == [0.0, 0.0, 1e100, 1.0]
    assert found[0, 2] == -np.inf
    assert np.isfinite(found[1:, 2]).all()


def test_the_slow_form_has_the_same_digits():
    for z, *expected in TABLE:
        found = [function.scalar_op.impl(z) for function in FUNCTIONS.values()]
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_derivatives_are_those_of_differences_with_900_digits():
    z = pt.dscalar()
    slopes = [pytensor.grad(function(z), z) for function in FUNCTIONS.values()]
    found = pytensor.function([z], slopes, mode="FAST_COMPILE")
    for at, *expected in SLOPES:
        np.testing.assert_allclose(found(at), expected, rtol=1e-10, atol=1e-290)
