"""``sample_dram(pilot=...)``: chains that begin with the draws of a posterior close by."""

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.sampling.kernel import proposal_mixture
from pymc_statespace_filters.sampling.kernel.independence import N_COMPONENTS, SHARE
from pymc_statespace_filters.sampling.run import population_search
from pymc_statespace_filters.sampling.run.model_task import ModelTask
from tests.kernels import with_kernel

RNG = np.random.default_rng(3)
N_CHAINS, N_DRAWS = 2, 30
SD = np.exp(RNG.normal(size=(N_CHAINS, N_DRAWS)))
PLACE = RNG.normal(size=(N_CHAINS, N_DRAWS, 2)) @ np.array([[1.0, 0.9], [0.0, 0.1]])


@pytest.fixture(scope="module")
def model():
    """A transform, a vector, and an order of variables that is not that of the alphabet."""
    with pm.Model() as model:
        sd = pm.HalfNormal("sd", 1)
        place = pm.Normal("place", 0, 1, shape=2)
        pm.Normal("y", place.sum(), sd, observed=[0.3, 1.2, 0.8])
    return model


def tree(**posterior):
    return az.from_dict({"posterior": {"place": PLACE, "sd": SD} | posterior})


def sample(model, **settings):
    defaults = {"draws": 40, "tune": 30, "chains": 2, "random_seed": 1}
    quiet = {"progressbar": False, "compute_convergence_checks": False}
    return psf.sample_dram(model=model, **with_kernel(defaults | quiet | settings))


def covariance():
    unconstrained = np.concatenate([np.log(SD)[..., None], PLACE], axis=-1).reshape(-1, 3)
    centred = unconstrained - unconstrained.mean(0)
    return 2.38**2 / 3 * centred.T @ centred / (len(centred) - 1)


def start(chain, draw):
    return {"sd": SD[chain, draw], "place": PLACE[chain, draw]}


@pytest.fixture
def walk_alone(monkeypatch):
    """Chains without independence proposals."""
    for module in (population_search, proposal_mixture):
        monkeypatch.setattr(module, "fitted_mixture", lambda *of: None)


@pytest.mark.usefixtures("walk_alone")
def test_chains_begin_at_the_ends_of_the_pilots_and_propose_by_its_covariance(model):
    found = sample(model, pilot=tree())
    told = sample(
        model,
        initvals=[start(0, -1), start(1, -1)],
        proposal_cov=found["sample_stats"]["proposal_cov"].values[0],
        adapt_every=1000,
    )
    np.testing.assert_allclose(
        found["sample_stats"]["proposal_cov"], np.broadcast_to(covariance(), (2, 3, 3))
    )
    for name in ("sd", "place"):
        np.testing.assert_array_equal(found["posterior"][name], told["posterior"][name])
    # The last digits are the processor's: a run that goes on elsewhere must ask for the same.
    for value in found["sample_stats"]["proposal_cov"].values[0].flat:
        assert value == float(f"{value:.12g}")


def test_a_pilot_that_ends_where_nothing_is_possible_is_named():
    with pm.Model() as bounded:
        place = pm.Normal("place", 0, 1, shape=2)
        pm.HalfNormal("sd", 1)
        pm.Potential("wall", pm.math.switch(place[0] > 10, 0.0, -np.inf))
    with pytest.raises(
        ModelError, match="a pilot of sample_dram whose chains ended at such points"
    ):
        sample(bounded, pilot=tree())


@pytest.mark.usefixtures("walk_alone")
@pytest.mark.parametrize("ends", [[29, 29, 19, 19, 9], [29, 29, 14]])
def test_more_chains_than_the_pilot_has_begin_apart(model, ends):
    still = {"tune": 1, "draws": 1, "discard_tuned_samples": False, "stages": 1}
    still["chains"] = len(ends)
    cov = covariance()
    found = sample(model, pilot=tree(), **still)
    ends = [(i % 2, draw) for i, draw in enumerate(ends)]
    told = sample(
        model, initvals=[start(*end) for end in ends], proposal_cov=cov, adapt_every=5, **still
    )
    for group in ("warmup_posterior", "posterior"):
        np.testing.assert_allclose(found[group]["place"], told[group]["place"], rtol=1e-9)


@pytest.mark.parametrize("asked", [{"adapt_every": 10}, {"adaptation": "continuous"}])
def test_who_asks_for_adaptation_gets_it(model, asked):
    found = sample(model, pilot=tree(), tune=200, **asked)
    last = found["sample_stats"]["proposal_cov"].values
    assert not np.allclose(last, covariance(), rtol=0.01)


@pytest.fixture(scope="module")
def walk(model):
    """A pilot by DRAM, whose chains have learnt something."""
    return sample(model, draws=200, tune=300)


def proposals(tree):
    return tree["sample_stats"]["proposal_cov"].values


def test_a_random_walk_goes_on_as_it_went(model, walk):
    assert not np.allclose(*proposals(walk), rtol=0.01)
    for asked in ({}, {"adapt_every": 1000}):
        found = sample(model, pilot=walk, **asked)["sample_stats"]["proposal_cov"].values
        np.testing.assert_allclose(found, np.broadcast_to(proposals(walk).mean(0), found.shape))


def with_proposals(walk, cov):
    found = walk.copy(deep=True)
    found["sample_stats"]["proposal_cov"][:] = cov
    return found


@pytest.mark.parametrize("strange", [1e4, 1e-6, np.nan])
def test_a_chain_that_has_learnt_nothing_does_not_count(model, walk, strange):
    cov = walk["sample_stats"]["proposal_cov"].values.copy()
    cov[1] *= strange
    found = sample(model, pilot=with_proposals(walk, cov))
    np.testing.assert_allclose(proposals(found)[0], proposals(walk)[0])
    none = sample(model, pilot=with_proposals(walk, cov[1]))
    drawn = [walk["posterior"]["place"].values[..., i].ravel() for i in range(2)]
    expected = 2.38**2 / 3 * np.cov([np.log(walk["posterior"]["sd"].values.ravel()), *drawn])
    np.testing.assert_allclose(proposals(none)[0], expected)


def test_variables_may_stand_in_another_order():
    scales = {"wide": 100.0, "narrow": 0.01}
    models = []
    for names in (["wide", "narrow"], ["narrow", "wide"]):
        with pm.Model() as model:
            for name in names:
                pm.Normal(name, 0, scales[name])
        models.append(model)
    found = proposals(sample(models[1], pilot=sample(models[0], draws=200, tune=300)))[0]
    sd = np.sqrt(found.diagonal())
    np.testing.assert_allclose(sd, [0.01 * 2.38 / 2**0.5, 100 * 2.38 / 2**0.5], rtol=0.5)


def test_statistics_of_another_shape_do_not_matter(model, walk):
    other = walk.copy()
    other["sample_stats"] = walk["sample_stats"].isel(draw=-1)
    assert np.isfinite(proposals(sample(model, pilot=other))).all()
    smaller = walk["sample_stats"].to_dataset().drop_vars("proposal_cov")
    smaller["proposal_cov"] = (("chain", "draw", "a", "b"), np.ones((2, 200, 2, 2)))
    other["sample_stats"] = xr.DataTree(smaller)
    assert proposals(sample(model, pilot=other)).shape == (2, 3, 3)


def test_draws_of_nuts_do(model):
    with model:
        nuts = pm.sample(200, tune=300, chains=2, random_seed=1, progressbar=False)
    found = sample(model, pilot=nuts, draws=4000, tune=0)
    for name in ("sd", "place"):
        mean, other = (t["posterior"][name].mean(("chain", "draw")) for t in (found, nuts))
        # Four standard errors of 300 independent draws, of unit scale at most: a false alarm in
        # ten thousand runs, were the seeds not fixed.
        np.testing.assert_allclose(mean, other, atol=4 / np.sqrt(300))
    # Hundreds of steps into the posterior are not needed: acceptance is that of a good proposal.
    assert 0.15 < found["sample_stats"]["accept"].mean() < 0.6


@pytest.mark.parametrize(
    ("pilot", "settings", "error", "message"),
    [
        (tree(), {"initvals": {"sd": 1.0}}, ModelError, "initvals must be None with a pilot"),
        (tree(), {"proposal_cov": np.eye(3)}, ModelError, "proposal_cov must be None with a pilot"),
        (3, {}, ModelError, "pilot: idata must be a DataTree"),
        (
            az.from_dict({"posterior": {"other": SD}}),
            {},
            DataMismatchError,
            r"pilot: idata must have draws of a free variable .*, sd, place, got \['other'\]",
        ),
        (tree(place=PLACE[..., :1]), {}, DataMismatchError, "pilot: 'place' in idata must have"),
        (
            az.from_dict({"posterior": {"place": PLACE[..., :1]}}),
            {},
            DataMismatchError,
            r"pilot: 'place' in idata must have the model's shape \(2,\), got \(1,\)",
        ),
        (az.from_dict({"posterior": {"sd": SD}}), {"tune": 0}, ModelError, "lacks free .* tune of"),
        (
            az.from_dict({"posterior": {"sd": -SD}}),
            {},
            DataMismatchError,
            "pilot: draws in idata must .*60 of 60 draws outside",
        ),
        (
            tree(sd=-SD),
            {},
            DataMismatchError,
            "pilot: draws in idata must .*60 of 60 draws outside",
        ),
        (tree(sd=np.ones_like(SD)), {}, ModelError, "constant or lie in a hyperplane"),
        (tree(place=PLACE[..., [0, 0]] * [1.0, 3.1]), {}, ModelError, "lie in a hyperplane"),
        (tree(sd=np.exp(PLACE @ [0.3, 0.7])), {}, ModelError, "lie in a hyperplane"),
    ],
)
def test_a_pilot_that_is_none_is_refused(model, pilot, settings, error, message):
    with pytest.raises(error, match=message):
        sample(model, pilot=pilot, **settings)


def test_a_run_is_taken_up_with_the_same_pilot_only(model, tmp_path):
    first = sample(model, pilot=tree(), checkpoint=tmp_path / "run")
    again = sample(model, pilot=tree(), checkpoint=tmp_path / "run")
    np.testing.assert_array_equal(first["posterior"]["sd"], again["posterior"]["sd"])
    with pytest.raises(DataMismatchError, match="initvals"):
        sample(model, pilot=tree(sd=2 * SD), checkpoint=tmp_path / "run")


def test_a_run_of_a_larger_model_is_taken_up_with_the_same_pilot_only(model, tmp_path):
    def pilot(place):
        return az.from_dict({"posterior": {"place": place}})

    first = sample(model, pilot=pilot(PLACE), checkpoint=tmp_path / "run")
    again = sample(model, pilot=pilot(PLACE), checkpoint=tmp_path / "run")
    np.testing.assert_array_equal(first["posterior"]["sd"], again["posterior"]["sd"])
    with pytest.raises(DataMismatchError, match=r"pilot: the checkpoint has .*null") as caught:
        sample(model, pilot=pilot(2 * PLACE), checkpoint=tmp_path / "run")
    assert "initvals" not in str(caught.value)


@pytest.fixture
def tasks(monkeypatch):
    """The tasks of the runs to come."""
    made = []

    class Watched(ModelTask):
        def __init__(self, *of):
            super().__init__(*of)
            made.append(self)

    monkeypatch.setattr("pymc_statespace_filters.sampling.run.driver.ModelTask", Watched)
    return made


@pytest.mark.parametrize("more", [{}, {"tune": 0}])
def test_a_mixture_is_fitted_to_the_pilots_draws_before_the_first_iteration(model, tasks, more):
    found = sample(model, pilot=tree(), random_seed=2, **more)
    unconstrained = np.concatenate([np.log(SD)[..., None], PLACE], axis=-1)
    rows = np.concatenate(np.swapaxes(unconstrained, 0, 1))
    np.testing.assert_allclose(tasks[0].searched.x, rows, rtol=1e-11)
    population = tasks[0].searched.x
    warm_up = population_search.WarmUp(
        tasks[0].request, population.shape[1], population, is_noisy=False
    )
    first = warm_up.mixture
    assert first[SHARE] == 0.5
    assert first[N_COMPONENTS] >= 2
    assert found["sample_stats"]["independent"].values.any()


def test_long_pilots_are_thinned_and_keep_all_chains(model, tasks):
    """Chains are told apart by their first component, draws by their second."""
    place = np.stack(np.broadcast_arrays(np.arange(4.0)[:, None], np.arange(1000.0)), axis=-1)
    place += 1e-3 * np.random.default_rng(1).normal(size=place.shape)
    sd = np.exp(np.random.default_rng(2).normal(size=(4, 1000)))
    sample(model, pilot=az.from_dict({"posterior": {"place": place, "sd": sd}}), draws=2, tune=8)
    kept = tasks[0].searched.x[:, 1:].round()
    assert kept.shape == (500, 2)
    np.testing.assert_array_equal(kept[:, 0], np.tile(np.arange(4), 125))
    np.testing.assert_array_equal(kept[:, 1], np.repeat(np.arange(7, 1000, 8), 4))


def test_variables_that_the_model_lacks_are_ignored(model):
    more = tree(other=PLACE[..., 0])
    for name in ("sd", "place"):
        np.testing.assert_array_equal(
            sample(model, pilot=more)["posterior"][name],
            sample(model, pilot=tree())["posterior"][name],
        )


def test_proposals_stay_where_a_short_warm_up_accepts_nothing(model):
    wide = 1e6 * PLACE
    wide[:, -1] = 0.0
    found = sample(model, pilot=tree(place=wide), stages=1)["sample_stats"]
    assert (found["accept"] < 1e-6).all()
    draws = np.concatenate([np.log(SD)[..., None], wide], axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(found["proposal_cov"][0], 2.38**2 / 3 * np.cov(draws.T))


def test_what_cannot_be_sampled_is_said_as_without_a_pilot():
    with pm.Model() as discrete:
        pm.Poisson("sd", 1.0)
    with pytest.raises(ModelError, match="these are discrete: sd"):
        sample(discrete, pilot=tree(sd=np.ones_like(SD)))
    with pm.Model() as nothing:
        pm.Normal("y", 0.0, 1.0, observed=[0.3])
    with pytest.raises(ModelError) as without:
        sample(nothing)
    with pytest.raises(ModelError) as caught:
        sample(nothing, pilot=tree())
    assert str(caught.value) == str(without.value)
