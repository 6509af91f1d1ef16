"""A warning of a failure says what the filter knows: the reason, the row, its time, and a cure."""

import warnings

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.filters.catalog import FILTERS
from pymc_statespace_filters.filters.outcomes import Failure

PARTICLES = (psf.GuidedPF(60), psf.BootstrapPF(60), psf.PFEnKF(60), psf.EnKF(60))
GAUSSIAN = (psf.EKF(), psf.UKF(), psf.IPLF())
# An iterated filter moves the state to where the observation is likely.
NOT_ITERATED = (psf.EKF(), psf.UKF(), psf.GridFilter(), *PARTICLES)
ALL = (*GAUSSIAN, psf.GridFilter(), *PARTICLES)
STEPS = np.array([2, 3, 40])
DATA = np.array([1.0, 2.0, 3.0])


def system(**changes):
    """A decaying number with a sensor; ``a`` is how it decays and ``v`` a variance."""
    settings = {
        "transition": lambda x, q, a: [a * x[0] + q[0]],
        "process_noise": [[0.1]],
        "observation": lambda x: [x[0]],
        "observation_noise": [[1.0]],
        "initial_mean": [2.0],
        "initial_cov": [[0.1]],
        "dt": 0.5,
    }
    return psf.StateSpaceModel(**settings | changes)


def without_noise(transition=lambda x, a: [a * x[0]], **changes):
    return system(transition=transition, process_noise=None, **changes)


def failures(system, filter, params, observed=DATA, **data):
    """What is said of failures, and the log-likelihood."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        terms = psf.log_likelihood(system, filter, params, observed, steps=STEPS, t0=10.0, **data)
    said = [str(one.message) for one in caught]
    return [text for text in said if "gave -inf" in text], terms


def takes(system, filter):
    try:
        filter.check(compile_system(system))
    except psf.errors.ModelError:
        return False
    return True


def check(system, params, failure, place=" in row 0, at time 11", filters=ALL, **data):
    """All filters that take a system name this reason and place; one evaluation has no count."""
    used = [filter for filter in filters if takes(system, filter)]
    for filter in used:
        (text,), terms = failures(system, filter, params, **data)
        assert f" gave -inf{place}: {failure.message}. " in text, (filter, text)
        assert failure.cure in text
        assert terms[-1] == -np.inf
    assert used


@pytest.mark.parametrize("known", [True, False])
def test_an_overflow_without_noise_is_one_of_the_state(known):
    grows = without_noise(initial_cov=[[0.0 if known else 0.1]])
    others = [f for f in ALL if not isinstance(f, psf.EnKF)]  # which moves all members to the data
    check(grows, {"a": 1e30}, Failure.STATE_NOT_FINITE, " in row 2, at time 30", others)


@pytest.mark.parametrize("known", [True, False])
def test_a_negative_mean_of_counts_is_outside_its_domain(known):
    def counts(mean):
        return without_noise(
            observation=None, observation_noise=None, initial_cov=[[0.0 if known else 0.01]],
            observation_dist=lambda x: [pm.Poisson.dist(mean(x[0]))],
        )  # fmt: skip

    check(counts(lambda x: -x), {"a": 0.9}, Failure.OBSERVATION_UNDEFINED)
    for filter in (f for f in ALL if takes(counts(pt.softplus), f)):  # the cure is one
        texts, terms = failures(counts(lambda x: pt.softplus(-x)), filter, {"a": 0.9})
        assert not texts
        assert np.isfinite(terms).all()


def test_a_mean_that_overflows_is_none():
    bright = system(observation=lambda x: [pt.exp(x[0])], initial_mean=[2000.0])
    check(bright, {"a": 1.0}, Failure.OBSERVATION_UNDEFINED)
    check(without_noise(observation=lambda x: [pt.log(-x[0])], initial_cov=[[0.0]]), {"a": 1.0},
          Failure.OBSERVATION_UNDEFINED)  # fmt: skip


@pytest.mark.parametrize("name", ["initial_cov", "process_noise", "observation_noise"])
def test_a_negative_variance_is_named(name):
    changes = {name: lambda v: [[v]]}
    check(system(**changes), {"a": 0.9, "v": -1.0}, Failure[name.upper()], "")
    if name == "observation_noise":
        for cov in (0.0, 0.1):
            plain = without_noise(initial_cov=[[cov]], **changes)
            check(plain, {"a": 0.9, "v": -1.0}, Failure.OBSERVATION_NOISE, "")


def test_an_observation_far_out_has_density_zero():
    far = np.array([1.0, 1e200, 1.0])
    place = " in row 1, at time 11.5"
    check(system(), {"a": 0.9}, Failure.ZERO_DENSITY, place, NOT_ITERATED, observed=far)
    check(without_noise(initial_cov=[[0.0]]), {"a": 0.9}, Failure.ZERO_DENSITY, place, observed=far)


def test_rounding_errors_are_told_from_a_sensor_that_is_not_defined():
    """Two sensors of one number whose noises are 1e-20 of its variance."""
    twice = system(
        observation=lambda x: [x[0], 2.0 * x[0]], observation_noise=1e-9 * np.eye(2),
        initial_cov=[[1e12]],
    )  # fmt: skip
    observed = np.array([[1.0, 2.0]] * 3)
    check(twice, {"a": 1.0}, Failure.SINGULAR, filters=[psf.EKF()], observed=observed)
    assert "initial_cov of at most 1e8 times" in Failure.SINGULAR.cure


def test_exact_sensors_of_shocks_that_are_one_are_a_stochastic_singularity():
    """By rounding, this singular covariance is positive definite: 16 nats in the first row."""
    loadings, none = np.array([[1.0, 0.5], [0.3, 0.15]]), np.zeros((2, 2))
    exact = system(
        transition=lambda x, q, a: a * x + loadings @ q, process_noise=np.eye(2),
        observation=lambda x: x, observation_noise=none, initial_mean=[1.0, 1.0], initial_cov=none,
    )  # fmt: skip
    observed = np.array([[2.0, 1.3]] * 3)
    filters = [psf.EKF(), psf.UKF()]
    check(exact, {"a": 1.0}, Failure.SINGULAR, filters=filters, observed=observed)
    assert "stochastic singularity" in Failure.SINGULAR.message


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(60)], ids=str)
def test_of_many_evaluations_the_first_of_each_reason_is_shown(filter):
    """Side by side in lanes, or one by one."""
    grows = system(
        transition=lambda x, q, a: [a * x[0] ** 2 + q[0]], observation_noise=lambda v: [[v]]
    )
    params = {"a": [0.0, 5.0, 0.0, 6.0], "v": [1.0, 1.0, -2.0, 1.0]}
    (overflow, negative), terms = failures(grows, filter, params)
    row = " in 2 of 4 evaluations, first in row 2, at time 30, with a = 5, v = 1: the state"
    assert row in overflow
    assert " in 1 of 4 evaluations, first with a = 0, v = -2: observation_noise is" in negative
    assert (np.isfinite(terms[:, -1]) == [True, False, False, False]).all()


def test_a_record_of_a_panel_is_named():
    panel = ["one"] * 3 + ["two"] * 3
    with pytest.warns(
        psf.errors.FilterWarning, match="of record 'two', first in row 1, at time 1.5"
    ):
        psf.log_likelihood(
            system(), psf.EKF(), {"a": 0.9}, [*DATA, 1.0, 1e200, 1.0],
            steps=[*STEPS, *STEPS], panel=panel,
        )  # fmt: skip


def test_another_filter_is_no_cure_of_an_observation_that_is_not_defined():
    """x ~ N(-3, 1) gives a count only if it is positive: quadrature has -17.3."""
    counts = system(
        transition=lambda x: [x[0]], process_noise=None, initial_mean=[-3.0], initial_cov=[[1.0]],
        observation=None, observation_noise=None,
        observation_dist=lambda x: [pm.Poisson.dist(x[0])],
    )  # fmt: skip
    (text,), _ = failures(counts, psf.GuidedPF(100), {})
    assert text.endswith(
        "write the observation so that it is defined at every state, for example "
        "with pt.softplus(x[0]), which is positive and does not overflow."
    )
    texts, terms = failures(counts, psf.BootstrapPF(20_000), {})
    assert not texts
    assert np.isfinite(terms).all()


def test_a_filter_is_recommended_where_it_has_a_likelihood():
    """No particle is where a count is possible; and no filter has a density of one at 1e200."""
    counts = system(
        initial_mean=[-4.0], initial_cov=[[0.5]], observation=None, observation_noise=None,
        observation_dist=lambda x: [pm.Poisson.dist(pt.maximum(x[0], 0.0))],
    )  # fmt: skip
    (text,), _ = failures(counts, psf.BootstrapPF(20), {"a": 0.9})
    assert Failure.ZERO_DENSITY.message in text
    assert text.endswith("Use GridFilter(), which computes this likelihood without particles.")
    (text,), _ = failures(system(), psf.BootstrapPF(20), {"a": 0.9}, [1.0, 1e200, 1.0])
    assert text.endswith(f"{Failure.ZERO_DENSITY.cure}.")


def test_every_failure_of_a_filter_has_a_sentence():
    assert len({failure.message for failure in Failure}) == len(Failure)
    assert all(f.message and not f.message.endswith(".") for f in Failure)
    assert {type(f) for f in FILTERS if takes(system(), f)} == {type(f) for f in ALL}
