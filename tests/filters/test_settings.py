"""Settings of filters that cannot be, as (filter, argument, value, message)."""

from functools import partial

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from tests.systems import FREE


def each(make, argument, values, message):
    """A row for each value."""
    return [(make, argument, value, message) for value in values]


PARTICLE_FILTERS = (psf.BootstrapPF, psf.PFEnKF, psf.GuidedPF)
TABLE = [
    *each(
        psf.EnKF,
        "n_members",
        [1, 0, -3, 10.0, True, "10", None, np.float64(50)],
        "n_members must be an integer from 2 to 1e.08",
    ),
    *each(
        partial(psf.EnKF, 10),
        "likelihood",
        ["Ensemble", "predictive", "exact", None, 3, ["ensemble"]],
        "likelihood must be one of 'ensemble', 'gaussian'",
    ),
    *each(
        partial(psf.PFEnKF, 10),
        "likelihood",
        ["ensemble", "gaussian", "as_printed"],
        "likelihood must be one of 'predictive', 'weights'",
    ),
]
for filter in PARTICLE_FILTERS:
    TABLE += [
        *each(
            filter,
            "n_particles",
            [0, 1, 2.5, 10.0, True, "10"],
            "n_particles must be an integer from 2 to 1e.08",
        ),
        *each(
            partial(filter, 10),
            "resample_below",
            [-0.1, 1.1, 2, np.nan, True, "0.5", None],
            "resample_below must be a number from 0 to 1",
        ),
        *each(
            partial(filter, 10),
            "resampling",
            ["none", "residual"],
            "resampling must be one of 'systematic', 'multinomial', 'sorted'",
        ),
    ]
TABLE += [
    *each(
        psf.GridFilter,
        "tolerance",
        [0.0, 0.1, -1e-8, np.nan, "1e-8", True],
        "tolerance must be a number from 1e-12 to 1e-2",
    ),
    *each(psf.UKF, "alpha", [0.0], "^alpha must be a positive number"),
    *each(psf.UKF, "beta", [np.nan], "^beta must be a finite number"),
    *each(psf.UKF, "kappa", ["3"], "^kappa must be a finite number"),
    *each(
        lambda kappa: psf.UKF(kappa=kappa).check(compile_system(FREE)),
        "kappa",
        [-1.0],
        "^kappa must be above -1 for 1 states",
    ),
    *each(psf.IPLF, "n_iterations", [0], "^n_iterations must be an integer of at least 1"),
]


@pytest.mark.parametrize(("make", "argument", "value", "message"), TABLE)
def test_wrong_settings_are_named_with_their_values(make, argument, value, message):
    with pytest.raises(psf.errors.ModelError, match=f"{message}, got ") as caught:
        make(**{argument: value})
    assert str(caught.value).removesuffix(".").endswith(f"got {value!r}")


def test_a_number_beyond_memory_is_refused():
    with pytest.raises(psf.errors.ModelError, match=r"n_particles .*to 1e.08"):
        psf.BootstrapPF(10**30)


@pytest.mark.parametrize("filter", [*PARTICLE_FILTERS, psf.RBPF])
def test_only_the_number_of_particles_is_given_by_position(filter):
    with pytest.raises(TypeError, match="positional argument"):
        filter(10, 0.5)


# Parameters that no system can have are impossible under every filter alike.


FILTERS = [psf.EKF(), psf.EnKF(32), psf.BootstrapPF(32), psf.PFEnKF(32)]


def system(initial_cov=lambda p: [[p]]):
    return psf.StateSpaceModel(
        lambda x, q: [0.9 * x[0] + q[0]],
        lambda x: [x[0]],
        process_noise=lambda s: [[s]],
        observation_noise=lambda r: [[r]],
        initial_mean=[0.0],
        initial_cov=initial_cov,
    )


@pytest.mark.parametrize("filter", FILTERS, ids=lambda f: type(f).__name__)
@pytest.mark.parametrize("negative", ["p", "s", "r"])
def test_a_negative_variance_is_impossible(filter, negative):
    params = {"p": 1.0, "s": 0.3, "r": 0.5} | {negative: -0.2}
    with pytest.warns(psf.errors.FilterWarning, match="gave -inf: .* not positive semidefinite"):
        terms = psf.log_likelihood(system(), filter, params, [0.3, 0.1], steps=[1, 2])
    assert (terms == -np.inf).all()


def test_zero_variances_are_ordinary():
    params = {"p": 0.0, "s": 0.0, "r": 0.5}
    terms = psf.log_likelihood(system(), psf.EKF(), params, [0.3, 0.1], steps=[1, 2])
    expected = -0.5 * np.array([0.3, 0.1]) ** 2 / 0.5 - 0.5 * np.log(2 * np.pi * 0.5)
    np.testing.assert_allclose(terms, expected, rtol=1e-12)


def test_units_may_differ_by_many_orders():
    """Pascals beside millimetres: the small component keeps its spread."""
    cov = np.diag([1e12, 1e-6])
    units = psf.StateSpaceModel(
        lambda x: [x[0], x[1]],
        lambda x: [x[0], x[1]],
        observation_noise=cov,
        initial_mean=[0.0, 0.0],
        initial_cov=cov,
    )
    record = psf.simulate(units, {}, steps=range(200), random_seed=1)["observations"].values
    # A variance of 200 draws: within a half and twice of its mean but once in 1e9.
    assert 0.5e-6 < record[:, 1].var() < 2e-6


def test_nothing_to_nudge_is_a_bootstrap_filter():
    memory = psf.StateSpaceModel(
        lambda x, q: [0.9 * x[0] + q[0]],
        lambda x: [x[0]],
        process_noise=[[1.0]],
        observation_noise=[[0.5]],
        initial_mean=[0.0],
        initial_cov=[[1.0]],
        carried=["x0"],
    )
    record = {"observed": [0.3, 0.4, 0.2], "steps": [0, 1, 2], "seed": 5}
    nudged = psf.log_likelihood(memory, psf.PFEnKF(64), {}, **record)
    plain = psf.log_likelihood(memory, psf.BootstrapPF(64), {}, **record)
    np.testing.assert_array_equal(nudged, plain)
