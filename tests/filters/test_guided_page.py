"""GuidedPF: what every ensemble filter promises, and its behaviour at the edges."""

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.ops.base import evaluator
from pymc_statespace_filters.ops.likelihood import LogLikelihoodOfNoise, StoredNoise
from pymc_statespace_filters.testing import kalman_log_likelihood
from tests.references.records import (
    BROAD_DOUBLE_WELL,
    DOUBLE_WELL,
    PRECISE_DOUBLE_WELL,
    broad_double_well,
    double_well,
    double_well_with_surprises,
)
from tests.systems import (
    DOUBLE_WELL_SYSTEM,
    double_well_parameters,
)

WELL = double_well_parameters(BROAD_DOUBLE_WELL)


def well_record(n=8):
    record = broad_double_well()
    return {"observed": record.observed[:n].copy(), "steps": record.steps[:n]}


def log_likelihood(filter, record, given=WELL, seed=0):
    return psf.log_likelihood(DOUBLE_WELL_SYSTEM, filter, given, **record, seed=seed)


def test_stored_normals_give_what_their_seed_gives_and_small_moves_little():
    """Correlated pseudo-marginal chains rest on the second statement."""
    filter = psf.GuidedPF(100, resampling="sorted", resample_below=1.0)
    record = well_record()
    theta = np.array([WELL[name] for name in DOUBLE_WELL_SYSTEM.parameters])
    observed, no_inputs = record["observed"][:, None], np.zeros((0, 0))
    normals = evaluator(StoredNoise(DOUBLE_WELL_SYSTEM, filter))
    evaluate = evaluator(LogLikelihoodOfNoise(DOUBLE_WELL_SYSTEM, filter))

    def estimate(z):
        return evaluate(theta, record["steps"], observed, no_inputs, 0.0, z)[0]

    (stored,) = normals(record["steps"], 3)
    assert np.array_equal(estimate(stored), log_likelihood(filter, record, seed=3))
    moved, other = [], []
    for seed in range(4, 24):
        (fresh,) = normals(record["steps"], seed)
        there = estimate(0.999 * stored + np.sqrt(1.0 - 0.999**2) * fresh)
        moved.append(there.sum() - estimate(stored).sum())
        other.append(estimate(fresh).sum() - estimate(stored).sum())
    assert np.std(moved) < 0.3 * np.std(other)


def test_a_wholly_missing_row_is_as_if_it_were_not_there():
    filter, record = psf.GuidedPF(50), well_record()
    record["observed"][[2, 5]] = np.nan
    seen = ~np.isnan(record["observed"])
    terms = log_likelihood(filter, record)
    without = log_likelihood(filter, {name: value[seen] for name, value in record.items()})
    assert terms[~seen].tolist() == [0.0, 0.0]
    assert terms[seen] == pytest.approx(without, abs=1e-10)


@pytest.mark.filterwarnings("ignore::pymc_statespace_filters.errors.FilterWarning")
def test_no_estimate_is_far_too_high_where_the_state_crosses_unseen():
    """With all particles guided, the highest of these seeds is 2.2 nats too high."""
    record = double_well()
    sparse = {"observed": record.observed[::5], "steps": record.steps[::5]}
    given = double_well_parameters(DOUBLE_WELL)
    exact = log_likelihood(psf.GridFilter(), sparse, given).sum()
    terms = log_likelihood(psf.GuidedPF(200), sparse, given, seed=np.arange(700, 1000))
    assert terms.sum(axis=1).max() - exact < 1.5


def test_nothing_observed_moves_particles_by_their_own_noise():
    record = well_record(4)
    record["observed"][:] = np.nan
    assert log_likelihood(psf.GuidedPF(50), record).tolist() == [0.0] * 4
    runs = [
        psf.run_filter(DOUBLE_WELL_SYSTEM, filter, WELL, **record, seed=5)
        for filter in (psf.GuidedPF(50), psf.BootstrapPF(50))
    ]
    assert np.allclose(runs[0]["particles"], runs[1]["particles"], atol=1e-12)
    assert np.allclose(runs[0]["weights"], 1 / 50)


def test_equations_that_explode_leave_the_particles_unguided():
    """Starts far out overflow within a few steps; others stay in a well and have weight."""
    record = {"observed": np.array([1.0, 1.1]), "steps": np.array([20, 40])}
    wild = WELL | {"alpha": 4.0, "beta": -4.0, "sigma": 0.6, "noise_var": 0.1}
    wild |= {"initial_mean": 0.0, "initial_var": 144.0}
    terms = log_likelihood(psf.GuidedPF(200), record, wild, seed=np.arange(20)).sum(axis=1)
    assert np.isfinite(terms).all()
    exact = log_likelihood(psf.BootstrapPF(200_000), record, wild).sum()
    assert np.log(np.exp(terms).mean()) == pytest.approx(exact, abs=1.0)
    lost = wild | {"initial_mean": 1e3, "initial_var": 0.5}
    with pytest.warns(psf.errors.FilterWarning, match="overflowed or became NaN"):
        assert log_likelihood(psf.GuidedPF(50), record, lost).tolist() == [-np.inf, -np.inf]


def test_carried_states_are_taken_from_the_reference():
    """A carried switch picks one of two linear systems; it is known, so the estimate is exact."""

    def transition(x, q):
        return [pm.math.switch(x[1] > 0, 0.9, 0.2) * x[0] + q[0], x[1]]

    switched = psf.StateSpaceModel(
        transition=transition, process_noise=[[0.2]], observation=lambda x: [x[0]],
        observation_noise=[[0.05]], initial_mean=[0.0, 1.0], initial_cov=np.diag([1.0, 0.0]),
        states=["x", "on"], carried=["on"],
    )  # fmt: skip
    record = {"observed": np.array([0.3, 2.5, 0.1]), "steps": np.array([0, 2, 5])}
    exact = kalman_log_likelihood(
        [[0.9]], [[0.2]], [[1.0]], [[0.05]], [0.0], [[1.0]], **record
    ).sum()
    terms = psf.log_likelihood(switched, psf.GuidedPF(10), {}, **record, seed=np.arange(3))
    assert terms.sum(axis=1) == pytest.approx(exact, abs=1e-9)


def test_does_not_warn_where_it_is_right():
    """The weights are uneven by design; those given the whole record count."""
    record = double_well_with_surprises()
    given = double_well_parameters(PRECISE_DOUBLE_WELL)
    with pytest.warns(psf.errors.FilterWarning):
        log_likelihood(psf.BootstrapPF(500), record._asdict(), given)
    log_likelihood(psf.GuidedPF(500), record._asdict(), given)
