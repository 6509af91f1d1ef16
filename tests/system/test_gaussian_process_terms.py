"""Bases of Gaussian processes: their functions, the kernel that they stand for, regression."""

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from scipy.spatial.distance import cdist
from scipy.stats import multivariate_normal

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.mechanics import gaussian_process_terms

pytestmark = pytest.mark.usefixtures("interpreted")

KERNELS = {
    "matern32": lambda r: (1 + np.sqrt(3) * r) * np.exp(-np.sqrt(3) * r),
    "matern52": lambda r: (1 + np.sqrt(5) * r + 5 * r**2 / 3) * np.exp(-np.sqrt(5) * r),
    "squared_exponential": lambda r: np.exp(-(r**2) / 2),
}


def test_functions_are_products_of_sines_that_vanish_at_the_boundary():
    basis = gaussian_process_terms(["v", "w"], [(-2, 2), (0, 2)], [2, 3])
    assert basis.names == ("v1 w1", "v1 w2", "v1 w3", "v2 w1", "v2 w2", "v2 w3")
    assert len(basis) == 6
    np.testing.assert_allclose(basis.boundary, [[-3, 3], [-0.5, 2.5]])
    v, w = 0.7, 1.2
    expected = [
        np.sin(np.pi * i * (v + 3) / 6) * np.sin(np.pi * j * (w + 0.5) / 3) / np.sqrt(3 * 1.5)
        for i in (1, 2)
        for j in (1, 2, 3)
    ]
    np.testing.assert_allclose(basis([v, w]).eval(), expected, rtol=1e-13)
    for edge in ([-3, w], [3, w], [v, -0.5], [v, 2.5]):
        np.testing.assert_allclose(basis(edge).eval(), 0, atol=1e-14)


def test_the_recurrence_has_the_values_of_sines_up_to_thirty():
    basis = gaussian_process_terms("z", (-2, 2), 30)
    x = pt.dscalar()
    at_one = pytensor.function([x], basis(x))
    grid = np.r_[np.linspace(-3.2, 3.2, 301), -3 + 10.0 ** np.arange(-12, 0)]
    one_by_one = np.transpose([at_one(z) for z in grid])
    assert np.abs(one_by_one - basis([grid]).eval()).max() < 1e-12


def test_many_states_have_their_shape():
    basis = gaussian_process_terms(["a", "b", "c"], [(-1, 1)] * 3, [2, 3, 2])
    x = np.random.default_rng(1).uniform(-1, 1, (3, 4, 2))
    values = basis(x).eval()
    assert values.shape == (12, 4, 2)
    np.testing.assert_allclose(values[:, 3, 1], basis(x[:, 3, 1]).eval(), atol=1e-14)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("lengths", [[0.4], [0.4, 0.6], [0.5, 0.6, 0.7]])
def test_functions_with_their_prior_are_the_kernel(kernel, lengths):
    """In the box, with an error that halves at least while the sines are doubled, to 2 %.

    Of the variance. The boundary is 2.25 away from the centre, the points lie within 1.
    """
    names = ["a", "b", "c"][: len(lengths)]
    x = np.random.default_rng(2).uniform(-1, 1, (len(names), 12))
    distances = cdist(x.T / lengths, x.T / lengths)
    right, symbol = KERNELS[kernel](distances), pt.vector(shape=(len(lengths),))
    errors = []
    for n in (5, 10, 20):
        basis = gaussian_process_terms(names, [(-1.5, 1.5)] * len(names), n, kernel=kernel)
        sd = basis.prior_sd(symbol, 1.7).eval({symbol: lengths})
        weighted = sd[:, None] * basis(x).eval()
        errors.append(np.abs(weighted.T @ weighted / 1.7**2 - right).max())
    assert errors[2] < 0.5 * errors[1] < 0.25 * errors[0]
    assert errors[2] < 0.02


def test_one_length_is_that_of_all_states_and_both_may_be_variables():
    basis = gaussian_process_terms(["v", "w"], [(-1, 1)] * 2, 12)
    length, amplitude = pt.dscalar(), pt.dscalar()
    symbolic = basis.prior_sd(length, amplitude).eval({length: 0.5, amplitude: 2.0})
    np.testing.assert_allclose(symbolic, basis.prior_sd([0.5, 0.5], 2.0).eval())
    for form in ({"shape": 2}, {"dims": "state"}):
        with pm.Model(coords={"term": basis.names, "state": basis.states}) as model:
            scale, length = pm.HalfNormal("scale", 1), pm.HalfNormal("length", 1, **form)
            pm.Normal("c", 0, basis.prior_sd(length, scale), dims="term")
        assert np.isfinite(model.compile_logp()(model.initial_point()))


def test_the_sines_hold_nine_tenths_of_the_variance_at_the_shortest_length():
    for kernel in KERNELS:
        basis = gaussian_process_terms("z", (-1, 1), 40, kernel=kernel)
        sd = basis.prior_sd(basis.shortest_length, 1.0).eval()
        variance = (sd[:, None] * basis([np.linspace(-0.5, 0.5, 101)]).eval()) ** 2
        assert variance.sum(axis=0).mean() == pytest.approx(0.9, abs=0.01)


def test_a_field_of_a_state_that_is_seen_is_bayesian_regression():
    """Without measurement noise the increments are a linear regression on known functions.

    The log-density is quadratic in the coefficients, so that gradients at unit vectors give its
    mode and curvature: the mean and the covariance of the posterior, and its integral.
    """
    h, noise, rng = 0.1, 0.3, np.random.default_rng(3)
    basis = gaussian_process_terms("z", (-2, 2), 8, kernel="matern52")
    z = [0.5]
    for _ in range(60):
        z.append(z[-1] + h * (z[-1] - z[-1] ** 3) + noise * np.sqrt(h) * rng.standard_normal())
    z, k = np.array(z), len(basis)
    prior_sd = basis.prior_sd(1.0, 2.0).eval()
    system = psf.StateSpaceModel(
        transition=psf.EulerMaruyama(lambda x, c: [c @ basis(x)], [[noise]], dt=h),
        observation=lambda x: [x[0]],
        observation_noise=[[0.0]],
        initial_mean=[0.0],
        initial_cov=[[1.0]],
        shapes={"c": (k,)},
    )
    with pm.Model() as model:
        pm.Normal("c", 0, prior_sd, shape=k)
        psf.StateSpace("y", system, psf.EKF(), steps=range(61), observed=z[:, None])
    density, slope = model.compile_logp(), model.compile_dlogp()

    at_zero = slope({"c": np.zeros(k)})
    precision = np.array([at_zero - slope({"c": row}) for row in np.eye(k)])
    mean = np.linalg.solve(precision, at_zero)
    log_evidence = density({"c": mean}) + 0.5 * k * np.log(2 * np.pi)
    log_evidence -= 0.5 * np.linalg.slogdet(precision)[1]

    half = 3.0  # of the domain
    numbers = np.arange(1, k + 1)[:, None]
    design = h * np.sin(np.pi * numbers * (z[:-1] + half) / (2 * half)).T / np.sqrt(half)
    right_precision = design.T @ design / (noise**2 * h) + np.diag(prior_sd**-2)
    right_mean = np.linalg.solve(right_precision, design.T @ np.diff(z) / (noise**2 * h))
    marginal = design @ np.diag(prior_sd**2) @ design.T + noise**2 * h * np.eye(60)
    right = multivariate_normal(np.zeros(60), marginal).logpdf(np.diff(z))
    right += multivariate_normal(0, 1).logpdf(z[0])
    np.testing.assert_allclose(precision, right_precision, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(mean, right_mean, rtol=1e-8)
    assert log_evidence == pytest.approx(right, abs=1e-8)


@pytest.mark.parametrize(
    ("states", "box", "n", "settings", "message"),
    [
        ([], [], 2, {}, "states must name at least one state, got"),
        (list("abcd"), [(0, 1)] * 4, 2, {}, "states must name at most 3 states, got"),
        ("v", (1, -1), 2, {}, r"box must hold \(low, high\) with low < high .* got \(1, -1\)"),
        (["v", "w"], (-1, 1), 2, {}, r"box must hold \(low, high\) .* \['v', 'w'\], got"),
        ("v", (-1, 1), 0, {}, "n must be an integer of at least 1, got 0"),
        ("v", (-1, 1), [2, 3], {}, r"n must be a number, or one for each of \['v'\], got \[2, 3\]"),
        ("v", (-1, 1), 3, {"kernel": "rbf"}, "kernel must be one of .*, got 'rbf'"),
    ],
)
def test_bad_bases_are_refused(states, box, n, settings, message):
    with pytest.raises(ModelError, match=message):
        gaussian_process_terms(states, box, n, **settings)


def test_bad_lengths_and_amplitudes_are_refused_and_the_advice_works():
    basis = gaussian_process_terms(["v", "w"], [(-1, 1), (-2, 2)], 5)
    with pytest.raises(ModelError, match=r"must be at least \[.*\], below .*take n=\[5, 9\]"):
        basis.prior_sd(0.5, 1.0)
    gaussian_process_terms(["v", "w"], [(-1, 1), (-2, 2)], [5, 9]).prior_sd(0.5, 1.0)
    with pytest.raises(ModelError, match=r"lengthscale must be a number or one for each of .*\(3,"):
        basis.prior_sd([1.0, 1.0, 1.0], 1.0)
    with pytest.raises(ModelError, match=r"lengthscale must be positive, got -1\.0"):
        basis.prior_sd(-1.0, 1.0)
    with pytest.raises(ModelError, match=r"amplitude must be positive, got 0\.0"):
        basis.prior_sd(2.0, 0.0)
    with pytest.raises(ModelError, match="amplitude must be a number, got 1 dimension"):
        basis.prior_sd(2.0, [1.0])
