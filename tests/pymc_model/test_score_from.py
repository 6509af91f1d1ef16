"""`score_from`: rows that a filter passes through and that are not scored."""

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence.observed_data import (
    data_fingerprint,
    observation_count,
    observed_in,
    scalar_count,
)
from tests.systems import FORCE, FORCED, FORCED_DATA, STEPS, forced_terms

pytestmark = pytest.mark.usefixtures("interpreted")

# Row 2 is missing.
A = 0.6


def model_of(score_from, filter=None, **changes):
    record = {"steps": STEPS, "observed": FORCED_DATA, "inputs": FORCE} | changes
    with pm.Model() as model:
        pm.Normal("a", 0.5, 1.0)
        psf.StateSpace("d", FORCED, filter or psf.EKF(), score_from=score_from, **record)
    return model


def terms_of(model):
    (terms,) = model.compile_logp([model["d"]], sum=False)({"a": A})
    return terms


@pytest.mark.parametrize("score_from", [0, 1, 2, 3, np.int64(1)])
def test_the_terms_of_earlier_rows_are_zero_and_those_of_later_rows_stay(score_from):
    exact = forced_terms(A)
    exact[:score_from] = 0.0
    np.testing.assert_allclose(terms_of(model_of(score_from)), exact, rtol=1e-12)


@pytest.mark.parametrize("filter", [psf.GridFilter(), psf.BootstrapPF(64)])
def test_every_filter_goes_on_as_if_all_rows_were_scored(filter):
    everything, later = terms_of(model_of(0, filter)), terms_of(model_of(1, filter))
    assert later[0] == 0.0
    np.testing.assert_array_equal(later[1:], everything[1:])


def test_the_gradient_is_that_of_the_terms_that_count():
    h = 1e-6
    up, down = (forced_terms(A + s)[1:].sum() for s in (h, -h))
    gradient = model_of(1).compile_dlogp()({"a": A})
    prior = -(A - 0.5)
    np.testing.assert_allclose(gradient - prior, (up - down) / (2 * h), rtol=1e-6)


@pytest.mark.parametrize("wrong", [-1, 4, 1.0, True, None, "1"])
def test_a_number_that_leaves_nothing_or_is_none_is_refused(wrong):
    with pytest.raises(ModelError, match=rf"score_from must be an integer from 0 to 3.*{wrong!r}"):
        model_of(wrong)


def test_other_records_by_set_data():
    with pm.Model() as model:
        pm.Data("a", A)
        record = {
            "steps": pm.Data("steps", STEPS),
            "inputs": pm.Data("force", FORCE[:, None]),
            "observed": pm.Data("y", np.zeros((4, 1))),
        }
        psf.StateSpace("d", FORCED, psf.EKF(), score_from=2, **record)
    logp = model.compile_logp([model["d"]], sum=False)
    for n_rows in (3, 5):
        steps, y = np.arange(n_rows), np.linspace(-1, 1, n_rows)[:, None]
        with model:
            pm.set_data({"steps": steps, "y": y})
        exact = forced_terms(A, observed=y, steps=steps)
        exact[:2] = 0.0
        np.testing.assert_allclose(logp({})[0], exact, rtol=1e-12)
    with model:
        pm.set_data({"steps": np.arange(2), "y": np.zeros((2, 1))})
    with pytest.raises(ModelError, match="score_from must be less than the number of observations"):
        logp({})


def draws(values):
    return xr.DataTree.from_dict(
        {"posterior": xr.Dataset({"a": (("chain", "draw"), np.atleast_2d(values))})}
    )


@pytest.mark.filterwarnings("ignore:the terms of")
def test_pointwise_terms_draws_and_diagnostics():
    model, idata = model_of(1), draws([A, 0.2])
    terms = psf.compute_log_likelihood(idata, model, progressbar=False)["log_likelihood"]["d"]
    np.testing.assert_allclose(terms[0, 0, 1:], forced_terms(A)[1:], rtol=1e-12)
    assert (terms[..., 0] == 0.0).all()
    drawn = pm.draw(model["d"], 2, random_seed=1)
    assert drawn.shape == (2, 4, 1)
    assert np.isfinite(drawn).all()
    found = psf.filter_diagnostics(idata, model, random_seed=1, progressbar=False)
    pit = found["filter_diagnostics"]["d_pit"].values[:, 0]
    np.testing.assert_array_equal(np.isnan(pit), [True, False, True, False])


def test_cross_validation_scores_the_later_rows():
    """Two rows are scored, of four of which one is missing and one is before them."""
    values = np.random.default_rng(1).normal(0.5, 0.1, (4, 300))
    score = psf.leave_future_out(draws(values), model_of(1), min_observations=0)
    np.testing.assert_array_equal(score.elpd_i["d_time"], STEPS[[1, 3]])
    with pytest.raises(ModelError, match="from 0 to 1, as 'd' has 2 observations"):
        psf.leave_future_out(draws(values), model_of(1), min_observations=2)


def test_the_evidence_counts_scored_rows_and_compares_equal_numbers_of_them():
    models = model_of(0), model_of(1), model_of(2), model_of(1, psf.GridFilter())
    everything, later, last, other = map(observed_in, models)
    assert (observation_count(everything), observation_count(later)) == (3, 2)
    assert (scalar_count(everything), scalar_count(later)) == (3, 2)
    assert data_fingerprint(later) == data_fingerprint(other)
    assert data_fingerprint(later) != data_fingerprint(everything)
    assert data_fingerprint(later) != data_fingerprint(last)
