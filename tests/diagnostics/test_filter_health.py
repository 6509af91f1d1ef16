"""Predictions one step ahead: exact for linear systems; right models pass, wrong ones do not."""

import arviz as az
import numpy as np
import pymc as pm
import pytensor
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.diagnostics import filter_health
from pymc_statespace_filters.diagnostics.calibration import uniformity_of
from tests.diagnostics.records import SYSTEM
from tests.references.linear_states import linear_states
from tests.systems import PAIR, PAIR_DATA, STEPS, autoregression, counts, simulated

pytestmark = pytest.mark.usefixtures("interpreted")

TRUTH = {"phi": 0.7, "spread": 0.7}
LONG = np.arange(300)


def draws_at(shape=(2, 1000), **values):
    """A posterior that has one point."""
    return az.from_dict({"posterior": {k: np.full(shape, v) for k, v in values.items()}})


def diagnosed(system, filter, observed, steps, shape=(2, 100), **values):
    with pm.Model() as model:
        for name in values:
            pm.Normal(name)
        psf.StateSpace("d", system, filter, steps=steps, observed=observed)
    idata = psf.filter_diagnostics(draws_at(shape, **values), model, random_seed=1)
    return idata["filter_diagnostics"].to_dataset()


@pytest.fixture(scope="module")
def long_record():
    return simulated(LONG, 5, **TRUTH)


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(300), psf.GuidedPF(300)])
def test_predictions_of_a_linear_system_have_kalmans_law(filter):
    """Means and variances of 1000 draws within five standard errors: one seed in 10 000 fails."""
    noise = np.array([[0.5, 0.1], [0.1, 0.4]])
    A = np.array([[0.5, 0.2], [0.0, 0.8]])
    law = linear_states(
        A, np.diag([1.0, 0.5]), np.eye(2), noise, [0.0, 0.3], np.diag([1.0, 2.0]),
        steps=STEPS, observed=PAIR_DATA, rows=STEPS, moment="predicted",
    )  # fmt: skip
    variance = law.sd**2 + noise.diagonal()
    found = diagnosed(PAIR, filter, PAIR_DATA, STEPS, (2, 500), a=0.5, b=0.2)
    predicted = found["d_predicted"].values.reshape(1000, *PAIR_DATA.shape)
    z = (predicted.mean(axis=0) - law.mean) / np.sqrt(variance / 1000)
    assert np.abs(z).max() < 5
    of_variance = (predicted.var(axis=0) / variance - 1) / np.sqrt(2 / 1000)
    assert np.abs(of_variance).max() < 5
    # The two observables of a draw belong to one state.
    joint = np.mean(np.prod(predicted[:, 1] - law.mean[1], axis=-1))
    assert joint == pytest.approx(law.cov[1, 0, 1, 1] + 0.1, abs=0.3)


def test_guided_particles_do_not_know_what_they_predict():
    """Moved by the guide, all would be within the sensor's error of 0.01 of the observation."""
    system = autoregression(observation_noise=1e-4)
    steps = np.arange(1, 60, 3)
    observed = simulated(steps, 2, 0.9, 0.3, observation_noise=1e-4)
    found = diagnosed(system, psf.GuidedPF(200), observed, steps, (2, 500), phi=0.9, spread=0.3)
    # after an observation the state is known; three steps of variance 0.3^2 follow
    variance = 0.09 * (1 + 0.81 + 0.81**2)
    assert found["d_innovation_cov"].values[1:].ravel() == pytest.approx(variance, rel=0.2)
    assert found["d_innovation"].values[1:].std() == pytest.approx(variance**0.5, rel=0.35)


def test_the_group_has_its_dimensions_and_gaps_of_the_record():
    found = diagnosed(PAIR, psf.EKF(), PAIR_DATA, STEPS, a=0.5, b=0.2)
    assert found["d_predicted"].dims == ("chain", "draw", "d_time", "observable")
    assert found["d_n_effective"].dims == ("chain", "draw", "d_time")
    assert np.isposinf(found["d_n_effective"]).all()
    for name in ("d_pit", "d_residual"):
        assert found[name].dims == ("d_time", "observable")
        np.testing.assert_array_equal(np.isnan(found[name]), np.isnan(PAIR_DATA))
    assert found["d_coverage"].dims == ("interval", "observable")
    assert list(found["observable"].values) == ["position", "speed"]
    np.testing.assert_array_equal(found["d_time"], STEPS)
    assert found["d_failed"] == found["d_collapsed"] == 0
    assert "given all observations" in found.attrs["predictions"]


def test_a_long_record_takes_a_share_of_the_draws_and_says_so(long_record, monkeypatch):
    every = diagnosed(SYSTEM, psf.EKF(), long_record, LONG, **TRUTH)
    assert every.attrs["draws"] == "200 of 200"
    # Six numbers of each row: n = p = 1.
    monkeypatch.setattr(filter_health, "_MOST_NUMBERS", 100 * 6 * LONG.size)
    share = diagnosed(SYSTEM, psf.EKF(), long_record, LONG, **TRUTH)
    assert share.attrs["draws"] == "100 of 200"
    assert share["d_predicted"].shape[:2] == (2, 50)
    np.testing.assert_allclose(share["d_pit"], every["d_pit"], rtol=1e-10)
    monkeypatch.setattr(filter_health, "_MOST_NUMBERS", 1)
    assert diagnosed(SYSTEM, psf.EKF(), long_record, LONG, **TRUTH).attrs["draws"] == "40 of 200"


def test_a_right_model_passes(long_record):
    """Two p-values below 0.001: one seed in 500."""
    found = diagnosed(SYSTEM, psf.EKF(), long_record, LONG, **TRUTH)
    assert found["d_uniformity"].item() > 1e-3
    assert found["d_whiteness"].item() > 1e-3
    # Four standard deviations of the binomial law.
    off = found["d_coverage"].values[:, 0] - [0.5, 0.9]
    assert (np.abs(off) < [0.115, 0.07]).all()
    assert found["d_residual"].std() == pytest.approx(1.0, abs=0.16)


def test_half_the_noise_is_too_little(long_record):
    found = diagnosed(SYSTEM, psf.EKF(), long_record / 0.5, LONG, **TRUTH)
    assert found["d_uniformity"].item() < 1e-4
    assert found["d_coverage"].sel(interval=0.9).item() < 0.8


def test_missing_dynamics_leave_autocorrelation(long_record):
    found = diagnosed(SYSTEM, psf.EKF(), long_record, LONG, phi=0.0, spread=1.0)
    assert found["d_whiteness"].item() < 1e-4


def test_counts():
    """The p-value of a right model is below 0.001 for one seed in 1000."""
    steps = np.arange(150)
    seen = psf.simulate(counts(), {"level": 0.3}, steps=steps, random_seed=3)["observations"].values
    assert np.unique(seen).size < 12  # many ties
    found = diagnosed(counts(), psf.BootstrapPF(1000), seen, steps, (1, 200), level=0.3)
    assert (found["d_predicted"] % 1 == 0).all()
    assert found["d_uniformity"].item() > 1e-3
    # The share of predictions below the datum alone, or not above it, is far from uniform.
    predicted = found["d_predicted"].values[0]
    for share in ((predicted < seen).mean(axis=0), (predicted <= seen).mean(axis=0)):
        assert uniformity_of(np.clip(share[:, 0], 1e-3, 1 - 1e-3)) < 1e-4


@pytest.fixture(scope="module")
def noisy():
    observed = [0.3, -0.2, 1.8, 0.9]  # the third is a surprise
    with pm.Model() as model:
        pm.Uniform("phi", -1, 1)
        known = {"spread": 0.7}
        psf.StateSpace(
            "d", SYSTEM, psf.BootstrapPF(20), params=known, steps=range(4), observed=observed
        )
        idata = psf.sample_dram(50, tune=50, chains=2, random_seed=1, progressbar=False)
    return model, idata


def test_the_effective_number_is_that_of_each_draws_own_estimate(noisy):
    model, idata = noisy
    with pytest.warns(psf.errors.FilterWarning, match="fewer than 3 particles"):
        found = psf.filter_diagnostics(idata, model, random_seed=1, extend_inferencedata=False)
    assert "filter_diagnostics" not in idata.children
    found = found["filter_diagnostics"]
    smallest = found["d_n_effective"].min("d_time")
    np.testing.assert_allclose(smallest, idata["sample_stats"]["n_effective"], rtol=1e-9)
    assert found["d_collapsed"] == (smallest < 3).mean()
    assert 0 < found["d_collapsed"] < 1


def test_another_filter_fewer_draws_and_the_same_again(noisy):
    model, idata = noisy
    one, two = (
        psf.filter_diagnostics(idata.copy(), model, filter=psf.EKF(), n_draws=20, random_seed=4)
        for _ in range(2)
    )
    one, two = (tree["filter_diagnostics"].to_dataset() for tree in (one, two))
    assert one.equals(two)
    assert one.sizes["draw"] == 10
    assert np.isinf(one["d_n_effective"]).all()


def test_failures_are_counted():
    """In machine code, with particles."""
    with (
        pytensor.config.change_flags(mode="NUMBA"),
        pytest.warns(psf.errors.FilterWarning, match="in 10 of 10 evaluations"),
    ):
        found = diagnosed(
            SYSTEM, psf.BootstrapPF(20), [0.1, 0.2, 1e200, 0.3], np.arange(4), (1, 10), **TRUTH
        )
    assert found["d_failed"] == 1
    for name in ("d_predicted", "d_pit", "d_residual"):
        failed = np.isnan(found[name]).any(set(found[name].dims) - {"d_time"})
        np.testing.assert_array_equal(failed, [False, False, True, True])


def test_pictures_read_it(long_record):
    with pm.Model() as model:
        for name in TRUTH:
            pm.Normal(name)
        psf.StateSpace("d", SYSTEM, psf.EKF(), steps=LONG, observed=long_record)
    idata = psf.filter_diagnostics(draws_at((1, 100), **TRUTH), model, random_seed=1)
    psf.plot_filter_health(idata, backend="none")
    az.plot_ecdf_pit(
        idata, var_names="d_pit", group="filter_diagnostics", sample_dims=["d_time"], backend="none"
    )
