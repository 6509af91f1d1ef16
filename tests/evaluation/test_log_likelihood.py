"""Log-likelihoods of a record: timing, missing data, densities of every kind, batches."""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy import stats

import pymc_statespace_filters as psf
from pymc_statespace_filters.testing import kalman_log_likelihood


def walk(**changes):
    arguments = dict(
        transition=lambda x, q, a: [a * x[0] + q[0]],
        process_noise=lambda s: [[s]],
        observation=lambda x: [x[0]],
        observation_noise=[[0.5]],
        initial_mean=[0.2],
        initial_cov=[[1.0]],
    )
    arguments = {k: v for k, v in (arguments | changes).items() if v is not ...}
    return psf.StateSpaceModel(**arguments)


POINT = {"a": 0.9, "s": 0.3}
STEPS = [0, 2, 3, 7]
RECORD = [0.4, np.nan, -0.2, 1.1]


def kalman(a=0.9, s=0.3, record=RECORD, **changes):
    given = dict(steps=STEPS, observed=record) | changes
    return kalman_log_likelihood([[a]], [[s]], [[1.0]], [[0.5]], [0.2], [[1.0]], **given)


def test_terms_are_those_of_the_kalman_filter_and_a_missing_row_is_zero():
    terms = psf.log_likelihood(walk(), psf.EKF(), POINT, RECORD, steps=STEPS)
    np.testing.assert_allclose(terms, kalman(), rtol=1e-12)
    assert terms[1] == 0.0


def test_inputs_and_time_hold_during_their_step():
    system = walk(
        transition=lambda x, q, u, t, a: [a * x[0] + u[0] + t + q[0]], inputs=["force"], dt=0.5
    )
    inputs = np.arange(1.0, 8.0)
    forcing = (inputs + 2.0 + 0.5 * np.arange(7))[:, None]
    terms = psf.log_likelihood(system, psf.EKF(), POINT, RECORD, steps=STEPS, inputs=inputs, t0=2.0)
    np.testing.assert_allclose(terms, kalman(forcing=forcing), rtol=1e-12)


def test_an_observation_sees_the_inputs_of_its_own_step():
    system = walk(observation=lambda x, u, t: [x[0] + u[0] + 10 * t], inputs=["offset"])
    inputs = np.arange(1.0, 9.0)  # d(J) + 1 rows
    shifted = np.array(RECORD) + inputs[STEPS] + 10 * np.array(STEPS)
    for filter in (psf.EKF(), psf.EnKF(30)):
        plain = psf.log_likelihood(walk(), filter, POINT, RECORD, steps=STEPS)
        terms = psf.log_likelihood(system, filter, POINT, shifted, steps=STEPS, inputs=inputs)
        np.testing.assert_allclose(terms, plain, rtol=1e-9, atol=1e-9)


def test_general_noise_is_d_gamma_d():
    system = walk(
        observation=lambda x, e: [x[0] * pt.exp(e[0]) + e[1]],
        observation_noise=[[0.04, 0.0], [0.0, 0.3]],
        initial_mean=[2.0],
        initial_cov=[[0.0]],
    )
    (term,) = psf.log_likelihood(system, psf.EKF(), POINT, [2.5], steps=[0])
    # D = (x exp(0), 1) at x = 2
    assert term == pytest.approx(stats.norm(2.0, np.sqrt(4 * 0.04 + 0.3)).logpdf(2.5), rel=1e-12)


def test_counts_have_the_density_of_scipy():
    system = walk(
        observation=..., observation_noise=..., initial_cov=[[0.0]], initial_mean=[0.3],
        observation_dist=lambda x, c: [
            pm.Poisson.dist(mu=pt.exp(c + x[0])), pm.Normal.dist(x[0], 0.5),
        ],
    )  # fmt: skip
    point = POINT | {"c": 1.0}
    true = stats.poisson(np.exp(1.3)).logpmf(4) + stats.norm(0.3, 0.5).logpdf(0.1)
    for filter in (psf.BootstrapPF(10), psf.PFEnKF(10)):
        (term,) = psf.log_likelihood(system, filter, point, [[4.0, 0.1]], steps=[0])
        assert term == pytest.approx(true, rel=1e-12)
    with pytest.warns(psf.errors.FilterWarning, match="y0 = 4.5 is no whole number, and its"):
        (term,) = psf.log_likelihood(system, psf.BootstrapPF(10), point, [[4.5, 0.1]], steps=[0])
    assert term == -np.inf
    count, place = stats.poisson(np.exp(1.3)).logpmf(4), stats.norm(0.3, 0.5).logpdf(0.1)
    for row, density in (([np.nan, 0.1], place), ([4.0, np.nan], count)):
        (term,) = psf.log_likelihood(system, psf.BootstrapPF(10), point, [row], steps=[0])
        assert term == pytest.approx(density, rel=1e-12)


def test_a_density_of_the_users_own():
    system = walk(
        observation=..., observation_noise=..., initial_cov=[[0.0]],
        observation_logp=lambda d, x, b: -abs(d[0] - x[0]) / b - pt.log(2 * b),
    )  # fmt: skip
    (term,) = psf.log_likelihood(system, psf.BootstrapPF(10), POINT | {"b": 0.7}, [1.0], steps=[0])
    assert term == pytest.approx(stats.laplace(0.2, 0.7).logpdf(1.0), rel=1e-12)


# Batches


def test_parameters_and_seeds_broadcast_and_equal_a_loop():
    a, s, seeds = np.array([[0.5], [0.9]]), np.array([0.1, 0.3, 0.6]), np.arange(3)
    filter = psf.EnKF(30)
    batch = psf.log_likelihood(walk(), filter, {"a": a, "s": s}, RECORD, steps=STEPS, seed=seeds)
    assert batch.shape == (2, 3, 4)
    for i in range(2):
        for j in range(3):
            one = psf.log_likelihood(
                walk(), filter, {"a": a[i, 0], "s": s[j]}, RECORD, steps=STEPS, seed=int(seeds[j])
            )
            assert (one == batch[i, j]).all()
    assert psf.log_likelihood(walk(), psf.EKF(), POINT, RECORD, steps=STEPS).shape == (4,)
    by_seed = psf.log_likelihood(walk(), filter, POINT, RECORD, steps=STEPS, seed=np.arange(5))
    assert by_seed.shape == (5, 4)
    assert np.unique(by_seed.sum(1)).size == 5


def test_parameters_with_shapes_broadcast_in_front():
    system = walk(transition=lambda x, q, k: [k[0] * x[0] + k[1] + q[0]], shapes={"k": (2,)})
    k = np.array([[0.9, 0.0], [0.5, 0.1], [0.1, 0.2]])
    batch = psf.log_likelihood(system, psf.EKF(), {"k": k, "s": 0.3}, RECORD, steps=STEPS)
    assert batch.shape == (3, 4)
    np.testing.assert_allclose(batch[0], kalman(), rtol=1e-12)


def test_the_seed_is_noise_of_the_filter_alone():
    seeds = np.arange(4)
    exact = psf.log_likelihood(walk(), psf.EKF(), POINT, RECORD, steps=STEPS, seed=seeds)
    assert (exact == exact[0]).all()
    once = psf.log_likelihood(walk(), psf.BootstrapPF(50), POINT, RECORD, steps=STEPS, seed=7)
    again = psf.log_likelihood(walk(), psf.BootstrapPF(50), POINT, RECORD, steps=STEPS, seed=7)
    assert (once == again).all()


def test_one_warning_counts_what_failed_in_a_batch():
    with pytest.warns(
        psf.errors.FilterWarning, match="-inf in 2 of 3 evaluations, first in row 2"
    ) as caught:
        terms = psf.log_likelihood(
            walk(), psf.EKF(), {"a": [0.9, 1e200, 1e250], "s": 0.3}, RECORD, steps=STEPS
        )
    assert len(caught) == 1
    assert np.isfinite(terms[0]).all()
    assert (terms[1:, -1] == -np.inf).all()


def test_one_warning_for_collapsed_particles():
    record = np.full(4, 20.0)
    with pytest.warns(
        psf.errors.FilterWarning, match="fewer than 3 particles .* in 2 of 2"
    ) as caught:
        psf.log_likelihood(walk(), psf.BootstrapPF(50), POINT, record, steps=STEPS, seed=[1, 2])
    assert len(caught) == 1


def test_defaults_are_used_and_can_be_overridden():
    system = walk(transition=lambda x, q, a=0.9: [a * x[0] + q[0]])
    by_default = psf.log_likelihood(system, psf.EKF(), {"s": 0.3}, RECORD, steps=STEPS)
    np.testing.assert_allclose(by_default, kalman(), rtol=1e-12)
    given = psf.log_likelihood(system, psf.EKF(), {"s": 0.3, "a": 0.5}, RECORD, steps=STEPS)
    np.testing.assert_allclose(given, kalman(a=0.5), rtol=1e-12)


def test_threads_may_evaluate_at_once():
    """The arguments of a call are its own: else a hundredth of these calls fail or mix records.

    So that one test in three thousand would not notice.
    """
    system, interval = walk(), sys.getswitchinterval()

    def terms(a):
        record, steps = RECORD[: 2 + a % 3], STEPS[: 2 + a % 3]
        return psf.log_likelihood(system, psf.EKF(), POINT | {"a": 0.1 * a}, record, steps=steps)

    alone = [terms(a) for a in range(4)]
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            together = list(pool.map(terms, [0, 1, 2, 3] * 200))
    finally:
        sys.setswitchinterval(interval)
    for a, result in enumerate(together):
        np.testing.assert_array_equal(result, alone[a % 4])
