"""Terms at every draw: with the draw's own noise they add up to what the chain stored."""

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import halfnorm

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import EvidenceWarning, ModelError
from tests.diagnostics.records import SYSTEM
from tests.systems import PAIR, PAIR_DATA, STEPS, pair_terms

pytestmark = [
    pytest.mark.usefixtures("interpreted"),
    pytest.mark.filterwarnings("ignore:the terms of"),
]

RECORD = np.array([0.3, -0.2, np.nan, 0.9, 1.4])
AT = [0, 2, 3, 4, 7]


def noisy_model(**changes):
    """A vector and a positive number among the parameters, of which one sums the vector."""
    with pm.Model() as model:
        w = pm.Uniform("w", -0.5, 0.5, shape=2)
        pm.HalfNormal("spread", 1)
        settings = {"params": {"phi": w.sum()}, "steps": AT, "observed": RECORD} | changes
        psf.StateSpace("d", SYSTEM, psf.BootstrapPF(20), **settings)
    return model


@pytest.fixture(scope="module")
def model():
    return noisy_model()


@pytest.fixture(scope="module")
def idata(model):
    with model:
        return psf.sample_dram(60, tune=50, chains=2, random_seed=1, progressbar=False)


@pytest.fixture(scope="module")
def terms(model, idata):
    return psf.compute_log_likelihood(idata, model, extend_inferencedata=False)["log_likelihood"]


def log_prior(posterior):
    """On the unconstrained space, as stored log-densities are: Jacobians included."""
    w, spread = posterior["w"].values, posterior["spread"].values
    uniform = np.log((0.5 + w) * (0.5 - w))
    return uniform.sum(axis=-1) + halfnorm.logpdf(spread) + np.log(spread)


def test_terms_add_up_to_the_estimate_that_the_chain_stored(idata, terms):
    posterior = idata["posterior"]
    stored = idata["sample_stats"]["lp"].values - log_prior(posterior)
    np.testing.assert_allclose(terms["d"].sum("d_time"), stored, rtol=0, atol=1e-9)
    assert len(np.unique(idata["sample_stats"]["d_seed"])) > 5


@pytest.mark.filterwarnings("ignore:BootstrapPF")  # twenty particles are few
def test_each_term_is_that_of_the_likelihood_without_pymc(idata, terms):
    for chain, draw in ((0, 3), (1, 59)):
        at = {"chain": chain, "draw": draw}
        w, spread = (idata["posterior"][name].isel(at).values for name in ("w", "spread"))
        seed = idata["sample_stats"]["d_seed"].isel(at).item()
        params = {"phi": w.sum(), "spread": spread}
        expected = psf.log_likelihood(
            SYSTEM, psf.BootstrapPF(20), params, RECORD, steps=AT, seed=seed
        )
        np.testing.assert_allclose(terms["d"].isel(at), expected, rtol=1e-9)
    assert (terms["d"].isel(d_time=2) == 0).all()


def test_they_have_the_dimensions_and_coordinates_of_the_draws_and_the_record(idata, terms):
    assert terms["d"].dims == ("chain", "draw", "d_time")
    np.testing.assert_array_equal(terms["d_time"], AT)
    xr.testing.assert_equal(terms["chain"], idata["posterior"]["chain"])


def test_rows_set_after_sampling_must_reach_the_scored_ones(idata):
    with pm.Model() as model:
        w = pm.Uniform("w", -0.5, 0.5, shape=2)
        spread = pm.HalfNormal("spread", 1)
        steps, observed = pm.Data("at", AT), pm.Data("y", np.nan_to_num(RECORD)[:, None])
        psf.StateSpace(
            "d", SYSTEM, psf.BootstrapPF(20), params={"phi": w.sum(), "spread": spread},
            steps=steps, observed=observed, score_from=2,
        )  # fmt: skip
        new = {"at": [0, 2], "y": np.zeros((2, 1))}
        pm.set_data(new, coords={"d_time": [0, 2]})
    with pytest.raises(ModelError, match=r"score_from of 'd' must be less .* got 2 of 2"):
        psf.compute_log_likelihood(idata, model, new_data=True)


def test_they_say_that_they_are_sequential(terms, tmp_path):
    text = terms["d"].attrs["terms"]
    assert "d_1 .. d_{j-1}" in text
    assert "is invalid with such terms" in text
    terms.to_dataset().to_netcdf(tmp_path / "terms.nc")


@pytest.mark.filterwarnings("ignore:.*Pareto")
def test_arviz_passes_this_on(idata, terms):
    """It does not warn, and computes scores; a row that is missing has no term."""
    seen = terms.to_dataset().isel(d_time=[0, 1])
    posterior = idata["posterior"].to_dataset()
    tree = xr.DataTree.from_dict({"posterior": posterior, "log_likelihood": seen})
    assert az.loo(tree, pointwise=True).elpd_i.attrs["terms"] == terms["d"].attrs["terms"]


def test_pymc_gives_all_draws_one_seed(model, idata, terms):
    with pytest.warns(EvidenceWarning, match="the terms of a StateSpace variable are conditional"):
        of_pymc = pm.compute_log_likelihood(
            idata.copy(), model=model, progressbar=False, extend_inferencedata=False
        )
    assert np.abs(of_pymc["d"] - terms["d"]).max() > 0.1


def test_without_stored_seeds_the_models_own_was_held(idata):
    held = noisy_model(seed=5)
    draws = xr.DataTree.from_dict({"posterior": idata["posterior"].to_dataset()})
    found = psf.compute_log_likelihood(draws, held)["log_likelihood"]["d"]
    of_pymc = pm.compute_log_likelihood(
        idata.copy(), model=held, progressbar=False, extend_inferencedata=False
    )
    np.testing.assert_allclose(found, of_pymc["d"], rtol=1e-9)


def pairs():
    """Two records with common parameters."""
    with pm.Model() as model:
        a = pm.Normal("a")
        pm.Normal("b", 0.2)
        psf.StateSpace("first", PAIR, psf.EKF(), steps=STEPS, observed=PAIR_DATA)
        psf.StateSpace(
            "second", PAIR, psf.EKF(), params={"a": 2 * a}, steps=STEPS + 1, observed=-PAIR_DATA,
            dims=("time", "what"),
        )  # fmt: skip
    rng = np.random.default_rng(2)
    draws = {name: 0.3 * rng.standard_normal((2, 4)) for name in "ab"}
    return model, az.from_dict({"posterior": draws})


def test_all_state_space_variables_beside_what_others_have():
    model, idata = pairs()
    others = xr.Dataset({"y": ("i", [0.3]), "first": ("first_time", [0.1])})
    idata["log_likelihood"] = xr.DataTree(others)
    psf.compute_log_likelihood(idata, model)
    found = idata["log_likelihood"]
    assert set(found.data_vars) == {"first", "second", "y"}
    a, b = (idata["posterior"][name].values[1, 3] for name in "ab")
    at = {"chain": 1, "draw": 3}
    np.testing.assert_allclose(found["first"].isel(at), pair_terms(a, b), rtol=1e-9)
    expected = pair_terms(2 * a, b, observed=-PAIR_DATA, steps=STEPS + 1)
    np.testing.assert_allclose(found["second"].isel(at), expected, rtol=1e-9)
    assert found["second"].dims == ("chain", "draw", "time")


def test_one_variable_by_name():
    model, idata = pairs()
    found = psf.compute_log_likelihood(idata, model, var_name="second", extend_inferencedata=False)
    assert list(found["log_likelihood"].data_vars) == ["second"]
    assert "log_likelihood" not in idata.children
    with pytest.raises(ModelError, match=r"one of \['first', 'second'\], got 'y'"):
        psf.compute_log_likelihood(idata, model, var_name="y")


def test_moved_noise_has_no_terms(model, idata):
    moved = idata.copy()
    stats = moved["sample_stats"].to_dataset().drop_vars("d_seed")
    moved["sample_stats"] = xr.DataTree(stats.assign(correlation=stats["lp"] * 0 + 0.9))
    with pytest.raises(ModelError, match="moved along the chain"):
        psf.compute_log_likelihood(moved, model)


def test_draws_of_another_model_are_refused(model):
    idata = az.from_dict({"posterior": {"w": np.zeros((1, 3))}})
    with pytest.raises(ModelError, match="shape \\(2,\\) in the model, \\(\\) in"):
        psf.compute_log_likelihood(idata, model)
    idata = az.from_dict({"posterior": {"w": np.zeros((1, 3, 2))}})
    with pytest.raises(ModelError, match="no draws of 'spread'"):
        psf.compute_log_likelihood(idata, model)


def test_a_record_without_parameters_has_the_same_terms_at_every_draw():
    with pm.Model() as model:
        pm.Normal("c")
        psf.StateSpace(
            "d", PAIR, psf.EKF(), params={"a": 0.5, "b": 0.1}, steps=STEPS, observed=PAIR_DATA
        )
    idata = az.from_dict({"posterior": {"c": np.zeros((1, 3))}})
    found = psf.compute_log_likelihood(idata, model)["log_likelihood"]["d"]
    np.testing.assert_allclose(found, np.tile(pair_terms(0.5, 0.1), (1, 3, 1)), rtol=1e-9)


def test_it_is_said_that_terms_are_not_those_of_leave_one_out():
    with pm.Model() as model:
        pm.Normal("a")
        psf.StateSpace("d", PAIR, psf.EKF(), steps=STEPS, observed=PAIR_DATA)
    idata = az.from_dict({"posterior": {"a": np.full((1, 2), 0.5)}})
    with pytest.warns(EvidenceWarning, match=r"terms of 'd' .* no leave-one-out .*refit="):
        psf.compute_log_likelihood(idata, model, progressbar=False)
