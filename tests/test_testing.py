"""The exact Kalman likelihood against the joint normal density of all observations at once."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references.records import OSCILLATOR, oscillator_with_gaps


def joint_log_density(A, Q, C, R, m0, P0, steps, observed, forcing):
    """log N(all seen components; mean, covariance): no recursion over updates."""
    n_steps = steps[-1] + 1
    mean, cov = [np.asarray(m0)], [np.asarray(P0)]
    for k in range(n_steps - 1):
        mean.append(A @ mean[-1] + forcing[k])
        cov.append(A @ cov[-1] @ A.T + Q)

    def state_cov(k, m):  # Cov(x_k, x_m), k >= m
        return np.linalg.matrix_power(A, k - m) @ cov[m]

    p = len(C)
    joint_mean = np.concatenate([C @ mean[k] for k in steps])
    joint_cov = np.empty((p * len(steps), p * len(steps)))
    for i, k in enumerate(steps):
        for j, m in enumerate(steps):
            block = state_cov(k, m) if k >= m else state_cov(m, k).T
            joint_cov[p * i : p * (i + 1), p * j : p * (j + 1)] = C @ block @ C.T + (i == j) * R
    seen = ~np.isnan(observed.ravel())
    return multivariate_normal.logpdf(
        observed.ravel()[seen], joint_mean[seen], joint_cov[np.ix_(seen, seen)]
    )


STEPS, OBSERVED = oscillator_with_gaps()
FORCING = np.random.default_rng(1).normal(size=(STEPS[-1], 2))
ARGUMENTS = OSCILLATOR.kalman_arguments()


def test_terms_sum_to_joint_density_with_gaps_forcing_and_singular_process_noise():
    terms = kalman_log_likelihood(*ARGUMENTS, steps=STEPS, observed=OBSERVED, forcing=FORCING)
    truth = joint_log_density(*ARGUMENTS, STEPS, OBSERVED, FORCING)
    assert terms.sum() == pytest.approx(truth, rel=1e-10)


def test_each_term_is_a_difference_of_joint_densities():
    terms = kalman_log_likelihood(*ARGUMENTS, steps=STEPS, observed=OBSERVED, forcing=FORCING)
    joint = [
        joint_log_density(*ARGUMENTS, STEPS[: j + 1], OBSERVED[: j + 1], FORCING)
        for j in range(len(STEPS))
    ]
    np.testing.assert_allclose(terms, np.diff(joint, prepend=0.0), atol=1e-10)
    wholly_missing = np.isnan(OBSERVED).all(axis=1)
    assert wholly_missing.any()
    assert (terms[wholly_missing] == 0.0).all()


@pytest.mark.parametrize("first", [0, 3])
def test_known_start_and_first_observation_at_step_zero_or_later(first):
    A, Q, C, R, m0, _ = ARGUMENTS
    arguments = A, Q, C, R, m0, np.zeros((2, 2))
    steps = STEPS + first
    forcing = np.zeros((steps[-1], 2))
    terms = kalman_log_likelihood(*arguments, steps=steps, observed=OBSERVED)
    truth = joint_log_density(*arguments, steps, OBSERVED, forcing)
    assert terms.sum() == pytest.approx(truth, rel=1e-10)


def test_scalar_record_may_be_a_vector():
    arguments = [[0.9]], [[0.2]], [[1.5]], [[0.3]], [0.4], [[0.7]]
    steps, observed = np.array([0, 1, 5]), np.array([0.2, np.nan, -0.8])
    terms = kalman_log_likelihood(*arguments, steps=steps, observed=observed)
    truth = joint_log_density(
        *(np.array(a) for a in arguments), steps, observed[:, None], np.zeros((5, 1))
    )
    assert terms.sum() == pytest.approx(truth, rel=1e-10)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": [0, 2, 2]}, "strictly increasing"),
        ({"steps": [-1, 0, 1]}, "non-negative"),
        ({"steps": [0.0, 1.0, 2.0]}, "integers"),
        ({"observed": np.zeros((2, 2))}, r"observed must have shape \(3, 2\), got \(2, 2\)"),
        ({"forcing": np.zeros((1, 2))}, "at least 2 rows of 2"),
        ({"process_cov": np.eye(3)}, r"process_cov must have shape \(2, 2\), got \(3, 3\)"),
    ],
)
def test_wrong_shapes_are_named(change, message):
    names = (
        "transition_matrix process_cov observation_matrix observation_cov initial_mean initial_cov"
    )
    arguments = dict(zip(names.split(), ARGUMENTS, strict=True))
    arguments |= {"steps": [0, 1, 2], "observed": np.zeros((3, 2))}
    with pytest.raises(ModelError, match=message):
        kalman_log_likelihood(**(arguments | change))
