"""Diagnostics of a panel: those of a variable for each record, and scores of whole records."""

import arviz as az
import numpy as np
import pymc as pm
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.special import logsumexp

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from tests.diagnostics.records import PHI, PRIOR, SPREAD, SYSTEM
from tests.systems import simulated

pytestmark = pytest.mark.usefixtures("interpreted")

ROWS = np.array([1, 2, 4, 7])
LABELS = ["A", "B", "C", "D", "E", "F"]
RECORDS = np.array(
    [simulated(ROWS, i, phi=0.7, spread=SPREAD) for i in range(len(LABELS))]
).reshape(len(LABELS), -1)
RECORDS[1, 2] = np.nan


def panel(filter, **options):
    with pm.Model() as model:
        pm.Normal("phi", *PRIOR.args)
        psf.StateSpace(
            "d",
            SYSTEM,
            filter,
            params={"spread": SPREAD},
            panel=np.repeat(LABELS, ROWS.size),
            steps=np.tile(ROWS, len(LABELS)),
            observed=RECORDS.reshape(-1, 1),
            **options,
        )
    return model


def log_likelihoods():
    """Of every record at every point of PHI."""
    params = {"phi": PHI, "spread": SPREAD}
    return np.array(
        [
            psf.log_likelihood(SYSTEM, psf.EKF(), params, record, steps=ROWS).sum(axis=1)
            for record in RECORDS
        ]
    )


def posterior_draws(rng):
    """Quantiles of phi given all records: draws without their scatter."""
    log_joint = PRIOR.logpdf(PHI) + log_likelihoods().sum(axis=0)
    below = cumulative_trapezoid(np.exp(log_joint - log_joint.max()), PHI, initial=0)
    levels = rng.permutation((np.arange(4000) + 0.5) / 4000)
    phi = np.interp(levels, below / below[-1], PHI)
    return az.from_dict({"posterior": {"phi": phi.reshape(4, 1000)}})


def test_leaving_out_a_record_is_exact():
    """Of all records, those of the five others by quadrature: within .003 nats with 4000 draws."""
    idata = psf.compute_log_likelihood(posterior_draws(np.random.default_rng(1)), panel(psf.EKF()))
    assert idata["log_likelihood"]["d"].dims == ("chain", "draw", "d_record")
    assert "log p(record | theta)" in idata["log_likelihood"]["d"].attrs["terms"]
    loo = az.loo(idata, pointwise=True)
    of_records = log_likelihoods()
    joint = PRIOR.logpdf(PHI) + of_records.sum(axis=0)
    expected = logsumexp(joint) - logsumexp(joint - of_records, axis=1)
    np.testing.assert_allclose(loo.elpd_i, expected, atol=0.003)
    assert list(loo.elpd_i["d_record"].values) == LABELS
    # Scores given parameters that know the record are too high.
    assert (logsumexp(joint + of_records, axis=1) - logsumexp(joint) - expected > 0.01).any()


def test_terms_of_records_add_up_to_the_estimates_that_the_chain_stored():
    """Also where every record keeps a seed of its own, and rows that do not count."""
    with panel(psf.BootstrapPF(20), score_from=1) as model:
        idata = psf.sample_dram(40, tune=20, chains=2, random_seed=1, progressbar=False)
    found = psf.compute_log_likelihood(idata, model)["log_likelihood"]["d"].sum("d_record")
    stored = idata["sample_stats"]["lp"] - PRIOR.logpdf(idata["posterior"]["phi"])
    np.testing.assert_allclose(found, stored, rtol=0, atol=1e-9)
    with pm.Model() as model:
        phi = pm.Normal("phi", 0.4, 0.4, shape=len(LABELS))
        psf.StateSpace(
            "d", SYSTEM, psf.BootstrapPF(20), params={"phi": phi, "spread": SPREAD},
            panel=np.repeat(LABELS, ROWS.size), steps=np.tile(ROWS, len(LABELS)),
            observed=RECORDS.reshape(-1, 1),
        )  # fmt: skip
        idata = psf.sample_dram(40, tune=20, chains=2, random_seed=1, progressbar=False)
    assert idata["sample_stats"]["d_seed"].sizes["d_record"] == len(LABELS)
    found = psf.compute_log_likelihood(idata, model)["log_likelihood"]["d"].sum("d_record")
    prior = PRIOR.logpdf(idata["posterior"]["phi"]).sum(axis=-1)
    np.testing.assert_allclose(found, idata["sample_stats"]["lp"] - prior, rtol=0, atol=1e-9)


@pytest.mark.parametrize("filter", [psf.EKF(), psf.BootstrapPF(500)])
def test_each_record_is_diagnosed_as_if_alone(filter):
    idata = posterior_draws(np.random.default_rng(1)).isel(draw=slice(50))
    found = psf.filter_diagnostics(idata, panel(filter), random_seed=2)["filter_diagnostics"]
    assert found["d_pit"].dims == ("d_obs", "observable")
    assert found["d_autocorrelation"].dims == ("d_record", "lag", "observable")
    assert found["d_uniformity"].dims == ("d_record", "observable")
    assert found["d_failed"].dims == ("d_record",)
    np.testing.assert_array_equal(found["d_panel"], np.repeat(LABELS, ROWS.size))
    for g in (0, 1, 5):  # the first, the one with a missing row, and the last
        record = RECORDS[g]
        with pm.Model() as model:
            pm.Normal("phi", *PRIOR.args)
            psf.StateSpace(
                "d", SYSTEM, filter, params={"spread": SPREAD}, steps=ROWS, observed=record
            )
        alone = psf.filter_diagnostics(idata, model, random_seed=3)["filter_diagnostics"]
        rows, known = slice(4 * g, 4 * g + 4), ~np.isnan(record)
        assert (np.isnan(found["d_residual"].values[rows, 0]) == ~known).all()
        if filter.noisy:  # draws of their own: 50 of them, whose median is within .5 sd
            shift = (found["d_residual"].values[rows] - alone["d_residual"].values)[known]
            assert np.abs(shift).max() < 0.5
        else:
            for name in ("d_pit", "d_residual", "d_innovation", "d_innovation_cov"):
                np.testing.assert_array_equal(found[name].values[rows], alone[name].values)
            for name in ("d_coverage", "d_autocorrelation", "d_failed", "d_whiteness"):
                np.testing.assert_array_equal(found[name].values[g], alone[name].values)


def test_records_of_other_lengths_have_other_lags():
    """NaN where a record is too short for the lag."""
    steps = [np.arange(1, 41), np.arange(1, 9)]
    with pm.Model() as model:
        pm.Normal("phi", *PRIOR.args)
        psf.StateSpace(
            "d", SYSTEM, psf.EKF(), params={"spread": SPREAD}, panel=[1] * 40 + [2] * 8,
            steps=np.concatenate(steps),
            observed=np.concatenate([simulated(at, 1, phi=0.7, spread=SPREAD) for at in steps]),
        )  # fmt: skip
    idata = posterior_draws(np.random.default_rng(1)).isel(draw=slice(50))
    found = psf.filter_diagnostics(idata, model)["filter_diagnostics"]["d_autocorrelation"]
    assert np.isfinite(found).sum("lag").values.ravel().tolist() == [10, 2]


def test_a_panel_has_no_common_future():
    with pytest.raises(ModelError, match=r"panel 'd' has no common future .* az.loo"):
        psf.leave_future_out(
            posterior_draws(np.random.default_rng(1)), panel(psf.EKF()), min_observations=2
        )
