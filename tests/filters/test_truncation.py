"""What a censored observation does to the Gaussian law of a state, against quadrature."""

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.tensor.linalg import cholesky, solve_triangular
from scipy import stats

from pymc_statespace_filters.filters.gaussian.censoring import truncate

MEASURED, BELOW, ABOVE = 0.0, -1.0, 1.0


@pytest.fixture(scope="module")
def conditioned():
    """Mean, covariance and term of x ~ N(0, P) given y = C x + e, by the observations in place."""
    residual, observed, flags = pt.dvectors("residual", "observed", "flags")
    residual, observed, flags = (pt.specify_shape(v, (2,)) for v in (residual, observed, flags))
    C, P, R = (pt.specify_shape(M, (2, 2)) for M in pt.dmatrices("C", "P", "R"))
    found = truncate(residual, C @ P @ C.T + R, observed, flags)
    S = C @ P @ C.T + R + pt.diag(found.more_noise)
    chol = cholesky(S, lower=True)
    half = solve_triangular(chol, C @ P, lower=True, b_ndim=2)
    gain = solve_triangular(chol.T, half, lower=False, b_ndim=2).T
    outputs = [gain @ found.residual, P - gain @ C @ P, found.term]
    inputs = [residual.owner.inputs[0], observed.owner.inputs[0], flags.owner.inputs[0]]
    inputs += [M.owner.inputs[0] for M in (C, P, R)]
    slopes = pytensor.grad(
        outputs[0].sum() + outputs[1].sum() + found.term, inputs[:1] + inputs[3:]
    )
    return pytensor.function(inputs, outputs + slopes, mode="FAST_COMPILE")


P = np.array([[1.3, 0.4], [0.4, 0.7]])
C = np.array([[1.0, -0.5], [0.3, 1.2]])
R = np.diag([0.3, 0.2])
BOTH = np.ones(2)


@pytest.mark.parametrize("flag", [BELOW, ABOVE])
@pytest.mark.parametrize("limit", [-9.0, -2.0, 0.3, 4.0])
def test_one_censored_value_leaves_the_moments_of_the_truncated_law(conditioned, flag, limit):
    only_first = np.array([1.0, 0.0])
    jac = C * only_first[:, None]
    mean, cov, term, *_ = conditioned(
        [limit, 0.0], only_first, [flag, 0.0], jac, P, np.diag([0.3, 1.0])
    )
    # Everything is a function of w = C_0 x, and sums converge at once for such smooth functions.
    s = C[0] @ P @ C[0]
    w = np.linspace(-16, 16, 4001) * s**0.5
    weight = stats.norm.pdf(w, 0, s**0.5) * stats.norm.cdf(flag * (w - limit) / 0.3**0.5)
    total, first, second = (np.sum(w**k * weight) * (w[1] - w[0]) for k in range(3))
    m, v = first / total, second / total - (first / total) ** 2
    along = P @ C[0] / s
    np.testing.assert_allclose(term, np.log(total), rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(mean, along * m, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(cov, P + np.outer(along, along) * (v - s), rtol=1e-10)


def truncated(m, v, d, flag):
    z = flag * (m - d) / v**0.5
    h = stats.norm.pdf(z) / stats.norm.cdf(z)
    return m + flag * v**0.5 * h, v * (1 - h * (z + h)), stats.norm.logcdf(z)


def one_by_one(residual, flags, C, P, R):
    """The rule of order as it is written: joint moments of (x, y), one row after the other."""
    n = len(P)
    joint = np.block([[P, P @ C.T], [C @ P, C @ P @ C.T + R]])
    mean, term = np.zeros(2 * n), 0.0
    for i in sorted(range(2), key=lambda i: (flags[i] != 0, i)):
        m, v = mean[n + i], joint[n + i, n + i]
        if flags[i] == 0:
            new, left, log_p = residual[i], 0.0, stats.norm.logpdf(residual[i], m, v**0.5)
        else:
            new, left, log_p = truncated(m, v, residual[i], flags[i])
        gain = joint[:, n + i] / v
        mean = mean + gain * (new - m)
        joint = joint - np.outer(gain, joint[n + i]) * (1 - left / v)
        term += log_p
    return mean[:n], joint[:n, :n], term


@pytest.mark.parametrize(
    "flags", [(BELOW, MEASURED), (MEASURED, ABOVE), (ABOVE, BELOW), (BELOW, BELOW), (0.0, 0.0)]
)
@pytest.mark.parametrize("R", [R, np.array([[0.3, 0.1], [0.1, 0.2]])])
def test_measured_values_come_first_and_then_columns_in_order(conditioned, flags, R):
    residual = np.array([0.8, -1.1])
    found = conditioned(residual, BOTH, flags, C, P, R)[:3]
    for value, expected in zip(found, one_by_one(residual, flags, C, P, R), strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-11)


def test_a_limit_that_says_nothing_changes_nothing_and_has_a_derivative(conditioned):
    mean, cov, term, *slopes = conditioned([60.0, -60.0], BOTH, [BELOW, ABOVE], C, P, R)
    np.testing.assert_allclose(mean, 0.0, atol=1e-25)
    np.testing.assert_allclose(cov, P, rtol=1e-15)
    assert term == 0.0
    assert all(np.isfinite(slope).all() for slope in slopes)


@pytest.mark.parametrize("flags", [(BELOW, MEASURED), (ABOVE, BELOW), (MEASURED, MEASURED)])
@pytest.mark.parametrize("residual", [(0.8, -1.1), (14.0, -30.0)])
def test_the_gradient_is_that_of_differences(conditioned, flags, residual):
    arguments = [np.array(residual), C, P, R]
    step = 1e-5

    def total(arguments):
        found = conditioned(arguments[0], BOTH, flags, *arguments[1:])
        return found[0].sum() + found[1].sum() + found[2]

    slopes = conditioned(arguments[0], BOTH, flags, *arguments[1:])[3:]
    for k, slope in enumerate(slopes):
        for place in np.ndindex(slope.shape):
            sides = []
            for sign in (1, -1, 2, -2):
                moved = [a.copy() for a in arguments]
                moved[k][place] += sign * step
                sides.append(total(moved))
            difference = (8 * (sides[0] - sides[1]) - (sides[2] - sides[3])) / (12 * step)
            np.testing.assert_allclose(slope[place], difference, rtol=1e-6, atol=1e-8)
