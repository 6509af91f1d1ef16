"""Scores one step ahead: exact by quadrature, whoever finds them; and what draws cannot tell."""

import pickle

import arviz as az
import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.diagnostics import cross_validation as module
from pymc_statespace_filters.diagnostics.cross_validation import observed_values, truncate_data
from pymc_statespace_filters.errors import EvidenceWarning, ModelError
from pymc_statespace_filters.pymc_model.inspection import noise_seeds
from tests.diagnostics.records import (
    MISSING,
    SPREAD,
    STEPS,
    SYSTEM,
    log_evidences,
    model_with,
    noisy_draws,
    posterior_draws,
    record,
    scores,
)

pytestmark = pytest.mark.usefixtures("interpreted")

N = STEPS.size - 1  # rows that are seen


@pytest.fixture(scope="module")
def exact():
    return model_with(psf.EKF())


UNBIASED = psf.BootstrapPF(40)


@pytest.fixture(scope="module")
def noisy():
    return model_with(UNBIASED)


@pytest.fixture(scope="module")
def idata():
    return posterior_draws(STEPS.size, np.random.default_rng(1))


@pytest.fixture
def refit():
    """Exact draws for the record that a model has seen, and how long those were."""

    def draws(model):
        seen = np.flatnonzero(~np.isnan(observed_values(model, "d")).any(axis=1))
        lengths.append(seen.size)
        np.testing.assert_array_equal(seen, np.delete(np.arange(STEPS.size), MISSING)[: seen.size])
        return posterior_draws(int(seen[-1]) + 1, np.random.default_rng(2))

    lengths = draws.lengths = []
    return draws


def test_draws_of_the_whole_record_give_the_scores_of_its_end(exact, idata):
    """Draws are quantiles, so that what is left is the smoothing of the largest weights."""
    found = psf.leave_future_out(idata, exact, min_observations=16)
    np.testing.assert_allclose(found.elpd_i, scores()[16:], atol=1e-3)
    assert found.elpd == pytest.approx(scores()[16:].sum(), abs=2e-3)
    assert found.elpd == float(found.elpd_i.sum())
    np.testing.assert_array_equal(found.elpd_i["d_time"], STEPS[-7:])
    assert found.se == pytest.approx(np.sqrt(7 * scores()[16:].var()), rel=1e-2)
    assert (found.pareto_k < 0.5).all()
    # Parameters that know the whole record score better, by little.
    assert 0 < found.p < 0.2


def test_all_scores_together_are_the_log_evidence(exact, idata):
    """From the posterior back to the prior; the weights are as heavy as they may be."""
    found = psf.leave_future_out(idata, exact, min_observations=0)
    assert found.elpd == pytest.approx(log_evidences()[-1], abs=0.1)
    np.testing.assert_allclose(found.elpd_i, scores(), atol=0.03)


def test_refits_give_the_scores_of_the_whole_record(exact, idata, refit):
    found = psf.leave_future_out(idata, exact, min_observations=1, refit=refit)
    np.testing.assert_allclose(found.elpd_i, scores()[1:], atol=1e-3)
    assert refit.lengths == [1]
    assert isinstance(found, az.ELPDDataLFO)


def test_a_refit_wherever_weights_fail(exact, idata, refit, monkeypatch):
    monkeypatch.setattr(module, "largest_good_k", lambda n_draws: -3.0)
    found = psf.leave_future_out(idata, exact, min_observations=N - 4, refit=refit)
    np.testing.assert_allclose(found.elpd_i, scores()[-4:], atol=1e-5)
    assert refit.lengths == [N - 4, N - 3, N - 2, N - 1]
    assert list(found.refits) == [N - 3, N - 2, N - 1]


few_particles = pytest.mark.filterwarnings("ignore:.*fewer than 3 particles")


@few_particles
def test_an_unbiased_filter_has_the_scores_of_the_exact_one(noisy):
    """Draws of parameter and noise together, by weighting 20 000: errors seen below 0.05."""
    rng = np.random.default_rng(5)
    idata = noisy_draws(UNBIASED, STEPS.size, rng, (2, 1000))
    found = psf.leave_future_out(idata, noisy, min_observations=16)
    np.testing.assert_allclose(found.elpd_i, scores()[16:], atol=0.1)
    # With one noise for all, weights and draws do not belong together.
    del idata["sample_stats"]
    held = psf.leave_future_out(idata, noisy, min_observations=16)
    assert np.abs(held.elpd_i - scores()[16:]).max() > 0.1


@few_particles
def test_draws_of_an_unbiased_filter_for_a_shorter_record(noisy):
    """The same, forwards: noise of a shorter record goes on into the rest."""
    rng = np.random.default_rng(4)
    short = noisy_draws(UNBIASED, MISSING, rng, (2, 1000))
    found = psf.leave_future_out(short, noisy, min_observations=MISSING, refit=lambda model: short)
    np.testing.assert_allclose(found.elpd_i[:8], scores()[MISSING:][:8], atol=0.1)


def test_what_the_draws_cannot_tell_is_missing(exact):
    few = posterior_draws(STEPS.size, np.random.default_rng(1), (2, 50))
    with pytest.warns(EvidenceWarning, match=r"\d+ of the 21 scores are NaN") as caught:
        found = psf.leave_future_out(few, exact, min_observations=2)
    assert caught[0].filename == __file__
    unknown = found.pareto_k > found.good_k
    np.testing.assert_array_equal(np.isnan(found.elpd_i), unknown)
    assert np.isnan(found.elpd)
    assert found.warning
    enough = 2 + int(np.flatnonzero(unknown)[-1]) + 1
    assert f"set min_observations={enough}, or" in str(caught[0].message)
    assert np.isfinite(psf.leave_future_out(few, exact, min_observations=enough).elpd)
    # By default they begin there.
    default = psf.leave_future_out(few, exact)
    assert default.min_observations == enough
    np.testing.assert_array_equal(default.elpd_i, found.elpd_i[enough - 2 :])
    assert type(default) is az.ELPDDataLFO


def test_missing_scores_are_not_compared(exact, idata):
    """With an estimate of the complete scores beside it; without an error it would have won."""
    few = posterior_draws(STEPS.size, np.random.default_rng(1), (2, 50))
    with pytest.warns(EvidenceWarning, match="scores are NaN") as caught:
        found = psf.leave_future_out(few, exact, min_observations=2)
    complete = psf.leave_future_out(idata, exact, min_observations=2)
    first = int(found.elpd_i["d_time"][np.isnan(found.elpd_i)][0])
    for round_to in ("auto", "none"):
        with pytest.raises(ModelError) as refused:
            az.compare({"few": found, "many": complete}, round_to=round_to)
        assert f"some are missing (d_time {first}" in str(refused.value)
        assert str(caught[0].message) in str(refused.value)  # which names the remedies
    assert isinstance(found, az.ELPDDataLFO)
    assert "nan" in repr(found)
    assert "lfo" in repr(found)
    assert np.isnan(pickle.loads(pickle.dumps(found)).elpd)


@pytest.mark.filterwarnings("ignore:the terms of")
def test_stored_terms_are_used_if_they_are_sequential_and_ours(exact, idata):
    idata = idata.copy()
    psf.compute_log_likelihood(idata, exact)
    expected = psf.leave_future_out(idata, exact, min_observations=16).elpd
    idata["log_likelihood"]["d"] += 1.0
    assert psf.leave_future_out(idata, exact, min_observations=16).elpd == pytest.approx(
        expected + 7, rel=1e-9
    )
    idata["log_likelihood"]["d"].attrs.clear()
    assert psf.leave_future_out(idata, exact, min_observations=16).elpd == expected


def test_models_are_compared_by_arviz(exact, idata):
    found = psf.leave_future_out(idata, exact, min_observations=16)
    other = psf.leave_future_out(idata * 0.01, exact, min_observations=16)
    table = az.compare({"other": other, "found": found}, round_to="none")
    assert table.loc["found", "elpd"] == found.elpd
    assert table["elpd_diff"].iloc[1] == pytest.approx(-abs(found.elpd - other.elpd), rel=1e-9)
    shorter = psf.leave_future_out(idata, exact, min_observations=17)
    with pytest.raises(ValueError, match="same forecast_horizon and min_observations"):
        az.compare({"other": other, "shorter": shorter})


def test_a_shortened_model_differs_by_its_record_alone(noisy):
    short = truncate_data(noisy, "d", 10)
    np.testing.assert_array_equal(observed_values(short, "d")[:10, 0], record()[:10])
    assert np.isnan(observed_values(short, "d")[10:]).all()
    np.testing.assert_array_equal(observed_values(noisy, "d")[:, 0], record())
    assert short.coords == noisy.coords
    assert noise_seeds(short).keys() == {"d"}
    prior, point = short.compile_logp(vars=[short["phi"]]), {"phi": 0.5}
    params = {**point, "spread": SPREAD}
    terms = psf.log_likelihood(SYSTEM, UNBIASED, params, record()[:10], steps=STEPS[:10])
    expected = prior(point) + terms.sum()
    assert short.compile_logp()(point) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("given", [-1, N, 3.0])
def test_a_number_of_observations_that_leaves_nothing_is_refused(exact, idata, given):
    with pytest.raises(ModelError, match=f"from 0 to {N - 1}, as 'd' has {N} observations, got"):
        psf.leave_future_out(idata, exact, min_observations=given)


def test_a_refit_needs_an_observation(exact, idata, refit):
    for given in (0, None):
        with pytest.raises(ModelError, match=f"from 1 to {N - 1}"):
            psf.leave_future_out(idata, exact, min_observations=given, refit=refit)
