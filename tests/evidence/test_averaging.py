"""Averages over models: exact moments of the mixture, where its draws are from, what is refused."""

import arviz as az
import numpy as np
import pytest
import xarray as xr
from scipy.integrate import quad
from scipy.special import expit
from scipy.stats import norm

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence import Evidence, average_models, compare_evidence
from pymc_statespace_filters.evidence.comparison.averaging import _systematic_counts

X = xr.DataArray([-1.0, 0.5, 2.0], dims="x", coords={"x": [-1.0, 0.5, 2.0]})


def draws(seed, name="k", chains=2, count=25):
    values = np.random.default_rng(seed).normal(seed, 1.0, (chains, count))
    return az.from_dict({"posterior": {name: values}})


def evidence(log_evidence, se):
    return Evidence(log_evidence, se, "bridge", 2, 20, -5.0, "same")


def slope(posterior):
    return posterior["k"]


def line(posterior):
    return posterior["k"] * X


TWO = {"a": draws(1), "b": draws(4)}


def test_moments_are_those_of_the_mixture():
    # 250 and 750 draws of the mixture are 5 and 15 copies of every draw: nothing is left to chance.
    average = average_models(TWO, {"a": 1, "b": 3}, slope, n_draws=1000, random_seed=1)
    mean = {name: idata["posterior"]["k"].mean().item() for name, idata in TWO.items()}
    variance = {name: idata["posterior"]["k"].var().item() for name, idata in TWO.items()}
    of_mean = 0.25 * mean["a"] + 0.75 * mean["b"]
    within = 0.25 * variance["a"] + 0.75 * variance["b"]
    between = 0.25 * (mean["a"] - of_mean) ** 2 + 0.75 * (mean["b"] - of_mean) ** 2
    np.testing.assert_allclose(average["posterior"]["k"].mean(), of_mean, rtol=1e-12)
    np.testing.assert_allclose(average["posterior"]["k"].var(), within + between, rtol=1e-12)


def test_form_of_the_result():
    average = average_models(TWO, {"a": 1, "b": 1}, line, n_draws=70, random_seed=1)
    mixture, members = average["posterior"], average["members"]
    assert dict(mixture["line"].sizes) == {"chain": 1, "draw": 70, "x": 3}
    assert mixture["model"].dims == ("chain", "draw")
    assert dict(members["line"].sizes) == {"model": 2, "chain": 1, "draw": 50, "x": 3}
    assert list(members["model"].values) == ["a", "b"]
    for group in (mixture, members):
        xr.testing.assert_equal(group["x"], X["x"])


def test_every_draw_is_a_whole_one_of_the_model_that_it_names():
    average = average_models(TWO, {"a": 1, "b": 2}, line, n_draws=60, random_seed=1)["posterior"]
    for draw in average["draw"]:
        one = average.sel(chain=0, draw=draw)
        source = TWO[one["model"].item()]["posterior"]["k"].values
        curves = source.reshape(-1, 1) * X.values
        assert (curves == one["line"].values).all(axis=1).sum() == 1


def test_models_are_mingled():
    model = average_models(TWO, {"a": 1, "b": 1}, slope, n_draws=400, random_seed=1)["posterior"]
    first_half = (model["model"].values[0, :200] == "a").sum()
    assert 60 < first_half < 140  # 100 with standard deviation 5: an unshuffled mixture has 200


def test_members_have_equal_numbers_of_draws_none_twice():
    models = {"a": draws(1), "b": draws(4, count=40)}
    members = average_models(models, {"a": 1, "b": 1}, slope, random_seed=1)["members"]["k"]
    assert members.sizes["draw"] == 50
    for name, idata in models.items():
        values = members.sel(model=name).values.ravel()
        assert len(set(values)) == 50
        assert set(values) <= set(idata["posterior"]["k"].values.ravel())
    # Evenly along the chains: both give as many.
    of_first_chain = np.isin(members.sel(model="b"), models["b"]["posterior"]["k"][0]).sum()
    assert of_first_chain == 25


def test_weight_of_zero():
    for order in (["a", "b"], ["b", "a"]):
        models = {name: TWO[name] for name in order}
        average = average_models(models, {"a": 0, "b": 0.1}, slope, n_draws=200, random_seed=1)
        assert set(average["posterior"]["model"].values.ravel()) == {"b"}
        assert set(average["members"]["model"].values) == {"a", "b"}


def test_one_model():
    average = average_models({"a": TWO["a"]}, {"a": 5}, slope, n_draws=50, random_seed=1)
    np.testing.assert_array_equal(
        np.sort(average["posterior"]["k"].values.ravel()),
        np.sort(TWO["a"]["posterior"]["k"].values.ravel()),
    )


def test_errors_of_the_evidences_move_the_probabilities():
    table = compare_evidence({"a": evidence(-10, 1.5), "b": evidence(-8, 0.5)})
    average = average_models(TWO, table, slope, n_draws=1000, random_seed=1)
    sd = np.hypot(1.5, 0.5)
    expected = quad(lambda z: expit(-2 + sd * z) * norm.pdf(z), -10, 10)[0]
    found = average["members"]["prob"].sel(model="a").item()
    # 50 000 normals, and a probability whose standard deviation is below 0.2: five of its errors.
    assert abs(found - expected) < 5 * 0.2 / np.sqrt(50_000)
    assert abs((average["posterior"]["model"] == "a").sum().item() - 1000 * found) <= 1
    assert expected > expit(-2) + 0.05  # and without the errors it would be another number


def test_table_without_errors_and_mapping_agree():
    table = compare_evidence({"a": evidence(-10, 0.0), "b": evidence(-8, 0.0)})
    of_table = average_models(TWO, table, line, random_seed=3)
    of_mapping = average_models(TWO, dict(table["prob"]), line, random_seed=3)
    xr.testing.assert_equal(of_table, of_mapping)
    np.testing.assert_allclose(of_table["members"]["prob"], [expit(-2), expit(2)])


def test_same_seed_same_average():
    table = compare_evidence({"a": evidence(-10, 1.5), "b": evidence(-8, 0.5)})
    one, same, other = (average_models(TWO, table, slope, random_seed=s) for s in (1, 1, 2))
    xr.testing.assert_identical(one, same)
    assert not one.equals(other)


def test_numbers_of_draws_are_systematic():
    prob, rng = np.array([0.36, 0.29, 0.35]), np.random.default_rng(4)
    counts = np.array([_systematic_counts(prob, 10, rng) for _ in range(2000)])
    assert (counts.sum(axis=1) == 10).all()
    assert (np.abs(counts - 10 * prob) < 1).all()
    # On average as probable: standard deviations below 1/2, so that the errors are below 0.012.
    np.testing.assert_allclose(counts.mean(axis=0), 10 * prob, atol=0.05)


def test_function_of_each_model_and_of_other_draws():
    forecast = xr.DataArray(np.arange(6.0).reshape(1, 6), dims=("chain", "draw"), name="k")
    average = average_models(
        {"a": TWO["a"], "b": draws(2, name="c")},
        {"a": 1, "b": 1},
        {"a": slope, "b": lambda posterior: forecast},
        n_draws=12,
        random_seed=1,
    )["posterior"]
    of_forecast = average["k"].where(average["model"] == "b", drop=True).values.ravel()
    np.testing.assert_array_equal(np.sort(of_forecast), np.arange(6.0))


def test_dims_in_another_order():
    average = average_models(
        TWO,
        {"a": 1, "b": 1},
        {"a": line, "b": lambda posterior: line(posterior).transpose("x", "draw", "chain")},
        random_seed=1,
    )
    same = average_models(TWO, {"a": 1, "b": 1}, {"a": line, "b": line}, random_seed=1)
    xr.testing.assert_equal(average, same)


def test_names():
    def name_of(function):
        average = average_models(TWO, {"a": 1, "b": 1}, function, random_seed=1)
        (name,) = average["posterior"].data_vars
        assert list(average["members"].data_vars) == [name]
        return name

    assert name_of(slope) == "k"  # as the array
    assert name_of(line) == "line"  # as the function, if the array has no name
    assert name_of(lambda posterior: line(posterior).rename("force")) == "force"
    assert name_of(lambda posterior: line(posterior)) == "average"
    assert name_of({"a": line, "b": line}) == "average"
    assert name_of({"a": slope, "b": lambda posterior: slope(posterior).rename("c")}) == "average"
    assert name_of(lambda posterior: line(posterior).rename("x")) == "average"  # it is taken


def test_arviz_takes_it_and_it_can_be_stored(tmp_path):
    average = average_models(TWO, {"a": 1, "b": 3}, line, random_seed=1)
    assert list(az.summary(average)["mean"].index) == [f"line[{x}]" for x in (-1.0, 0.5, 2.0)]
    assert az.hdi(average)["line"].sizes["ci_bound"] == 2
    az.plot_forest(average, backend="none")
    average.to_netcdf(tmp_path / "average.nc")
    xr.testing.assert_equal(xr.open_datatree(tmp_path / "average.nc").load(), average)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"idatas": {}}, "idatas must be a mapping of model names to DataTree"),
        ({"idatas": {"a": 3}}, r"idatas\['a'\] must be a DataTree with a group 'posterior'"),
        ({"weights": {"a": 1}}, r"exactly the models \['a', 'b'\], got \['a'\]"),
        ({"weights": {"a": 1, "b": 1, "c": 1}}, r"got \['a', 'b', 'c'\]"),
        ({"weights": {"a": 1, "b": -1}}, "weights must be finite and >= 0.*'b': "),
        ({"weights": {"a": 0, "b": 0}}, "one of them > 0"),
        ({"weights": [1, 1]}, "weights must be the table of compare_evidence or a mapping"),
        (
            {"weights": compare_evidence({"a": evidence(-9, np.nan), "b": evidence(-8, 0.1)})},
            "standard error for every model, got NaN for 'a': pass dict",
        ),
        ({"function": {"a": slope}}, r"function must be given for exactly the models"),
        ({"function": lambda posterior: 3.0}, "must return a DataArray.* got 3.0 for model 'a'"),
        ({"function": lambda posterior: posterior["k"].mean("chain")}, "'chain' and 'draw'"),
        ({"function": lambda posterior: posterior["k"].expand_dims(model=1)}, "without 'model'"),
        ({"function": {"a": slope, "b": line}}, "for 'a' and 'b' arrays of different dims"),
        ({"function": {"a": line, "b": lambda p: line(p)[..., 1:]}}, "length along 'x', 3, 2"),
        (
            {"function": {"a": line, "b": lambda p: line(p).assign_coords(x=[1.0, 2.0, 3.0])}},
            "'a' and 'b' arrays with different coordinates along 'x'",
        ),
        (
            {"function": {"a": line, "b": lambda p: line(p).drop_vars("x")}},
            "different coordinates along 'x'",
        ),
        ({"n_draws": 0}, "n_draws must be an integer of at least 1, got 0"),
    ],
)
def test_what_is_refused(change, message):
    good = {"idatas": TWO, "weights": {"a": 1, "b": 1}, "function": slope}
    with pytest.raises(ModelError, match=message):
        average_models(**(good | change))


def test_an_error_inside_the_function_names_the_model():
    with pytest.raises(KeyError, match="k") as caught:
        average_models({"a": TWO["a"], "b": draws(1, name="c")}, {"a": 1, "b": 1}, slope)
    assert caught.value.__notes__ == ["raised by function with the posterior of model 'b'"]


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("k", "function must be callable, got 'k' for model 'a'"),
        (lambda post: post["k"].isel(draw=slice(0)), "must return draws, got none for model 'a'"),
        (lambda post: post["k"].assign_coords(model="mine"), "without 'model'"),
    ],
)
def test_functions_of_no_use_are_refused(function, message):
    with pytest.raises(ModelError, match=message):
        average_models(TWO, {"a": 1, "b": 1}, function)


@pytest.mark.parametrize("name", ["model", "level"])
def test_an_array_named_as_a_dim_takes_the_name_of_the_function(name):
    def named(posterior):
        return posterior["k"].expand_dims(level=2).rename(name)

    average = average_models(TWO, {"a": 1, "b": 1}, named, n_draws=10)
    assert list(average["posterior"].data_vars) == ["named"]
