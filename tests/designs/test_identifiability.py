"""What records of a design can say, against closed forms and analysis by hand."""

from functools import cache

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.designs.dummy_data import with_dummy_data
from pymc_statespace_filters.designs.fisher_information import (
    Coordinates,
    Likelihood,
    normal_covariance,
)
from pymc_statespace_filters.designs.identifiability_table import Expected, table_of
from pymc_statespace_filters.designs.weak_directions import (
    combination_label,
    determined_combinations,
    precision,
    weak_directions,
)
from pymc_statespace_filters.errors import DataMismatchError, ModelError

pytestmark = pytest.mark.usefixtures("interpreted")

U = np.linspace(-1.0, 2.0, 40)[:, None]


def line(noise=0.5):
    """A straight line with known noise; `slope` is a sum of two parameters."""
    return psf.StateSpaceModel(
        transition=lambda x: [x[0]],
        observation=lambda x, u, a, b, c: [x[0] + a + (b + c) * u[0]],
        observation_noise=[[noise**2]],
        initial_mean=[0.0],
        initial_cov=0.0,
        inputs=["u"],
    )


def walk():
    return psf.StateSpaceModel(
        transition=lambda x, q, a: [a * x[0] + q[0]],
        process_noise=lambda s=0.3: [[s**2]],
        observation=lambda x: [x[0]],
        observation_noise=[[1e-10]],
        initial_mean=[2.0],
        initial_cov=0.0,
    )


@cache
def line_model():
    with pm.Model() as model:
        pm.Normal("a", 0, 1)
        pm.Normal("b", 0, 2)
        pm.Normal("c", 0, 2)
        pm.Normal("unused", 0, 3)
        psf.StateSpace("d", line(), psf.EKF(), steps=range(40), inputs=U)
    return model


def decay():
    """Far above the capacity, x' = r x - (r / K) x^2 is nearly -(r / K) x^2."""
    return psf.StateSpaceModel(
        psf.RungeKutta4(lambda x, r, K: [r * x[0] * (1 - x[0] / K)], dt=0.02),
        observation=lambda x: [x[0]],
        observation_noise=[[100.0]],
        initial_mean=[1000.0],
        initial_cov=0.0,
    )


DECAY = {"times": np.arange(1, 11) / 10}


def decay_model(**record):
    with pm.Model() as model:
        pm.LogNormal("r", -5, 0.3)
        pm.LogNormal("K", 2, 0.3)
        psf.StateSpace("d", decay(), psf.EKF(), **DECAY | record)
    return model


def test_line_has_the_closed_form():
    found = psf.identifiability(line_model(), random_seed=1, progressbar=False)
    design = np.column_stack([np.ones(40), U, U, np.zeros(40)])
    prior = np.diag([1.0, 4.0, 4.0, 9.0])
    cov = np.linalg.inv(design.T @ design / 0.25 + np.linalg.inv(prior))
    right = np.sqrt(np.diagonal(cov) / np.diagonal(prior))
    np.testing.assert_allclose(found["prior_sd"], np.sqrt(np.diagonal(prior)), rtol=0.06)
    # The prior is that of 4000 draws, the information that of 500 rows at each of 100 points.
    np.testing.assert_allclose(found["ratio"], right, rtol=0.04)
    np.testing.assert_allclose(found["posterior_sd"], np.sqrt(np.diagonal(cov)), rtol=0.04)
    np.testing.assert_allclose(found["full_ratio"], found["ratio"], rtol=0.1)
    assert list(found.index) == ["a", "b", "c", "unused"]
    assert set(found["coordinate"]) == {"value"}
    assert list(found.combinations.index) == ["b + c"]
    c = np.array([0.0, 1.0, 1.0, 0.0])
    assert found.combinations["sd"].iloc[0] == pytest.approx((c @ cov @ c) ** 0.5, rel=0.04)
    np.testing.assert_allclose(found.directions["remains"], [1.0, 1.0], atol=0.02)
    assert found.sentences == (
        "ratio is the expected sd of the posterior over that of the prior, for records simulated "
        "at 100 draws of the prior.",
        "b + c is determined within 0.09, b and c alone are not: 71 % and 71 % of their priors "
        "remain.",
        "The data say nothing of unused.",
    )


def test_information_of_an_autoregression():
    """With the state seen, that of the coefficient is the sum of E x^2 over the noise."""
    a, q, n_rows = 0.8, 0.3**2, 30
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.3)
        pm.HalfNormal("s", 1)
        psf.StateSpace("d", walk(), psf.EKF(), steps=range(1, n_rows + 1))
    own = with_dummy_data(model)
    assert with_dummy_data(own) is own
    likelihood = Likelihood(own, np.array([0.3, 1.0]))
    x, rng = np.array([a, np.log(q**0.5)]), np.random.default_rng(1)
    found = likelihood.information(x, 1000, rng)
    mean = 2.0 * a ** np.arange(n_rows)
    variance = q * (1 - a ** (2 * np.arange(n_rows))) / (1 - a**2)
    np.testing.assert_allclose(found[0, 0], (mean**2 + variance).sum() / q, rtol=0.03)
    np.testing.assert_allclose(found[1, 1], 2 * n_rows, rtol=0.06)  # of the logarithm of a scale
    assert abs(found[0, 1]) < 0.1 * (found[0, 0] * found[1, 1]) ** 0.5
    # Whole scores have the same mean of products, with thirty times the variance.
    scores = np.array([likelihood.gradient(x, likelihood.record(x, rng)) for _ in range(1000)])
    np.testing.assert_allclose(np.diagonal(scores.T @ scores / 1000), np.diagonal(found), rtol=0.2)


def test_far_above_the_capacity_the_ratio_alone_is_determined():
    found = psf.identifiability(decay_model(), random_seed=1, progressbar=False)
    assert set(found["coordinate"]) == {"log"}
    assert list(found.combinations.index) == ["r / K"]
    assert found.combinations["sd"].iloc[0] < 0.02
    np.testing.assert_allclose(found["ratio"], 0.5**0.5, rtol=0.05)  # two priors of one width
    assert found.sentences[1].startswith("r / K is determined to ")
    assert len(found.sentences) == 2


def test_reported_fraction_and_population():
    """Counts of a deterministic epidemic have the product rho N alone."""
    sir = psf.StateSpaceModel(
        psf.RungeKutta4(
            lambda x, beta, gamma: [-beta * x[0] * x[1], beta * x[0] * x[1] - gamma * x[1]], dt=0.5
        ),
        observation_dist=lambda x, rho, N: [pm.Poisson.dist(pt.maximum(rho * N * x[1], 1e-3))],
        initial_mean=[0.99, 0.01],
        initial_cov=np.zeros((2, 2)),
    )
    with pm.Model() as model:
        pm.LogNormal("beta", np.log(0.6), 0.3)
        pm.LogNormal("gamma", np.log(0.25), 0.3)
        pm.Beta("rho", 3, 5)
        pm.LogNormal("N", np.log(2000), 0.5)
        psf.StateSpace("d", sir, psf.EKF(), times=np.arange(2, 41, 2))
    found = psf.identifiability(model, random_seed=1, progressbar=False)
    assert list(found.combinations.index) == ["rho * N"]
    assert found.combinations["ratio"].iloc[0] < 0.25
    assert (found["ratio"][["beta", "gamma"]] < 0.4).all()
    assert found["coordinate"]["rho"] == "log"
    (direction,) = found.directions.index
    parts = found.directions.loc[direction, ["N", "rho"]]
    assert parts.product() < 0  # one rises where the other falls


def test_records_of_a_panel_inform_their_own_levels():
    labels = np.repeat(["A", "B", "C"], [4, 9, 16])
    steps = np.concatenate([np.arange(n) for n in (4, 9, 16)])
    system = psf.StateSpaceModel(
        transition=lambda x: [x[0]],
        observation=lambda x, level: [x[0] + level],
        observation_noise=[[1.0]],
        initial_mean=[0.0],
        initial_cov=0.0,
    )
    with pm.Model(coords={"who": ["A", "B", "C"]}) as model:
        pm.Normal("level", 0, 10, dims="who")
        psf.StateSpace("d", system, psf.EKF(), steps=steps, panel=labels)
    found = psf.identifiability(
        model, var_names=["level[C]", "level[A]"], random_seed=1, progressbar=False
    )
    assert list(found.index) == ["level[C]", "level[A]"]
    np.testing.assert_allclose(found["posterior_sd"], [1 / 4, 1 / 2], rtol=0.05)
    assert len(found.sentences) == 1


def test_records_of_several_variables_add_up():
    with pm.Model() as model:
        pm.Normal("a", 0, 10)
        for name, n_rows in {"first": 10, "second": 30}.items():
            params, steps = {"b": 0.0, "c": 0.0}, range(n_rows)
            psf.StateSpace(name, line(), psf.EKF(), params=params, steps=steps, inputs=U)
    found = psf.identifiability(model, n_draws=20, random_seed=1, progressbar=False)
    np.testing.assert_allclose(found["posterior_sd"], (0.01 + 40 / 0.25) ** -0.5, rtol=0.05)
    np.testing.assert_allclose(found["full_ratio"], found["ratio"], rtol=0.1)


def test_coordinates_follow_the_support():
    with pm.Model() as model:
        pm.Uniform("positive", 0, 3)
        pm.Uniform("both", -1, 1)
        pm.Dirichlet("shares", np.ones(3))
        psf.StateSpace("d", line(), psf.EKF(), params=dict(a=0, b=0, c=0), steps=[0], inputs=U)
    coordinates = Coordinates(with_dummy_data(model))
    assert list(coordinates.kinds) == ["log", "value", *["unconstrained"] * 2]
    x = np.array([[0.3, -0.4, 0.1, 0.2]])
    s = 1 / (1 + np.exp(-x[0]))
    np.testing.assert_allclose(coordinates(x)[0], [np.log(3 * s[0]), 2 * s[1] - 1, 0.1, 0.2])
    np.testing.assert_allclose(coordinates.inverse(coordinates(x)), x)
    right = [1 - s[0], 2 * s[1] * (1 - s[1]), 1.0, 1.0]
    np.testing.assert_allclose(coordinates.jacobian(x, np.ones(4))[0], np.diag(right), atol=1e-8)


def test_full_posteriors_are_priors_where_the_data_say_nothing():
    """Whatever the transform, and however skew the prior."""
    with pm.Model() as model:
        pm.Uniform("uniform", 0, 3)
        pm.Uniform("both", -1, 1)
        pm.HalfNormal("half", 1)
        pm.Dirichlet("shares", np.ones(3))
        pm.Normal("y", model["both"], 1, observed=0.3)
        pm.Potential("p", -model["half"])
        psf.StateSpace("d", line(), psf.EKF(), params=dict(a=0, b=0, c=0), steps=[0], inputs=U)
    found = psf.identifiability(model, n_draws=6, random_seed=1, progressbar=False)
    np.testing.assert_allclose(found["ratio"], 1.0, atol=1e-6)
    np.testing.assert_allclose(found["full_ratio"], 1.0, atol=0.06)
    assert found.sentences[1:] == (
        "Not used are other data and potentials of the model: ['y', 'p'].",
        "The data say nothing of uniform, both, half, shares[0] and shares[1].",
    )


def test_width_of_a_population_needs_full_posteriors():
    """Its prior with the levels is not normal: their widths depend on it, they are independent."""
    system = psf.StateSpaceModel(
        transition=lambda x: [x[0]],
        observation=lambda x, level: [x[0] + level],
        observation_noise=[[1e-4]],
        initial_mean=[0.0],
        initial_cov=0.0,
    )
    with pm.Model() as model:
        tau = pm.LogNormal("tau", 0, 0.7)
        pm.Normal("level", 0, tau, shape=5)
        psf.StateSpace("d", system, psf.EKF(), steps=[0] * 5, panel=range(5))
    found = psf.identifiability(model, var_names="tau", random_seed=1, progressbar=False)
    # That of five normal variables of unknown scale, with its prior.
    right = (1 / 0.7**2 + 2 * 5) ** -0.5 / 0.7
    assert found["ratio"]["tau"] > 0.95
    assert found["full_ratio"]["tau"] == pytest.approx(right, rel=0.12)
    assert len(found.sentences) == 2
    assert found.sentences[1].startswith(
        "The posteriors are not normal: by full posteriors of 6 simulated records the ratio is of "
        "tau 0."
    )


def test_without_full_posteriors_the_ratios_are_called_unchecked():
    """As of a panel of sixty, where importance sampling fails; two posteriors tell too little."""
    covs = np.diag([0.99, 0.5])[None] ** 2
    passed = [np.array([0.3, 0.2])] * 2
    labels, kinds = ["tau", "level"], np.array(["log", "value"])
    expected = Expected(labels, kinds, np.eye(2), covs[[0] * 4], [None, None, *passed])
    assert table_of(expected, np.arange(2), []).sentences == (
        "If posteriors are normal, the data say nothing of tau.",
        "If posteriors are normal, the data say little of level: 50 % of its prior remains.",
        "Importance sampling of the full posteriors of 2 of 4 simulated records failed, as they "
        "are far from normal or have many parameters: simulate some records, and sample their "
        "posteriors. The ratios are those of normal posteriors, and not checked; if a parameter "
        "is the width of a population, its ratio is too large.",
    )
    enough = expected._replace(full_sds=[None, *passed, passed[0]])
    assert table_of(enough, np.arange(2), []).sentences[-1] == (
        "The posteriors are not normal: by full posteriors of 3 simulated records the ratio is of "
        "tau 0.3 instead of 0.99 and of level 0.2 instead of 0.5."
    )


def test_a_model_with_initial_values():
    with pm.Model() as model:
        pm.Normal("a", initval=2.0)
        psf.StateSpace("d", line(), psf.EKF(), params={"b": 0.0, "c": 0.0}, steps=[0, 1], inputs=U)
    assert [rv.name for rv in with_dummy_data(model).observed_RVs] == ["d"]
    assert model.rvs_to_initial_values[model["a"]] == 2.0


def test_heavy_tails_do_not_count():
    rng = np.random.default_rng(1)
    factor = np.array([[1.0, 0.0], [0.6, 0.8]])
    normal = rng.normal(size=(20000, 2)) @ factor.T
    cov = normal_covariance(normal)
    np.testing.assert_allclose(cov, factor @ factor.T, atol=0.04)
    heavy = np.where(np.abs(normal) > 2, normal**9, normal)  # the same within two sds
    np.testing.assert_allclose(normal_covariance(heavy), cov, atol=1e-12)


def test_combinations_of_three():
    labels = ["a", "b", "c", "d"]
    prior = np.diag([1.0, 2.0, 0.5, 1.0])
    known = np.array([[1.0, -1.0, 2.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    covs = np.linalg.inv(np.linalg.inv(prior) + 1e4 * known.T @ known)[None]
    kinds, chosen = np.array(["log"] * 4), np.arange(4)
    exponents, sd, ratio = determined_combinations(covs, prior, kinds, chosen)
    assert exponents.tolist() == [[1, -1, 2, 0]]
    assert sd[0] == pytest.approx(0.01, rel=1e-3)
    assert ratio[0] == pytest.approx(0.01 / 5**0.5, rel=1e-3)
    assert combination_label(exponents[0], labels, is_log=True) == "a * c^2 / b"
    assert combination_label(exponents[0], labels, is_log=False) == "a - b + 2 c"
    assert combination_label(np.array([1, -1, -2, 0]), labels, is_log=True) == "a / (b * c^2)"
    table = weak_directions(covs, prior, labels)
    assert list(table.columns) == ["remains", *labels]
    np.testing.assert_allclose(table["remains"], 1.0)
    np.testing.assert_allclose(
        table[labels].to_numpy() * np.sqrt(np.diag(prior)) @ known.T, 0, atol=1e-3
    )
    # Quantities of different kinds are not combined.
    kinds = np.array(["log", "value", "log", "log"])
    assert not len(determined_combinations(covs, prior, kinds, chosen)[0])


def test_precision_in_words():
    assert precision(0.02, is_log=True) == "to 2 %"
    assert precision(0.7, is_log=True) == "within a factor of 2"
    assert precision(0.02, is_log=False) == "within 0.02"


def test_at_a_fit():
    values = {"r": 0.0067, "K": 7.4}
    record = psf.simulate(decay(), values, **DECAY, random_seed=1)["observations"]
    model = decay_model(observed=record)
    with model:
        idata = psf.sample_dram(200, tune=500, chains=2, random_seed=1, progressbar=False)
    found = psf.identifiability(model, idata=idata, n_draws=20, random_seed=1, progressbar=False)
    assert found.sentences[0].endswith("at 20 draws of the posterior.")
    assert list(found.combinations.index) == ["r / K"]
    assert found["q95"]["r"] - found["q05"]["r"] < 0.1
    with pytest.raises(DataMismatchError, match="free variables of the model"):
        psf.identifiability(line_model(), idata=idata, progressbar=False)


def refusal(model, **arguments):
    with pytest.raises(ModelError) as caught:
        psf.identifiability(model, progressbar=False, **arguments)
    return str(caught.value)


def test_bad_input():
    with pm.Model() as no_system:
        pm.Normal("y", 0, 1)
    assert refusal(no_system) == "model must have a StateSpace variable, got the variables ['y']"
    assert refusal(line_model(), var_names="r") == (
        "var_names must name free variables of the model, or elements of them, got 'r': the model "
        "has ['a', 'b', 'c', 'unused']"
    )
    assert refusal(line_model(), var_names=[]) == (
        "var_names must name at least one free variable, got none"
    )
    assert refusal(line_model(), n_draws=1) == "n_draws must be an integer of at least 2, got 1"
    assert refusal(line_model(), n_records=0) == (
        "n_records must be an integer of at least 1, got 0"
    )
    assert refusal(line_model(), idata=3) == (
        "idata must be a DataTree of posterior draws, as pm.sample and sample_dram return it, got "
        "int"
    )


def test_models_that_cannot_be_treated():
    record = {"params": {"b": 0.0, "c": 0.0}, "steps": range(3), "inputs": U}
    with pm.Model() as improper:
        pm.Flat("a")
        psf.StateSpace("d", line(), psf.EKF(), **record)
    assert refusal(improper) == (
        "the prior of a is improper and cannot be sampled: give it a proper prior"
    )
    with pm.Model() as doubled:
        pm.Normal("a")
        pm.Normal("b", doubled["a"], 1e-12)
        psf.StateSpace("d", line(), psf.EKF(), **record | {"params": {"c": 0.0}})
    assert refusal(doubled) == (
        "free variables must not be functions of each other in the prior, got ['a', 'b']: make one "
        "of them a pm.Deterministic"
    )
    with pm.Model() as noisy:
        pm.Normal("a")
        psf.StateSpace("d", walk(), psf.GuidedPF(10), steps=range(3))
    assert refusal(noisy) == (
        "the filter of 'd' must have a gradient, as its terms must be smooth in the parameters, "
        "got GuidedPF(10): take a filter with a gradient: EKF(), IPLF(), UKF()"
    )
    with pm.Model() as censored:
        pm.Normal("a")
        flags = {"observed": [0.0, 1.0, 2.0], "censored": [-1, 0, 0]}
        psf.StateSpace("d", line(), psf.EKF(), **record, **flags)
    assert refusal(censored) == (
        "model must have no censored data, got those of ['d']: which values of a record to come "
        "are censored is not known; build the model without censored="
    )
    with pm.Model() as impossible:
        a = pm.Normal("a")
        psf.StateSpace(
            "d",
            line(),
            psf.EKF(),
            **record | {"params": {"a": pt.log(-(a**2)), **record["params"]}},
        )
    assert refusal(impossible, n_draws=4) == (
        "simulated records must be finite and have a likelihood by the filter at a quarter of the "
        "points, got 0 of 4: give the model a prior with less mass where its equations have no "
        "solution"
    )
