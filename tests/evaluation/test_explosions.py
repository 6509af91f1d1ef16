"""Parameters that make the system explode give -inf and a reason, never NaN and never a crash."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihoodGradient
from pymc_statespace_filters.system.parameters import flat_parameters
from tests.systems import DOUBLE_WELL_SYSTEM

STEPS = [0, 10, 20, 40]
RECORD = [1.0, -0.5, np.nan, 0.8]
PARAMETERS = ("alpha", "beta", "sigma", "initial_var")
KNOWN = {"noise_var": 0.08, "initial_mean": 1.0}


def test_the_gradient_of_an_explosion_is_finite():
    gradient = evaluator(LogLikelihoodGradient(DOUBLE_WELL_SYSTEM, psf.EKF()))
    rest = (
        np.array(STEPS), np.array(RECORD)[:, None], np.zeros((0, 0)), np.array(0.0), np.array(0),
        np.ones(len(STEPS)),
    )  # fmt: skip
    for point in ([1e6, -1.0, 0.5, 0.5], [4.0, 100.0, 0.5, 0.5], [4.0, -4.0, 0.0, 0.0]):
        theta = flat_parameters(
            DOUBLE_WELL_SYSTEM, KNOWN | dict(zip(PARAMETERS, point, strict=True))
        )
        assert np.isfinite(gradient(theta, *rest)).all()


@pytest.mark.parametrize("filter", [psf.EKF(), psf.UKF()], ids=lambda f: type(f).__name__)
def test_a_covariance_that_no_observation_depends_on_must_exist(filter):
    """Its NaN stay in the state that nobody observes; members and particles fail there."""
    system = psf.StateSpaceModel(
        transition=lambda x, q: [0.9 * x[0] + q[0], 0.8 * x[1] + q[1]],
        process_dist=lambda r: [pm.MvNormal.dist(np.zeros(2), pt.stacklists([[1.0, r], [r, 1.0]]))],
        observation=lambda x: [x[0]],
        observation_noise=[[0.1]],
        initial_mean=[0.0, 0.0],
        initial_cov=np.eye(2),
    )
    record = {"observed": [0.5, np.nan, -0.3], "steps": [0, 1, 2]}
    with pytest.warns(psf.errors.FilterWarning, match="-inf in 1 of 2"):
        terms = psf.log_likelihood(system, filter, {"r": [0.5, 2.0]}, **record)
    with pytest.warns(psf.errors.FilterWarning, match="gave -inf in row 2"):
        alone = psf.log_likelihood(system, filter, {"r": 2.0}, **record)
    with pytest.warns(psf.errors.FilterWarning, match="gave -inf in row 2"):
        run = psf.run_filter(system, filter, {"r": 2.0}, **record)
    panel = {
        "panel": [0, 0, 0, 1, 1, 1],
        "steps": [0, 1, 2] * 2,
        "observed": [0.5, np.nan, -0.3] * 2,
    }
    with pm.Model() as model:
        pm.Normal("r", shape=2)
        psf.StateSpace("d", system, filter, **panel)
    # No observation depends on r: the gradient is that of the priors, also beside a failure.
    gradient = model.compile_dlogp()
    for r in ([0.5, 0.4], [0.5, 2.0]):
        np.testing.assert_array_equal(gradient({"r": r}), -np.array(r))
    assert np.isfinite(terms[0]).all()
    for failed in (terms[1], alone, run["log_likelihood"].values):
        np.testing.assert_array_equal(failed == -np.inf, [False, False, True])


@pytest.mark.parametrize(
    "filter", [psf.EnKF(50), psf.BootstrapPF(50)], ids=lambda f: type(f).__name__
)
def test_a_singular_matrix_in_a_users_function_is_minus_infinity(filter):
    system = psf.StateSpaceModel(
        transition=lambda x, k: pt.linalg.inv(pt.stack([[k]])) @ x,
        observation=lambda x: [x[0]],
        observation_noise=[[0.1]],
        initial_mean=[1.0],
        initial_cov=[[0.1]],
    )
    with pytest.warns(psf.errors.FilterWarning, match="-inf in 2 of 3"):
        terms = psf.log_likelihood(
            system, filter, {"k": [1.0, 0.0, -0.0]}, [1.0, 1.0], steps=[0, 2]
        )
    assert np.isfinite(terms[0]).all()
    assert (terms[1:, 1] == -np.inf).all()
