"""Which parameters of a panel belong to single records, for models of many forms.

In each form the four graphs add up to the model's log-density, with the Jacobian of the coordinates
that random effects have, and own terms of a record do not change with the own parameters of another
one.
"""

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.pymc_model.panel_structure import panel_structure
from tests.modes import AS_IT_STANDS

LABELS = ["a", "b", "c"]
N_ROWS = 4
SYSTEM = psf.StateSpaceModel(
    transition=lambda x, q, rate, level: [level + rate * (x[0] - level) + q[0]],
    process_noise=[[0.3]],
    observation=lambda x: [x[0]],
    observation_noise=[[0.1]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)

DATA = np.linspace(-1.0, 1.0, 3 * N_ROWS)


def panel(name="d", **params):
    return psf.StateSpace(
        name,
        SYSTEM,
        psf.EKF(),
        panel=np.repeat(LABELS, N_ROWS),
        steps=np.tile(np.arange(1, N_ROWS + 1), 3),
        observed=DATA,
        params=params,
    )


def centred():
    mu, sd = pm.Normal("mu"), pm.HalfNormal("sd")
    panel(rate=pm.Normal("x", mu, sd, dims="machine"), level=pm.Normal("level"))


def non_centred():
    mu, sd = pm.Normal("mu"), pm.HalfNormal("sd")
    panel(rate=mu + sd * pm.Normal("z", dims="machine"), level=0.5)


def factors():
    """Random effects as factors, in the units of clinical tables."""
    typical, omega = pm.LogNormal("typical"), pm.HalfNormal("omega")
    z = pm.Normal("z", dims="machine")
    of_weight = np.array([1.0, 2.0, 0.5]) ** 0.75
    level = pm.Deterministic("of_each", typical * of_weight / pm.math.exp(omega * z))
    panel(rate=0.3, level=level)


def uniform_widths():
    """Intervals that begin at zero or above."""
    typical, omega = pm.Uniform("typical", 0.1, 5), pm.Uniform("omega", 0, 2)
    upper = pm.TruncatedNormal("upper", 0, 1, lower=0)
    effect = typical * omega / upper * pm.Normal("z", dims="machine")
    panel(rate=0.3, level=effect)


def width_of_any_sign():
    width = pm.Uniform("width", -1, 2)
    panel(rate=0.3, level=0.5 + width * pm.Normal("z", dims="machine"))


def around_zero():
    """The effects have the variance of the population, and not its mean."""
    typical, omega = pm.LogNormal("typical"), pm.HalfNormal("omega")
    z = pm.Normal("z", 0.0, omega, dims="machine")
    panel(rate=0.3, level=typical * pm.math.exp(z))


def columns():
    """Each column of the effects enters a parameter of its own."""
    mu, sd = pm.Normal("mu", shape=2), pm.HalfNormal("sd", shape=2)
    z = pm.Normal("z", shape=(3, 2))
    panel(rate=pm.math.tanh(mu[0] - sd[0] * z[:, 0]), level=(mu[1] - z[:, 1]) / sd[1])


def column_from_both_ends():
    """One column by two numbers, in two forms."""
    mu, sd = pm.Normal("mu"), pm.HalfNormal("sd")
    z = pm.Normal("z", dims=("machine", "of"))
    panel(rate=pm.math.tanh(mu + sd * z[:, 1]), level=z[:, -1])


def table():
    """The effects of two parameters by one formula, with a mean for every machine."""
    mu, sd = pm.Normal("mu", shape=2), pm.HalfNormal("sd", shape=2)
    x = mu + np.arange(3.0)[:, None] + sd * pm.Normal("z", shape=(3, 2))
    panel(rate=pm.math.tanh(x[:, 0]), level=x[:, 1])


def two_effects():
    mu, sd = pm.Normal("mu"), pm.HalfNormal("sd")
    level = 2.0 * mu + pm.Normal("w", dims="machine")
    panel(rate=pm.math.tanh(mu + sd * pm.Normal("z", dims="machine")), level=level)


def factor_of_any_sign():
    """Only the spread is a parameter of the population: a negative factor has no logarithm."""
    typical, omega = pm.Normal("typical"), pm.HalfNormal("omega")
    z = pm.Normal("z", dims="machine")
    panel(rate=0.3, level=typical * pm.math.exp(omega * z))


def mean_used_twice():
    mu, sd = pm.Normal("mu"), pm.HalfNormal("sd")
    panel(rate=pm.math.tanh(mu + sd * pm.Normal("z", dims="machine")), level=mu)


def effect_used_twice():
    mu, sd = pm.Normal("mu"), pm.HalfNormal("sd")
    z = pm.Normal("z", dims="machine")
    panel(rate=pm.math.tanh(mu + sd * z), level=z)


def squared_effect():
    mu, sd = pm.Normal("mu"), pm.HalfNormal("sd")
    panel(rate=0.3, level=mu + sd * pm.Normal("z", dims="machine") ** 2)


def effect_of_each_column():
    """Three columns of one effect: their numbers are more than those of the effect."""
    mu, sd = pm.Normal("mu"), pm.HalfNormal("sd", shape=3)
    x = mu + sd * pm.Normal("z", shape=(3, 1))
    panel(rate=0.3, level=x.sum(axis=1))


def population_of_shared():
    """A parameter of the distribution of a shared one reaches no likelihood either."""
    tau = pm.HalfNormal("tau")
    panel(rate=pm.Uniform("x", -0.9, 0.9, shape=3), level=pm.Normal("level", 0, tau))


def bounded_by_population():
    """On the unconstrained space the bound is a factor of each record's parameter."""
    top = pm.HalfNormal("top")
    panel(rate=pm.Uniform("x", 0, top, dims="machine"), level=0.0)


def correlated():
    """Two parameters of each record from a normal distribution of the population."""
    chol, *_ = pm.LKJCholeskyCov("chol", n=2, eta=2, sd_dist=pm.HalfNormal.dist())
    x = pm.MvNormal("x", mu=[0.3, 0.0], chol=chol, shape=(3, 2))
    panel(rate=pm.math.tanh(x[:, 0]), level=x[:, 1])


def regression():
    """Own parameters by a linear predictor of a table of their columns; shared coefficients."""
    b = pm.Normal("b", shape=2)
    x = pm.Normal("x", shape=(3, 2))
    scores = pt.dot(x, np.array([0.2, 0.1]))
    panel(rate=scores, level=pt.dot(np.arange(6.0).reshape(3, 2), b))


def own_data():
    """Other data of the same records, in rows of their own."""
    x = pm.Normal("x", dims="machine")
    panel(rate=0.3, level=x)
    pm.Normal("y", x[np.array([0, 0, 1, 2, 2])], 1.0, observed=np.arange(5.0))


def two_panels():
    x = pm.Normal("x", dims="machine")
    panel(rate=0.3, level=x)
    panel("e", rate=0.4, level=2.0 * x)


def summed_potential():
    x = pm.Normal("x", dims="machine")
    pm.Potential("far", pt.sum(-(x**4)))
    panel(rate=0.3, level=x)


def mixture():
    weights = pm.Dirichlet("weights", np.ones(2))
    components = [pm.Normal.dist(-1.0, 0.5), pm.Normal.dist(1.0, 0.5)]
    panel(rate=0.3, level=pm.Mixture("x", weights, components, dims="machine"))


def other_order():
    """The rows of the variable are the records in another order."""
    panel(rate=0.3, level=pm.Normal("x", shape=3)[np.array([2, 0, 1])])


def as_data():
    """The labels are data that may be replaced later."""
    labels = pm.Data("labels", np.repeat([4, 7, 9], N_ROWS))
    x = pm.Normal("x", shape=3)
    steps = np.tile(np.arange(1, N_ROWS + 1), 3)
    psf.StateSpace(
        "d",
        SYSTEM,
        psf.EKF(),
        panel=labels,
        steps=steps,
        observed=DATA,
        params={"rate": 0.3, "level": x},
    )


FORMS = {  # own, population, shared
    centred: (["x"], ["mu", "sd"], ["level"]),
    non_centred: (["z"], ["mu", "sd"], []),
    factors: (["z"], ["typical", "omega"], []),
    uniform_widths: (["z"], ["typical", "omega", "upper"], []),
    width_of_any_sign: (["z"], [], ["width"]),
    around_zero: (["z"], ["typical", "omega"], []),
    columns: (["z"], ["mu", "sd"], []),
    column_from_both_ends: (["z"], [], ["mu", "sd"]),
    table: (["z"], ["mu", "sd"], []),
    two_effects: (["z", "w"], ["mu", "sd"], []),
    factor_of_any_sign: (["z"], ["omega"], ["typical"]),
    mean_used_twice: (["z"], ["sd"], ["mu"]),
    effect_used_twice: (["z"], [], ["mu", "sd"]),
    squared_effect: (["z"], [], ["mu", "sd"]),
    effect_of_each_column: (["z"], [], ["mu", "sd"]),
    population_of_shared: (["x"], ["tau"], ["level"]),
    bounded_by_population: (["x"], [], ["top"]),
    correlated: (["x"], ["chol"], []),
    regression: (["x"], [], ["b"]),
    own_data: (["x"], [], []),
    two_panels: (["x"], [], []),
    summed_potential: (["x"], [], []),
    mixture: (["x"], ["weights"], []),
    other_order: (["x"], [], []),
    as_data: (["x"], [], []),
}


def model_of(form):
    with pm.Model(coords={"machine": LABELS, "of": ["rate", "level"]}) as model:
        form()
    return model


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.__name__)
def test_the_parameters_of_a_form(form):
    model = model_of(form)
    found = panel_structure(model)
    names = [
        sorted(model.values_to_rvs[value].name for value in block)
        for block in (found.own, found.population, found.shared)
    ]
    assert names == list(map(sorted, FORMS[form]))
    assert (found.name, found.n_records) == ("d", 3)
    check_terms(model, found)


def check_terms(model, found):
    """They add up to the log-density, and each record's own terms are its own."""
    graphs = [found.likelihood, found.prior, found.rest]
    if found.other_likelihood is not None:
        graphs.append(found.other_likelihood)
    # Too few calls to be worth machine code.
    whole = model.compile_fn(model.logp(), mode=AS_IT_STANDS)
    centred = {one.value: one.centred for one in found.centrings}
    terms = function_of([centred.get(value, value) for value in model.value_vars], graphs)
    rng = np.random.default_rng(1)
    point = {
        name: value + 0.2 * rng.normal(size=np.shape(value))
        for name, value in model.initial_point(random_seed=0).items()
    }
    before = terms(point)
    total = sum(np.sum(part) for part in before)
    in_model, log_jacobian = point_in_model(model, found.centrings, point)
    np.testing.assert_allclose(total - log_jacobian, whole(in_model), rtol=1e-12)
    for value in found.own:
        moved = dict(point) | {value.name: point[value.name].copy()}
        moved[value.name][1] += 0.1
        after = terms(moved)
        for old, new in zip(before[:2], after[:2], strict=True):
            np.testing.assert_array_equal(old[[0, 2]], new[[0, 2]])
        np.testing.assert_array_equal(before[2:], after[2:])
    others = [*found.population, *found.shared]
    changes = dict.fromkeys((value.name for value in others), False)
    for value in others:
        after = terms(dict(point) | {value.name: point[value.name] + 0.1})
        changes[value.name] = bool((np.asarray(before[0]) != np.asarray(after[0])).any())
    assert not any(changes[value.name] for value in found.population)


def function_of(values, graphs):
    """The graphs as a function of a point, whose values these are."""
    function = pytensor.function(values, graphs, mode=AS_IT_STANDS, on_unused_input="ignore")
    return lambda point: function(*(point[value.name] for value in values))


def centred_log():
    mu, sd = pm.Normal("mu"), pm.HalfNormal("sd")
    panel(rate=0.3, level=pm.LogNormal("x", mu * np.arange(3.0), sd, dims="machine"))


def centred_heavy():
    mu, sd = pm.Normal("mu", shape=2), pm.HalfNormal("sd")
    x = pm.StudentT("x", 4, mu=mu, sigma=sd, dims=("machine", "of"))
    panel(rate=0.3 + 0.1 * pm.math.tanh(x[:, 0]), level=x[:, 1])


def nested():
    """Of the two the second one has the first as its location, which records do not share."""
    mu, sd = pm.Normal("mu"), pm.HalfNormal("sd")
    y = pm.Normal("y", mu, sd, dims="machine")
    panel(rate=0.3, level=pm.Normal("x", y, sd, dims="machine"))


def transformed():
    mu = pm.Normal("mu")
    panel(rate=0.3, level=pm.Normal("x", mu, 1, dims="machine", transform=IN_A_THIRD))


IN_A_THIRD = pm.distributions.transforms.Interval(-1, 2)


@pytest.mark.parametrize(
    ("form", "name"),
    [(centred, "x"), (centred_log, "x"), (centred_heavy, "x"), (nested, "y"), (regression, None),
     (transformed, None), (bounded_by_population, None), (non_centred, None)],
    ids=lambda one: getattr(one, "__name__", ""),
)  # fmt: skip
def test_the_standard_values_of_centred_ones(form, name):
    """Their prior does not depend on locations and scales."""
    model = model_of(form)
    found = panel_structure(model)
    assert [model.values_to_rvs[one.value].name for one in found.centred] == [name] * bool(name)
    if name is None:
        return
    assert found.interwoven
    (one,) = found.centred
    prior = model.logp(vars=[model[name]]) - one.log_jacobian.sum()
    evaluate = function_of(model.value_vars, [one.location, one.scale, prior])
    point, numbers = model.initial_point(random_seed=0), []
    for shift in (0.0, 0.3):
        here = point | {v.name: point[v.name] + shift for v in found.interwoven}
        location, scale, _ = evaluate(here)
        value = location + scale * np.linspace(-1, 1.5, scale.size).reshape(scale.shape)
        numbers.append(evaluate(here | {one.value.name: value})[2])
    assert numbers[0] == pytest.approx(numbers[1], rel=1e-12)
    assert panel_structure(model, centres=False).interwoven == []


def point_in_model(model, centrings, point):
    """The point in the coordinates of the model, and the log-Jacobian of those by differences."""
    values = [one.replaced[one.value] for one in centrings]
    centred = {one.value: one.centred for one in centrings}
    backward = function_of([centred.get(value, value) for value in model.value_vars], values)
    names, log_jacobian = [one.value.name for one in centrings], 0.0
    found, moved = (backward(point | {n: point[n] + up for n in names}) for up in (0.0, 1.0))
    for before, after in zip(found, moved, strict=True):
        log_jacobian += np.log(np.abs(after - before)).sum()
    return point | dict(zip(names, found, strict=True)), log_jacobian


def sum_to_zero():
    panel(rate=0.3, level=pm.ZeroSumNormal("x", dims="machine"))


def random_walk():
    """A random walk over the records."""
    panel(rate=0.3, level=pm.GaussianRandomWalk("x", init_dist=pm.Normal.dist(), steps=2))


def shared_norm():
    x = pm.Normal("x", dims="machine")
    panel(rate=0.3, level=x / pt.sqrt((x**2).sum()))


def squared_sum():
    x = pm.Normal("x", dims="machine")
    pm.Potential("sum", -(x.sum() ** 2))
    panel(rate=0.3, level=x)


def reversed_order():
    """Each record has the parameter of another one."""
    panel(rate=0.3, level=pm.Normal("x", dims="machine")[::-1])


def correlated_records():
    x = pm.MvNormal("x", np.zeros(3), np.eye(3) + 0.5)
    panel(rate=0.3, level=x)


def nothing_own():
    panel(rate=pm.Normal("rate"), level=pm.Normal("level"))


MIXING = [
    sum_to_zero,
    random_walk,
    shared_norm,
    squared_sum,
    reversed_order,
    correlated_records,
    nothing_own,
]


@pytest.mark.parametrize("form", MIXING, ids=lambda form: form.__name__)
def test_forms_that_mix_records_have_no_structure(form):
    assert panel_structure(model_of(form)) is None


@pytest.mark.parametrize("form", MIXING[:4], ids=lambda form: form.__name__)
def test_what_mixes_is_shared_beside_what_does_not(form):
    with pm.Model(coords={"machine": LABELS}) as model:
        form()
        own = pm.Normal("own", dims="machine")
        panel("e", rate=pm.math.tanh(own), level=model["x"])
    found = panel_structure(model)
    assert [model.values_to_rvs[value].name for value in found.own] == ["own"]
    assert [model.values_to_rvs[value].name for value in found.shared] == ["x"]
    check_terms(model, found)


def test_a_vector_as_long_as_the_panel_that_is_none_of_its_records():
    """Three columns of three records: the vector along the columns is shared."""
    with pm.Model() as model:
        scale = pm.Normal("scale", shape=3)
        x = pm.Normal("x", 0.0, 1.0, shape=(3, 3))
        panel(rate=0.3, level=(x * scale).sum(axis=1))
    found = panel_structure(model)
    assert [value.name for value in found.own] == ["x"]
    assert [value.name for value in found.shared] == ["scale"]
    check_terms(model, found)


def test_an_effect_of_as_many_groups_as_records_is_not_own():
    with pm.Model() as model:
        of_group = pm.Normal("of_group", shape=3)
        z = pm.Normal("z", shape=3)
        panel(rate=0.3, level=of_group[[1, 0, 1]] + z)
    found = panel_structure(model)
    assert [value.name for value in found.own] == ["z"]
    assert [value.name for value in found.population] == ["of_group"]
    check_terms(model, found)


def test_a_model_without_a_panel_has_no_structure():
    with pm.Model() as model:
        pm.Normal("rate", shape=3)
    assert panel_structure(model) is None
