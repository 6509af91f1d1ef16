"""GuidedPF against exact likelihoods: of linear systems for any seed, else in the mean."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references.records import (
    BROAD_DOUBLE_WELL,
    OSCILLATOR,
    PRECISE_DOUBLE_WELL,
    LinearSystem,
    broad_double_well,
    double_well_with_surprises,
    oscillator_with_gaps,
    simulate,
)
from tests.systems import (
    DOUBLE_WELL_SYSTEM,
    counts,
    double_well_parameters,
    linear_system,
    log_likelihoods,
)

# Three states, two noises, two sensors, and a start that is known in one direction.
CHAIN = LinearSystem(
    A=np.array([[0.9, 0.3, 0.0], [-0.2, 0.8, 0.1], [0.0, 0.4, 0.7]]),
    B=np.array([[0.0, 0.1], [0.4, 0.0], [0.0, 0.3]]),
    C=np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 1.0]]),
    R=np.array([[0.01, 0.002], [0.002, 0.04]]),
    mean=np.array([0.3, 0.0, -0.2]),
    cov=np.diag([0.5, 0.0, 0.2]),
)


def chain_with_a_surprise():
    steps = np.array([0, 1, 4, 5, 9, 10, 16])
    observed = simulate(CHAIN, steps, np.random.default_rng(8))
    observed[4] += 4.0
    observed[2, 1] = np.nan
    return steps, observed


@pytest.mark.parametrize("resample_below", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(
    ("reference", "record"),
    [(OSCILLATOR, oscillator_with_gaps()), (CHAIN, chain_with_a_surprise())],
    ids=["oscillator", "chain"],
)
def test_linear_systems_have_no_noise(reference, record, resample_below):
    steps, observed = record
    exact = kalman_log_likelihood(*reference.kalman_arguments(), steps=steps, observed=observed)
    for n_particles in (2, 70):
        filter = psf.GuidedPF(n_particles, resample_below=resample_below)
        record = {"observed": observed, "steps": steps}
        found = log_likelihoods(linear_system(reference), filter, {}, np.arange(5), **record)
        assert found == pytest.approx(exact.sum(), abs=1e-9)


def sheared(x):
    """Coordinates in which a linear system is not linear."""
    return [x[0] + 0.3 * x[1] ** 2, x[1]]


def straightened(v):
    return pt.stack([v[0] - 0.3 * v[1] ** 2, v[1]])


PUSH = np.array([0.5, -0.3])

# The oscillator in sheared coordinates: its one noise enters the first state squared.
SHEARED = psf.StateSpaceModel(
    transition=lambda x, q, u: sheared(
        OSCILLATOR.A @ straightened(x) + OSCILLATOR.B @ q + PUSH * u[0]
    ),
    process_noise=np.eye(1),
    observation=lambda x: OSCILLATOR.C @ straightened(x),
    observation_noise=OSCILLATOR.R / 10,
    initial_mean=[0.5, 0.0],
    initial_cov=np.zeros((2, 2)),
    inputs=["force"],
)


def sheared_case():
    """A record, and its exact likelihood by the linear system."""
    record = oscillator_with_gaps()
    steps, observed = record.steps[:8], record.observed[:8]
    inputs = np.sin(np.arange(steps[-1] + 1.0))
    A, Q, C, R, mean, cov = OSCILLATOR.kalman_arguments()
    exact = kalman_log_likelihood(
        A, Q, C, R / 10, mean, 0.0 * cov, steps=steps, observed=observed,
        forcing=inputs[:, None] * PUSH,
    )  # fmt: skip
    return SHEARED, {}, {"observed": observed, "steps": steps, "inputs": inputs}, exact.sum()


def double_well_case():
    record = broad_double_well()
    steps, observed = record.steps[:6], record.observed[:6].copy()
    observed[2] = np.nan
    given = double_well_parameters(BROAD_DOUBLE_WELL)
    return DOUBLE_WELL_SYSTEM, given, {"observed": observed, "steps": steps}, None


def counts_case():
    observed = np.array([0.0, 3.0, 9.0, np.nan, 2.0, 0.0, 0.0, 14.0])
    system = counts(a=0.9, bend=0.2, noise_var=0.3, initial_var=1.0)
    return system, {}, {"observed": observed, "steps": np.arange(8)}, None


@pytest.mark.parametrize(
    ("case", "resample_below", "n_seeds"),
    [(sheared_case, 0.5, 10_000), (double_well_case, 1.0, 2000), (counts_case, 0.5, 5000)],
)
def test_mean_of_the_likelihood_is_exact(case, resample_below, n_seeds):
    """Three standard errors: a right filter fails once in 370 (the seeds are fixed)."""
    system, given, record, exact = case()
    if exact is None:
        exact = psf.log_likelihood(system, psf.GridFilter(), given, **record).sum()
    filter = psf.GuidedPF(12, resample_below=resample_below)
    log_ratio = log_likelihoods(system, filter, given, np.arange(n_seeds), **record) - exact
    assert 0.004 < log_ratio.var() < 1.0  # noisy enough to tell a wrong weight
    ratio = np.exp(log_ratio)
    assert abs(ratio.mean() - 1.0) < 3.0 * ratio.std(ddof=1) / np.sqrt(n_seeds)


@pytest.mark.filterwarnings("ignore::pymc_statespace_filters.errors.FilterWarning")
@pytest.mark.parametrize(("n_particles", "n_seeds"), [(2, 10_000), (11, 20_000)])
def test_mean_is_exact_where_the_guide_is_in_doubt_before_the_first_observation(
    n_particles, n_seeds
):
    """One of two, or two of eleven, are unguided: taken as one of ten, 7 and 5 errors off."""
    given, record = double_well_parameters(BROAD_DOUBLE_WELL), {"observed": [-0.8], "steps": [60]}
    exact = psf.log_likelihood(DOUBLE_WELL_SYSTEM, psf.GridFilter(), given, **record).sum()
    terms = psf.log_likelihood(
        DOUBLE_WELL_SYSTEM, psf.GuidedPF(n_particles), given, **record, seed=np.arange(n_seeds)
    )
    ratio = np.exp(terms.sum(axis=1) - exact)
    assert abs(ratio.mean() - 1.0) < 3.0 * ratio.std(ddof=1) / np.sqrt(n_seeds)


def hop(x, q, u):
    """A pushed oscillator in two wells, and the well it was last in, a carried state."""
    well = pt.switch(x[0] > 0.3, 1.0, pt.switch(x[0] < -0.3, -1.0, x[2]))
    force = 1.3 * x[0] - x[0] ** 3 - 0.6 * x[1] + 0.2 * x[2] + 0.3 * u[0]
    return [x[0] + 0.2 * x[1] + 0.05 * q[0], x[1] + 0.2 * force + q[1], well]


HOPPING = psf.StateSpaceModel(
    transition=hop,
    process_noise=[[0.3, 0.02], [0.02, 0.05]],
    observation_dist=lambda x: [
        pm.Poisson.dist(mu=pt.exp(0.5 + x[0])),
        pm.Normal.dist(x[0] ** 2, 0.5),
    ],
    initial_mean=[0.1, 0.0, 1.0],
    initial_cov=np.diag([0.2, 0.1, 0.0]),
    states=["place", "speed", "well"],
    carried=["well"],
    inputs=["force"],
)


@pytest.mark.filterwarnings("ignore::pymc_statespace_filters.errors.FilterWarning")
def test_what_the_guide_leaves_out_has_its_share_from_the_start_on():
    """Counts and squares of three states, against as many particles as it takes.

    Had all particles guided starts, one estimate of the first row would be 3.6 nats too high.
    """
    steps, inputs = np.array([15, 16, 40, 70]), np.sin(np.arange(71) / 7.0)
    observed = np.array([[0.0, 1.0], [np.nan, np.nan], [5.0, 0.9], [1.0, 0.3]])
    for n_rows, n_seeds in [(1, 10_000), (4, 2_000)]:
        record = {"observed": observed[:n_rows], "steps": steps[:n_rows], "inputs": inputs}
        many = psf.log_likelihood(
            HOPPING, psf.BootstrapPF(300_000), {}, **record, seed=np.arange(4)
        ).sum(axis=1)
        assert many.std() < 0.02
        terms = psf.log_likelihood(
            HOPPING, psf.GuidedPF(100), {}, **record, seed=np.arange(n_seeds)
        )
        ratio = np.exp(terms.sum(axis=1) - np.log(np.exp(many).mean()))
        error = np.hypot(ratio.std() / np.sqrt(n_seeds), 0.01)
        assert abs(ratio.mean() - 1.0) < 3.0 * error
        assert ratio.max() < np.exp(1.5 if n_rows == 1 else 5.0)


def test_is_near_the_truth_on_a_record_with_surprises():
    """Where a bootstrap filter of a thousand particles is sixty nats low, without a warning."""
    record = double_well_with_surprises()
    given = double_well_parameters(PRECISE_DOUBLE_WELL)
    exact = PRECISE_DOUBLE_WELL.point_mass_filter().run(*record).terms.sum()
    terms = psf.log_likelihood(
        DOUBLE_WELL_SYSTEM, psf.GuidedPF(200), given, record.observed, steps=record.steps,
        seed=np.arange(10),
    )  # fmt: skip
    error = terms.sum(axis=1) - exact
    assert np.abs(error).max() < 2.5
    assert np.abs(error).mean() < 0.8
