"""Whole chains as a DataTree: the one that ``pm.sample`` gives, at a small share of its price."""

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling import DRAM
from pymc_statespace_filters.sampling.output import deterministics
from pymc_statespace_filters.sampling.output.datatree import to_datatree
from pymc_statespace_filters.sampling.output.deterministics import BLOCK, Deterministics
from pymc_statespace_filters.sampling.target.variables import RaveledVariables
from tests.modes import AS_IT_STANDS
from tests.sampling.test_dram import sample
from tests.systems import autoregression

TUNE, DRAWS = 30, 40


def raveled_of(model):
    return RaveledVariables(model.value_vars, model.initial_point(0))


def rich_model():
    """Transforms, dims, data, an empty variable, and discrete Deterministics in one."""
    with pm.Model(coords={"place": ["here", "there", "beyond"]}) as model:
        weight = pm.Data("weight", [0.5, 1.0, 1.5], dims="place")
        level = pm.Normal("level", 0, 2, dims="place")
        pm.Normal("nothing", shape=(0,))
        spread = pm.HalfNormal("spread", 1.0)
        share = pm.Uniform("share", -1, 3)
        simplex = pm.Dirichlet("simplex", np.ones(3), dims="place")
        ordered = pm.distributions.transforms.ordered
        pm.Normal("steps", 0, 2, shape=2, transform=ordered, initval=[-1.0, 1.0])
        total = pm.Deterministic("total", (weight * level * simplex).sum() / spread)
        pm.Deterministic("twice", 2 * total)
        pm.Deterministic("above", level > share, dims="place")
        pm.Deterministic("whole", pt.floor(share).astype("int64"))
        pm.Deterministic("table", level[:, None] * np.ones(2), dims=("place", None))
        pm.Deterministic("constant", pt.arange(3) + 1.0)
        pm.Normal("y", level, spread, observed=[0.1, 1.2, -0.7], dims="place")
    return model


def chains_of(tree, model):
    """The chains behind a tree that has warm-up and transformed values."""
    stats_of = [tree[group].dataset for group in ("warmup_sample_stats", "sample_stats")]
    values_of = [tree[group].dataset for group in ("warmup_posterior", "posterior")]
    chains = []
    for chain in range(tree["posterior"].sizes["chain"]):
        values = {
            v.name: np.concatenate([ds[v.name][chain].to_numpy() for ds in values_of])
            for v in model.value_vars
        }
        columns = [np.reshape(array, (TUNE + DRAWS, -1)) for array in values.values()]
        stats = {
            name: np.concatenate([ds[name][chain].to_numpy() for ds in stats_of])
            for name in stats_of[0].data_vars
        }
        chains.append((np.concatenate(columns, axis=1), stats))
    return chains


@pytest.fixture(scope="module")
@pytensor.config.change_flags(mode=AS_IT_STANDS)
def sampled():
    """A model, the tree by ``pm.sample``, and the chains behind it."""
    with rich_model() as model:
        tree = sample(
            DRAM(),
            draws=DRAWS,
            tune=TUNE,
            discard_tuned_samples=False,
            idata_kwargs={"include_transformed": True},
        )
    chains = chains_of(tree, model)
    for group in ("posterior", "warmup_posterior"):
        ds = tree[group].to_dataset()
        tree[group] = xr.DataTree(ds[[name for name in ds.data_vars if not name.endswith("__")]])
    return model, tree, chains


def stored_once(tree):
    """A tree of ``pm.sample`` without the copies of what is constant after the warm-up."""
    stats = tree["sample_stats"].to_dataset()
    if "proposal_cov" in stats and "draw" in stats["proposal_cov"].dims:
        tree = tree.copy()
        frozen = stats["proposal_cov"].isel(draw=-1, drop=True)
        tree["sample_stats"] = xr.DataTree(stats.assign(proposal_cov=frozen))
    return tree


def assert_same(found, expected):
    """Groups, names, dimensions, coordinates, dtypes, attributes and values."""
    expected = stored_once(expected)
    assert set(found.children) == set(expected.children)
    for group in expected.children:
        # NumPy and machine code may differ in the last bits.
        xr.testing.assert_allclose(
            found[group].to_dataset(), expected[group].to_dataset(), rtol=1e-12, atol=1e-12
        )
        for name, array in expected[group].variables.items():
            assert found[group][name].dtype == array.dtype, name
        assert set(found[group].dims) == set(expected[group].dims)
        assert found[group].attrs.keys() == expected[group].attrs.keys()
    assert list(found["posterior"].data_vars) == list(expected["posterior"].data_vars)


def test_equals_the_tree_of_pm_sample(sampled):
    model, expected, chains = sampled
    found = to_datatree(
        model, raveled_of(model), [*chains], tune=TUNE, keep_warmup=True, sampling_time=1.5
    )
    assert_same(found, expected)
    assert {"posterior", "warmup_posterior", "constant_data"} < set(found.children)
    for group in ("posterior", "warmup_posterior", "sample_stats", "warmup_sample_stats"):
        assert found[group].attrs["tuning_steps"] == TUNE
        assert found[group].attrs["sampling_time"] == 1.5


def test_warmup_is_left_out_on_request(sampled):
    model, expected, chains = sampled
    found = to_datatree(
        model,
        raveled_of(model),
        [*chains],
        tune=TUNE,
        keep_warmup=False,
        sampling_time=1.5,
        attrs={"threads": 2},
    )
    expected = xr.DataTree.from_dict(
        {name: ds.to_dataset() for name, ds in expected.children.items() if "warmup" not in name}
    )
    for group in ("posterior", "sample_stats"):
        assert found[group].attrs.pop("threads") == 2
    assert_same(found, expected)
    assert found["posterior"].attrs["tuning_steps"] == TUNE


def normal_model():
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 10)
        sigma = pm.HalfNormal("sigma", 2)
        pm.Deterministic("ratio", mu / sigma)
        pm.Normal("y", mu, sigma, observed=[1.2, 0.7, 2.9, 1.8])
    return model


def some_chains(*lengths, dim=2, **stats):
    rng = np.random.default_rng(7)
    return [
        (
            rng.normal(size=(n, dim)),
            {"lp": rng.normal(size=n)}
            | {k: np.broadcast_to(v, (n, *v.shape)) for k, v in stats.items()},
        )
        for n in lengths
    ]


@pytest.mark.parametrize(
    ("lengths", "keep_warmup", "chosen", "warmup", "draws"),
    [
        ((50, 50), True, [0, 1], 20, 30),
        ((50, 50), False, [0, 1], 0, 30),
        ((50, 45), False, [0, 1], 0, 25),  # 2 x 25 draws beat 30
        ((21, 50, 49), False, [1, 2], 0, 29),  # 2 x 29 beat 3 x 1
        ((0, 50, 0, 12), False, [1], 0, 30),
        ((12, 15), True, [0, 1], 12, 0),
        ((20, 20), True, [0, 1], 20, 0),
    ],
)
def test_interrupted_chains(lengths, keep_warmup, chosen, warmup, draws):
    model, chains = normal_model(), some_chains(*lengths)
    tree = to_datatree(
        model, raveled_of(model), [*chains], tune=20, keep_warmup=keep_warmup, sampling_time=1.0
    )
    begin = 0 if keep_warmup else 20
    for group, n, start in (("warmup_", warmup, begin), ("", draws, begin + warmup)):
        assert (f"{group}posterior" in tree.children) == (n > 0)
        assert (f"{group}sample_stats" in tree.children) == (n > 0)
        for place, i in enumerate(chosen if n else []):
            cut = slice(start, start + n)
            mu, lp = tree[f"{group}posterior"]["mu"], tree[f"{group}sample_stats"]["lp"]
            np.testing.assert_array_equal(mu[place], chains[i][0][cut, 0])
            np.testing.assert_array_equal(lp[place], chains[i][1]["lp"][cut])
            assert len(mu) == len(chosen)


@pytest.mark.parametrize(("lengths", "keep_warmup"), [((20, 3), False), ((0, 0), True)])
def test_nothing_to_return(lengths, keep_warmup):
    model = normal_model()
    message = rf"after {lengths[0]}, {lengths[1]} iterations, of which 20"
    with pytest.raises(ModelError, match=message):
        to_datatree(
            model,
            raveled_of(model),
            some_chains(*lengths),
            tune=20,
            keep_warmup=keep_warmup,
            sampling_time=1.0,
        )


def test_what_is_the_same_for_all_draws_is_stored_once_a_chain():
    model = normal_model()
    cov = np.array([[2.0, 0.5], [0.5, 1.0]])
    first, second = some_chains(50, 50, proposal_cov=cov)
    second[1]["proposal_cov"] = np.broadcast_to(3 * cov, (50, 2, 2))
    arguments = {"tune": 20, "keep_warmup": True, "sampling_time": 1.0}
    tree = to_datatree(model, raveled_of(model), [first, second], **arguments)
    for group, n in (("sample_stats", 30), ("warmup_sample_stats", 20)):
        found = tree[group]["proposal_cov"]
        if group == "sample_stats":
            assert found.dims == ("chain", "proposal_cov_dim_0", "proposal_cov_dim_1")
            np.testing.assert_array_equal(found, [cov, 3 * cov])
        else:
            np.testing.assert_array_equal(found, np.array([[cov] * n, [3 * cov] * n]))
            assert found.to_numpy().strides[1] == 0
    # Written out in full, the same tree.
    for _, stats in (first, second):
        stats["proposal_cov"] = stats["proposal_cov"].copy()
    assert_same(tree, to_datatree(model, raveled_of(model), [first, second], **arguments))


def checked(model, positions):
    """Quantities of a model, compared with PyMC's own function of a point."""
    raveled = raveled_of(model)
    found = Deterministics(model, raveled)(positions)
    wanted = [v for v in model.unobserved_value_vars if not v.name.endswith("__")]
    reference = model.compile_fn(
        wanted, inputs=model.value_vars, point_fn=False, on_unused_input="ignore"
    )
    assert list(found) == [v.name for v in wanted]
    for i in {0, 1, len(positions) // 2, len(positions) - 1}:
        values = reference(**raveled.unravel(positions[i]))
        for name, value in zip(found, values, strict=True):
            assert found[name].shape == (len(positions), *np.shape(value)), name
            assert found[name].dtype == np.asarray(value).dtype, name
            np.testing.assert_allclose(found[name][i], value, rtol=1e-13, err_msg=name)
    return found


def test_quantities_of_many_blocks_with_repeated_positions():
    """More than two blocks of distinct positions, some repeated, and among them the last."""
    model = normal_model()
    distinct = np.random.default_rng(1).normal(size=(2 * BLOCK + 1, 2))
    repeats = np.random.default_rng(2).integers(1, 4, size=len(distinct))
    repeats[-1] = 3
    positions = np.repeat(distinct, repeats, axis=0)
    found = checked(model, positions)
    np.testing.assert_array_equal(found["mu"], positions[:, 0])
    np.testing.assert_allclose(found["ratio"], positions[:, 0] / np.exp(positions[:, 1]))


def test_a_repeated_position_is_not_evaluated_again():
    model = normal_model()
    quantities = Deterministics(model, raveled_of(model))
    evaluate, seen = quantities._evaluators[0], []

    class Watched:
        names = evaluate.names

        def __call__(self, positions):
            seen.append(len(positions))
            return evaluate(positions)

    quantities._evaluators[0] = Watched()
    # The same first coordinate is another position; coming back is one, too.
    quantities(np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 2.0], [1.0, 0.0], [1.0, 0.0]]))
    assert seen == [3]


def test_sums_of_many_terms_and_of_truth_values():
    with pm.Model() as model:
        a, b, c = (pm.Normal(name) for name in "abc")
        pm.Deterministic("sum", a + b + c + 2.0)
        pm.Deterministic("product", a * b * c * 3.0)
        pm.Deterministic("count", pt.add(a > 0, b > 0, c > 0, pt.constant(0)))
        pm.Deterministic("nested", (a > 0) + ((b > 0) + 1))
        pm.Deterministic("number", pt.add(a > 0, b > 0, c))
    found = checked(model, np.random.default_rng(3).normal(size=(50, 3)))
    assert found["count"].max() == 3


def test_numbers_are_as_stable_as_in_pm_sample():
    with pm.Model() as model:
        x = pm.Normal("x")
        pm.Deterministic("refusal", pt.log(1 - pt.sigmoid(x)))
        pm.Deterministic("small", pt.log(1 + pt.exp(-x) * 1e-30))
        pm.Deterministic("total", pt.stack([x, pt.log(x)]).sum())
    found = checked(model, np.array([[800.0], [1.0], [0.0], [-1.0]]))
    assert found["refusal"][0] == -800.0


def test_nothing_is_compiled_for_simple_models(monkeypatch):
    monkeypatch.setattr(deterministics, "_PerPosition", None)
    model = normal_model()
    assert Deterministics(model, raveled_of(model)).names == ["mu", "sigma", "ratio"]


def test_one_by_one_with_and_without_machine_code(monkeypatch):
    monkeypatch.setattr(deterministics, "_is_vectorizable", lambda graph: False)
    model = normal_model()
    with model:
        data = pm.Data("data", [1.0, 2.0])
        pm.Deterministic("scaled", data * model["mu"])
    positions = np.repeat(np.random.default_rng(4).normal(size=(5, 2)), 2, axis=0)
    fast = checked(model, positions)
    with pytensor.config.change_flags(mode="FAST_COMPILE"):
        slow = checked(model, positions)
    for name in fast:
        np.testing.assert_allclose(fast[name], slow[name], rtol=1e-13)


def test_random_quantities_are_drawn_at_every_position():
    with pm.Model() as model:
        x = pm.Normal("x")
        pm.Deterministic("noisy", pm.Normal.dist(x, 1.0))
    found = Deterministics(model, raveled_of(model))(np.arange(50.0)[:, None])
    assert np.unique(found["noisy"]).size == 50
    assert np.abs(found["noisy"] - found["x"]).max() < 6.0


@pytest.fixture(scope="module")
@pytensor.config.change_flags(mode=AS_IT_STANDS)
def state_space():
    """A quantity computed from a likelihood, and a tree of some draws."""
    system = autoregression(spread=0.5**0.5)
    steps = np.arange(1, 9)
    data = np.array([[0.3, 0.5, -0.1, 0.4, 0.9, 0.2, -0.3, 0.1]]).T
    with pm.Model() as model:
        pm.Normal("phi", 0.5, 0.3)
        d = psf.StateSpace("d", system, psf.EKF(), steps=steps, observed=data)
        pm.Deterministic("log_likelihood_of_d", pm.logp(d, data).sum())
    positions = np.random.default_rng(5).normal(0.5, 0.2, size=(2, 300, 1))
    logp = model.compile_logp()
    chains = [(p, {"lp": np.array([logp({"phi": x[0]}) for x in p])}) for p in positions]
    tree = to_datatree(
        model, raveled_of(model), [*chains], tune=100, keep_warmup=False, sampling_time=1.0
    )
    return model, tree


@pytest.mark.filterwarnings("ignore:the terms of a StateSpace variable")
@pytensor.config.change_flags(mode=AS_IT_STANDS)
def test_terms_of_a_tree_are_those_of_a_quantity_of_the_model(state_space):
    """What else is done with a tree, `test_sample_dram` does."""
    model, tree = state_space
    with model:
        pm.compute_log_likelihood(tree, var_names=["d"], progressbar=False)
    np.testing.assert_allclose(
        tree["log_likelihood"]["d"].sum("d_time"), tree["posterior"]["log_likelihood_of_d"]
    )
