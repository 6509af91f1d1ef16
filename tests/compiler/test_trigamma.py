"""The second derivative of log Γ in machine code."""

import warnings

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy.special import polygamma

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.codegen.trigamma import trigamma


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
