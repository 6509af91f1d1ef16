"""A filter at fixed parameters: the run of the likelihood itself, with the states that it knew."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

import pymc_statespace_filters as psf
from tests.filters.test_ensemble_states import states
from tests.references.linear_states import linear_states
from tests.systems import DOUBLE_WELL_SYSTEM, FORCE, FORCED, FORCED_DATA, PAIR, PAIR_DATA, STEPS

POINT = {"a": 0.7}
MEMBERS = {
    "enkf": psf.EnKF(60),
    "bootstrap": psf.BootstrapPF(60, resample_below=1.0),
    "pf_enkf": psf.PFEnKF(60),
}
ROWS = {"observations": STEPS, "steps": np.arange(7)}


def run(filter, **changes):
    return psf.run_filter(PAIR, filter, POINT, PAIR_DATA, **{"steps": STEPS} | changes)


def exact(rows):
    return linear_states(
        [[0.7, 0.2], [0.0, 0.8]], np.diag([1.0, 0.5]), np.eye(2), [[0.5, 0.1], [0.1, 0.4]],
        [0.0, 0.3], np.diag([1.0, 2.0]),
        steps=STEPS, observed=PAIR_DATA, rows=rows, moment="filtered",
    )  # fmt: skip


def exact_cov(rows):
    return np.einsum("iaib->iab", exact(rows).cov)


@pytest.mark.parametrize("at", ROWS)
@pytest.mark.parametrize("filter", [psf.EKF(), *MEMBERS.values()], ids=["ekf", *MEMBERS])
def test_it_is_the_very_run_of_the_likelihood(filter, at):
    terms = psf.log_likelihood(PAIR, filter, POINT, PAIR_DATA, steps=STEPS, seed=5)
    np.testing.assert_array_equal(run(filter, seed=5, at=at)["log_likelihood"], terms)


@pytest.mark.parametrize("at", ROWS)
def test_ekf_has_the_exact_law_of_a_linear_system(at):
    found = run(psf.EKF(), at=at)
    np.testing.assert_allclose(found["mean"], exact(ROWS[at]).mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found["cov"], exact_cov(ROWS[at]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found["sd"], exact(ROWS[at]).sd, rtol=1e-9)
    assert "particles" not in found


@pytest.mark.parametrize("at", ROWS)
@pytest.mark.parametrize("name", MEMBERS)
def test_moments_are_those_of_the_weighted_particles_and_of_filtered_states(name, at):
    found = run(MEMBERS[name], seed=3, at=at)
    x, w = found["particles"].values, found["weights"].values
    np.testing.assert_allclose(w.sum(axis=1), 1.0, rtol=1e-12)
    mean = np.einsum("ti,tia->ta", w, x)
    np.testing.assert_allclose(found["mean"], mean, rtol=1e-10, atol=1e-12)
    covs = [np.cov(x[t].T, aweights=w[t]) for t in range(len(x))]
    np.testing.assert_allclose(found["cov"], covs, rtol=1e-9, atol=1e-12)
    filtered = states("filtered", MEMBERS[name], rows=ROWS[at], seed=3)
    np.testing.assert_allclose(found["mean"], filtered.mean, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(found["sd"], filtered.sd, rtol=1e-12)


def test_weights_are_those_from_before_resampling():
    found = run(MEMBERS["bootstrap"], at="steps")
    # At step 0 the particles are draws of the prior, and weighted by the density of what was seen.
    noise, seen = np.array([[0.5, 0.1], [0.1, 0.4]]), PAIR_DATA[0]
    residual = seen - found["particles"].values[0]
    density = np.exp(-0.5 * np.einsum("ia,ab,ib->i", residual, np.linalg.inv(noise), residual))
    np.testing.assert_allclose(found["weights"][0], density / density.sum(), rtol=1e-9)
    np.testing.assert_allclose(found["weights"][1], 1 / 60, rtol=1e-12)  # resampled since


def test_coordinates_are_times():
    found = run(MEMBERS["enkf"], steps=None, times=2.0 + STEPS, t0=2.0, at="steps")
    assert found["time"].values.tolist() == [2, 3, 4, 5, 6, 7, 8]
    assert found["obs_time"].values.tolist() == (2.0 + STEPS).tolist()
    assert found["cov"].dims == ("time", "state", "state_bis")
    assert found["state"].values.tolist() == list(PAIR.states)
    assert found.attrs["filter"] == repr(MEMBERS["enkf"])


PAIR_START = multivariate_normal([0.0, 0.3], [[1.5, 0.1], [0.1, 2.4]])


@pytest.mark.parametrize(
    ("filter", "system", "observed", "inputs", "first"),
    [
        *((f, PAIR, PAIR_DATA, None, PAIR_START) for f in (psf.EKF(), *MEMBERS.values())),
        (psf.GridFilter(), FORCED, FORCED_DATA, FORCE, norm(0.0, np.sqrt(1.5))),
    ],
    ids=["ekf", *MEMBERS, "grid"],
)
def test_a_failure_leaves_what_was_known_before_it(filter, system, observed, inputs, first):
    impossible = observed.copy()
    impossible[1] *= 1e200  # its square is infinite
    with pytest.warns(psf.errors.FilterWarning, match="-inf"):
        found = psf.run_filter(
            system, filter, POINT, impossible, steps=STEPS, inputs=inputs, at="steps"
        )
    assert found["log_likelihood"].values[1:].tolist() == [-np.inf] * 3
    np.testing.assert_allclose(found["log_likelihood"][0], first.logpdf(observed[0]), atol=0.2)
    if "filter_state" in found:
        assert np.isnan(found["filter_state"]).all()
    for name in found.data_vars.keys() - {"log_likelihood", "filter_state"}:
        assert np.isfinite(found[name][:2]).all()  # the second observation is at step 2
        assert np.isnan(found[name][2:]).all()


def test_where_no_particle_is_finite_the_state_is_unknown():
    # Steps of a steep cubic drift explode, long before the observation that fails.
    steep = {"alpha": 0.0, "beta": -1000.0, "sigma": 10.0}
    steep |= {"noise_var": 0.1, "initial_mean": 1.0, "initial_var": 0.1}
    with pytest.warns(psf.errors.FilterWarning, match="overflowed or became NaN"):
        found = psf.run_filter(
            DOUBLE_WELL_SYSTEM, psf.BootstrapPF(50), steep, [1.0, 1.0], steps=[0, 30], at="steps"
        )
    assert not np.isfinite(found["particles"][29]).any()
    assert (found["weights"][29] == 0.0).all()
    assert np.isnan(found["mean"][29:]).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"at": "always"}, r"at must be one of \['observations', 'steps'\], got 'always'"),
        ({"seed": [1, 2]}, r"takes one seed, got an array of \(2,\)"),
        ({"seed": 0.5}, "seed must be an integer, got 0.5"),
        ({"steps": STEPS[:3]}, r"observed must have shape \(3, 2\)"),
        ({"params": {"a": [0.1, 0.2]}}, r"one value per parameter, got arrays of \(2,\)"),
        ({"params": {}}, "a"),
        ({"filter": "ekf"}, "filter must be a filter"),
        ({"filter": psf.GridFilter()}, "GridFilter treats systems of one state"),
        ({"inputs": [1.0]}, "inputs must be None for a system without inputs"),
    ],
)
def test_refusals(changes, message):
    arguments = {"filter": psf.EKF(), "params": POINT, "steps": STEPS} | changes
    filter, params = arguments.pop("filter"), arguments.pop("params")
    with pytest.raises(psf.errors.ModelError, match=message):
        psf.run_filter(PAIR, filter, params, PAIR_DATA, **arguments)
