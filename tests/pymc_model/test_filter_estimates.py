"""Log-likelihoods of a StateSpace variable at points of its model, by any filter."""

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.pymc_model.filter_estimates import VariableAtPoints
from tests.systems import FORCE, FORCED, FORCED_DATA, STEPS, forced_terms

pytestmark = pytest.mark.usefixtures("interpreted")

# On the unconstrained space: the logarithm of a, and an input's factor.
X = np.array([[-0.5, 1.0], [-0.1, 0.7], [-1.0, 2.0]])
NO_SEEDS = np.zeros((len(X), 1), dtype=np.int64)
LABELS = np.array(["b", "b", "a", "c"])


def model_of(**options):
    with pm.Model() as model:
        a = pm.LogNormal("a", 0.0, 1.0)
        b = pm.Normal("b", 1.0, 1.0)
        record = {"steps": STEPS, "observed": FORCED_DATA} | options
        psf.StateSpace("d", FORCED, psf.EKF(), params={"a": a}, inputs=b * FORCE[:, None], **record)
    return model


def exact(x, score_from=0):
    return forced_terms(np.exp(x[0]), force=x[1] * FORCE)[score_from:].sum()


# The sum of all terms of GuidedPF is exact, single terms are not.
@pytest.mark.parametrize(
    ("filter", "score_from"),
    [(psf.EKF(), 0), (psf.EKF(), 2), (psf.GuidedPF(10), 0), (psf.GridFilter(), 2)],
)
def test_exact_filters_find_the_formulas_of_kalman(filter, score_from):
    points = VariableAtPoints(model_of(score_from=score_from), "d", X)
    found = points.log_likelihood(filter, NO_SEEDS)
    whole = points.at(range(3), filter, NO_SEEDS, scored=False)
    np.testing.assert_allclose(whole[:, 0], [exact(x) for x in X], rtol=1e-7)
    np.testing.assert_allclose(found[:, 0], [exact(x, score_from) for x in X], rtol=1e-7)


def test_each_estimate_has_its_seed():
    points, filter = VariableAtPoints(model_of(), "d", X), psf.BootstrapPF(64)
    seeds = np.arange(6).reshape(3, 2)
    found = points.log_likelihood(filter, seeds)
    for i, j in np.ndindex(3, 2):
        given = {"a": np.exp(X[i, 0])}
        record = {"steps": STEPS, "observed": FORCED_DATA, "inputs": X[i, 1] * FORCE[:, None]}
        terms = psf.log_likelihood(FORCED, filter, given, seed=seeds[i, j], **record)
        assert found[i, j] == terms.sum()
    assert points.at([2], filter, seeds[2:])[0, 1] == found[2, 1]


def test_a_panel_is_the_sum_of_its_records():
    points = VariableAtPoints(model_of(panel=LABELS, steps=[0, 2, 3, 6]), "d", X)
    alone = [
        sum(
            forced_terms(np.exp(a), FORCED_DATA[rows], STEPS[rows], b * FORCE).sum()
            for rows in (slice(0, 2), slice(2, 3), slice(3, 4))
        )
        for a, b in X
    ]
    for filter in (psf.EKF(), psf.GuidedPF(10)):
        found = points.log_likelihood(filter, NO_SEEDS)
        np.testing.assert_allclose(found[:, 0], alone, rtol=1e-9)


def test_a_failure_is_minus_infinity():
    with pm.Model() as model:
        v = pm.Normal("v", 0.0, 1.0)
        system = psf.StateSpaceModel(
            transition=lambda x, q: [x[0] + q[0]],
            process_noise=[[1.0]],
            observation=lambda x: [x[0]],
            observation_noise=lambda v: [[v]],
            initial_mean=[0.0],
            initial_cov=[[1.0]],
        )
        psf.StateSpace("d", system, psf.EKF(), params={"v": v}, steps=[1], observed=[0.3])
    points = VariableAtPoints(model, "d", np.array([[1.0], [-5.0]]))
    assert points.log_likelihood(psf.EKF(), NO_SEEDS[:2])[1, 0] == -np.inf


def test_a_filter_that_cannot_treat_the_system_is_refused():
    with pm.Model() as model:
        pm.Normal("r", 0.0, 1.0)
        psf.StateSpace(
            "d",
            psf.StateSpaceModel(
                transition=lambda x, q: [x[0] + q[0], x[1] + q[1]],
                process_noise=np.eye(2),
                observation=lambda x, r: [x[0] + r],
                observation_noise=[[1.0]],
                initial_mean=[0.0, 0.0],
                initial_cov=np.eye(2),
            ),
            psf.EKF(),
            steps=[1],
            observed=[0.3],
        )
    with pytest.raises(psf.errors.ModelError, match="GridFilter"):
        VariableAtPoints(model, "d", np.zeros((1, 1))).log_likelihood(
            psf.GridFilter(), NO_SEEDS[:1]
        )
