"""The warning of failures and collapse names the evaluation whose particles were the fewest."""

import warnings

import numpy as np
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice import health
from pymc_statespace_filters.evaluation.health import Health
from pymc_statespace_filters.filters.outcomes import COLLAPSED, Failure

# Health that does not come from a filter: smallest effective number, failure, observation.
SYSTEM = psf.StateSpaceModel(
    transition=lambda x, q: [x[0] + q[0], x[1]],
    process_noise=[[1.0]],
    observation=lambda x: [x[0]],
    observation_noise=[[1.0]],
    initial_mean=[0.0, 0.0],
    initial_cov=np.eye(2),
)


BENT = psf.StateSpaceModel(
    transition=lambda x, q: [pt.sin(x[0]) + q[0], x[0]],
    process_noise=1.0,
    observation=lambda x: x[0],
    observation_noise=1e-4,
    initial_mean=[0.0, 0.0],
    initial_cov=np.eye(2),
)


PARTICLES = psf.BootstrapPF(100)
RECORD = (np.empty(0), np.arange(5, 10), np.zeros((5, 1)), np.empty((0, 0)), 5.0, 0)


def warned(rows, filter=PARTICLES, system=SYSTEM):
    asked = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Health(system, filter, np.array(rows), lambda i: asked.append(i) or RECORD).tell()
    return [str(w.message) for w in caught], asked


def test_the_worst_evaluation_is_the_one_with_the_fewest_that_did_not_fail(monkeypatch):
    monkeypatch.setattr(health, "_extent", lambda *_: "Some terms")
    failure = Failure.TOO_FAR
    rows = [[5.0, 0.0, -1.0], [2.0, 0.0, -1.0], [0.0, failure, 3.0], [1.25, 0.0, -1.0]]
    (failed, collapsed), asked = warned(rows)
    assert failed == (
        "BootstrapPF(100) gave -inf in 1 of 4 evaluations, first in row 3, at time 13: "
        f"{failure.message}. {failure.cure}."
    )
    assert "in 2 of 4 evaluations (smallest effective number 1.25)" in collapsed
    assert asked == [2, 3]


def test_a_filter_is_not_its_own_remedy(monkeypatch):
    monkeypatch.setattr(health, "_extent", lambda *_: "Some terms")
    (of_guided,), _ = warned([[1.5, 0.0, -1.0]], psf.GuidedPF(100), BENT)
    (of_bootstrap,), _ = warned([[1.5, 0.0, -1.0]], psf.BootstrapPF(100), BENT)
    (of_linear,), _ = warned([[1.5, 0.0, -1.0]], psf.BootstrapPF(100))
    assert "Use more particles" in of_guided
    assert "GuidedPF(100)" not in of_guided.removeprefix("GuidedPF(100)")
    assert "Use GuidedPF(100)" in of_bootstrap
    assert "Use EKF()" in of_linear
    assert "slowly" not in of_guided + of_bootstrap + of_linear


def test_the_spread_over_seeds_is_that_of_the_system_at_hand():
    record = np.array([0.1, 0.3, -0.5, 2.0])
    arguments = (BENT, psf.BootstrapPF(64), {}, record)
    with pytest.warns(psf.errors.FilterWarning) as caught:
        psf.log_likelihood(*arguments, steps=[1, 2, 3, 4], seed=8)
    seeds = [8 ^ i for i in range(5)]
    with pytest.warns(psf.errors.FilterWarning):
        at_seeds = psf.log_likelihood(*arguments, steps=[1, 2, 3, 4], seed=seeds)
    spread = np.ptp(at_seeds.sum(axis=1))
    assert f"at 5 seeds the log-likelihood ranged over {spread:.0f} nats" in str(caught[0].message)
    assert str(caught[0].message).startswith("BootstrapPF(64): fewer than 3")


LINEAR = psf.StateSpaceModel(
    transition=lambda x, q: [0.9 * x[0] + q[0]],
    process_noise=[[0.3]],
    observation=lambda x: [x[0]],
    observation_noise=[[0.1]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)


@pytest.mark.parametrize("observed", [[0.2, 1.0, np.nan], [np.nan] * 3])
def test_two_particles_that_are_right_are_not_warned_of(observed):
    """The sum of guided ones is exact for a linear system, whatever their number."""
    arguments = (LINEAR, psf.GuidedPF(2), {}, observed)
    terms = psf.log_likelihood(*arguments, steps=[1, 2, 3], seed=[1, 2])
    exact = psf.log_likelihood(LINEAR, psf.EKF(), {}, observed, steps=[1, 2, 3])
    assert terms.sum(axis=1) == pytest.approx([exact.sum()] * 2, abs=1e-12)


def test_two_particles_that_saw_no_data_are_not_warned_of():
    psf.log_likelihood(BENT, psf.GuidedPF(2), {}, [np.nan] * 3, steps=[1, 2, 3], seed=1)


@pytest.mark.parametrize(
    ("observed", "nats"), [(2.0, r"\d+\.\d nats below"), (500.0, r"\d{4,} nats below")]
)
def test_large_differences_have_no_decimals(observed, nats):
    with pytest.warns(
        psf.errors.FilterWarning, match=f"the log-likelihood is {nats}, by a different"
    ):
        psf.log_likelihood(LINEAR, psf.BootstrapPF(2), {}, [observed], steps=[1], seed=1)


@pytest.mark.parametrize("smallest", [COLLAPSED, np.inf])
def test_enough_particles_are_not_warned_of(smallest):
    assert warned([[smallest, 0.0, -1.0]]) == ([], [])


def test_a_start_that_leaves_a_covariance_without_digits_is_named():
    """Not where one state alone starts so, which is observed, nor in other units."""
    turn = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    observed = np.array([4.7, 6.1, 5.5, 6.2])

    def terms(variances, gain=1.0, noise=0.25):
        system = psf.StateSpaceModel(
            lambda x, q: turn @ x + 0.1 * q, process_noise=np.eye(2), initial_mean=[0.0, 0.0],
            observation=lambda x: [gain * x[0]], observation_noise=[[noise]],
            initial_cov=np.diag(variances),
        )  # fmt: skip
        return psf.log_likelihood(system, psf.EKF(), {}, observed, steps=range(4))

    with pytest.warns(
        psf.errors.FilterWarning, match=r"^EKF\(\): initial_cov is so large that the"
    ):
        terms([1e14, 1e14])
    wide = terms([0.25e8, 0.25e8])
    # What is advised says as little: two diffuse states take log sd off the first two terms.
    wider = terms([0.25e9, 0.25e9])
    np.testing.assert_allclose(wide - wider, [np.log(10) / 2, np.log(10) / 2, 0, 0], atol=1e-5)
    terms([1e14, 1.0])
    terms([1e10, 1e10], gain=1e-6, noise=1e-6)
