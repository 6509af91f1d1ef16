"""Copies of a particle that no noise tells apart count as one, and change no estimate."""

import numpy as np
import pytensor.tensor as pt
import pytest
from numba import njit
from scipy.special import logsumexp

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.filters.ensemble.origins import (
    effective_number_of_origins,
    follow_ancestors,
    new_origins,
)
from pymc_statespace_filters.filters.ensemble.reductions import RankLayout, local_partition
from pymc_statespace_filters.filters.outcomes import COLLAPSED
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.states import TermHealth
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.parameters import flat_parameters
from pymc_statespace_filters.system.record import read_record
from tests.references.records import PRECISE_DOUBLE_WELL, SURPRISES, double_well_with_surprises
from tests.systems import DOUBLE_WELL_SYSTEM, double_well_parameters

STEPS = np.arange(1, 201)


def line(**changes):
    """A straight line of unknown height and slope, seen through a noisy sensor."""
    settings = {
        "transition": lambda x: [x[0] + 0.01 * x[1], x[1]],
        "observation": lambda x: [x[0]],
        "observation_noise": [[0.01]],
        "initial_mean": [0.0, 0.0],
        "initial_cov": np.eye(2),
    }
    return psf.StateSpaceModel(**settings | changes)


def growth():
    """Logistic growth from an unknown start at an unknown rate."""
    return line(
        transition=lambda x: [x[0] + 0.05 * x[1] * x[0] * (1 - x[0]), x[1]],
        observation_noise=[[1e-4]], initial_mean=[0.2, 1.0], initial_cov=[[0.01, 0], [0, 0.25]],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "undriven"),
    [
        ({}, ("x0", "x1")),
        ({"initial_cov": np.diag([1.0, 0.0])}, ("x0",)),
        ({"initial_cov": np.diag([0.0, 1.0])}, ("x0", "x1")),
        ({"initial_cov": lambda v: pt.diag([v, 0.0 * v])}, ("x0",)),
        ({"initial_cov": np.zeros((2, 2))}, ()),
        ({"transition": lambda x, q: [x[0] + x[1], x[1] + q[0]], "process_noise": 1.0}, ()),
        ({"transition": lambda x, q: [x[0] + x[1] + q[0], x[1]], "process_noise": 1.0}, ("x1",)),
        (
            {"transition": lambda x, q: x + q, "process_noise": lambda s: pt.diag([s, 0.0 * s])},
            ("x1",),
        ),
        ({"transition": lambda x, q: [0.5 + q[0], x[0]], "process_noise": 1.0}, ()),
        ({"initial_cov": None, "initial_mean": None, "initial_dist": lambda: [1.0, 2.0]}, ()),
    ],
)
def test_states_that_no_noise_reaches_are_found(changes, undriven):
    changes = {name: value for name, value in changes.items() if value is not None}
    settings = line(**changes) if "initial_dist" not in changes else started(changes)
    assert compile_system(settings).undriven_states == undriven


def started(changes):
    return psf.StateSpaceModel(
        lambda x: [x[0] + 0.01 * x[1], x[1]], lambda x: [x[0]], observation_noise=[[0.01]],
        **changes,
    )  # fmt: skip


@njit(error_model="numpy")
def numbers_of_origins(w, ancestors):
    """Those of particles with the weights (T, N), each time copied from the ancestors (T, N)."""
    local = local_partition(RankLayout(0, 1, 0), w.shape[1], 8)
    origins, found = new_origins(True, local), np.empty(len(w))
    for t in range(len(w)):
        found[t] = effective_number_of_origins(origins, w[t], local)
        follow_ancestors(origins, ancestors[t])
    return found


def test_the_number_of_origins_is_that_of_their_weights():
    even = np.full(6, 1 / 6)
    w = np.array([even, [0.1, 0.2, 0.2, 0.1, 0.1, 0.3], even])
    ancestors = np.array([[1, 1, 1, 4, 4, 5], [0, 2, 2, 1, 1, 0], range(6)])
    expected = [6.0, 1 / (0.5**2 + 0.2**2 + 0.3**2), 1.0]
    np.testing.assert_allclose(numbers_of_origins(w, ancestors), expected, rtol=1e-14)


def test_few_different_particles_are_warned_of_although_all_weights_are_equal():
    system = line()
    data = psf.simulate(system, {}, steps=STEPS, random_seed=3)["observations"].values
    exact = psf.log_likelihood(system, psf.EKF(), {}, data, steps=STEPS).sum()
    with pytest.warns(
        psf.errors.FilterWarning, match="no noise reaches the states x0, x1"
    ) as caught:
        found = psf.log_likelihood(system, psf.BootstrapPF(1000), {}, data, steps=STEPS).sum()
    assert exact - found > 100
    assert "Use EKF()" in str(caught[0].message)
    assert "times as many" not in str(caught[0].message)


def test_the_remedy_for_curved_equations_works():
    system = growth()
    data = psf.simulate(system, {}, steps=STEPS, random_seed=3)["observations"].values
    with pytest.warns(
        psf.errors.FilterWarning, match=r"Use GuidedPF\(100\), which draws the start"
    ):
        psf.log_likelihood(system, psf.BootstrapPF(1000), {}, data, steps=STEPS)
    found = psf.log_likelihood(
        system, psf.GuidedPF(100), {}, data, steps=STEPS, seed=np.arange(5)
    ).sum(axis=1)
    np.testing.assert_allclose(found, by_quadrature(data), rtol=0.0, atol=0.05)


def by_quadrature(data):
    """The sum over a grid of starts, each of the likelihood of its path."""
    axis = np.linspace(-4.0, 4.0, 801)
    z = np.stack(np.meshgrid(axis, axis, indexing="ij")).reshape(2, -1)
    z = z[:, 0.2 + 0.1 * z[0] > 0.0]  # other paths diverge
    x = np.array([[0.2], [1.0]]) + np.array([[0.1], [0.5]]) * z
    log_p = -0.5 * (z**2).sum(axis=0) - np.log(2 * np.pi)
    for d in data[:, 0]:
        x[0] += 0.05 * x[1] * x[0] * (1 - x[0])
        log_p += -0.5 * ((d - x[0]) ** 2 / 1e-4 + np.log(2 * np.pi * 1e-4))
    return logsumexp(log_p) + 2 * np.log(axis[1] - axis[0])


def test_the_same_particles_with_a_little_noise_are_not_counted():
    """Noise of 1e-30 reaches the states: the terms are the same, and all particles count."""
    quiet = line(
        transition=lambda x, q: [x[0] + 0.01 * x[1] + q[0], x[1] + q[1]],
        process_noise=1e-60 * np.eye(2),
    )  # fmt: skip
    data = psf.simulate(line(), {}, steps=STEPS[:5], random_seed=3)["observations"].values
    arguments = np.zeros(0), STEPS[:5], data, np.zeros((0, 0)), 0.0, np.uint64(1)
    terms, n_effective, _ = evaluator(TermHealth(line(), psf.BootstrapPF(1000)))(*arguments)
    same, n_all, _ = evaluator(TermHealth(quiet, psf.BootstrapPF(1000)))(*arguments)
    np.testing.assert_allclose(terms, same, rtol=1e-9)
    assert n_effective[0] == pytest.approx(n_all[0])
    assert n_effective[-1] < 0.5 * n_all[-1]


# The effective number of a filter is that of the weights whose mean is the term.


N = 200
PARAMETERS = double_well_parameters(PRECISE_DOUBLE_WELL)


def term_health(filter, observed, steps, seed=0):
    record = read_record(DOUBLE_WELL_SYSTEM, GivenRecord(observed, steps=steps)).arguments
    theta = flat_parameters(DOUBLE_WELL_SYSTEM, PARAMETERS)
    return evaluator(TermHealth(DOUBLE_WELL_SYSTEM, filter))(theta, *record, np.asarray(seed))


@pytest.mark.parametrize("filter", [psf.BootstrapPF(N), psf.EnKF(N), psf.PFEnKF(N)])
def test_a_mean_over_forecast_members_has_the_number_of_their_densities(filter):
    """At step 0 all filters have the same members; the bootstrap filter shows their weights."""
    observed, steps = [0.2], [0]
    terms, n_effective, health = term_health(filter, observed, steps)
    run = psf.run_filter(DOUBLE_WELL_SYSTEM, psf.BootstrapPF(N), PARAMETERS, observed, steps=steps)
    weights = run["weights"].values[0]
    np.testing.assert_allclose(terms, run["log_likelihood"], rtol=1e-12)
    np.testing.assert_allclose(n_effective, 1 / np.sum(weights**2), rtol=1e-9)
    assert health[0] == n_effective.min()


def test_a_mean_over_updated_weights_has_their_number():
    observed, steps = [0.2, np.nan, 0.4], [0, 20, 40]
    filter = psf.PFEnKF(N, likelihood="weights")
    _, n_effective, health = term_health(filter, observed, steps)
    run = psf.run_filter(DOUBLE_WELL_SYSTEM, filter, PARAMETERS, observed, steps=steps)
    of_weights = 1 / np.sum(run["weights"].values ** 2, axis=1)
    np.testing.assert_allclose(n_effective[[0, 2]], of_weights[[0, 2]], rtol=1e-9)
    assert np.isnan(n_effective[1])  # no observation, no term
    assert health[0] == np.nanmin(n_effective)


def test_a_gaussian_likelihood_rests_on_all_members():
    filter = psf.EnKF(N, likelihood="gaussian")
    _, n_effective, _ = term_health(filter, [0.2, 9.0], [0, 20])
    assert (n_effective == N).all()


def test_no_surprise_is_passed_over():
    """Few particles are near a surprise; the updated weights of PFEnKF do not show it."""
    record = double_well_with_surprises()
    first = min(SURPRISES)
    observed, steps = record.observed[: first + 1], record.steps[: first + 1]
    for seed in range(6):
        _, n_effective, health = term_health(psf.PFEnKF(250), observed, steps, seed)
        assert n_effective[first] < COLLAPSED
        assert health[0] == n_effective.min()
