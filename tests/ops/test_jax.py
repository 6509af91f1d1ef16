"""Likelihoods in JAX: the numbers of the numba backend, in one call for all points of a vmap."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import GradientUnavailableError, ModelError
from pymc_statespace_filters.ops.likelihood import LogLikelihood
from tests import systems
from tests.systems import FORCE, FORCED, FORCED_DATA, FREE, PAIR, PAIR_DATA, STEPS, pair_terms
from tests.waiting import LIMIT

jax = pytest.importorskip("jax")
# Not before the line above. PyMC sets the number of JAX's devices here, before JAX counts them.
pymc_jax = pytest.importorskip("pymc.sampling.jax")
import jax.numpy as jnp  # noqa: E402

from pymc_statespace_filters.ops import jax as conversions  # noqa: E402

ROOT = Path(__file__).parents[2]
RECORD = (STEPS, PAIR_DATA, np.zeros((0, 0)), np.array(0.0), np.array(7))
rng = np.random.default_rng(3)
POINTS = np.column_stack([rng.uniform(-0.9, 0.9, 11), rng.normal(size=11)])


def terms_in_jax(filter=psf.EKF(), system=PAIR, record=RECORD):  # noqa: B008 (settings are frozen)
    """The terms as a JAX function of theta."""
    likelihood = conversions.jax_funcify(LogLikelihood(system, filter))
    return lambda theta: likelihood(theta, *map(jnp.asarray, record))[0]


@pytest.fixture
def calls(monkeypatch):
    """The shape of theta in each call of the machine code from JAX."""
    made = []

    def counted(function):
        def call(op, theta, *others):
            made.append((function.__name__, theta.shape))
            return function(op, theta, *others)

        return call

    for function in (conversions.values, conversions.gradients):
        monkeypatch.setattr(conversions, function.__name__, counted(function))
    return made


# Models of every kind.


def pair_model(filter=psf.EKF(), **settings):  # noqa: B008
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.2)
        pm.HalfNormal("b", 1.0)
        psf.StateSpace("d", PAIR, filter, **{"steps": STEPS, "observed": PAIR_DATA} | settings)
    return model


def scored_later():
    return pair_model(score_from=1)


def two_variables():
    with pair_model() as model:
        psf.StateSpace(
            "e", FORCED, psf.UKF(), params={"a": model["a"] / 2}, steps=STEPS,
            observed=FORCED_DATA, inputs=FORCE, dims=("step", "force"),
        )  # fmt: skip
    return model


def panel():
    rows = np.append(PAIR_DATA, PAIR_DATA[:3] + 0.4, axis=0)
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.2, shape=2)
        pm.HalfNormal("b", 1.0)
        psf.StateSpace(
            "d", PAIR, psf.EKF(), panel=[*"xxxxyyy"], steps=[*STEPS, *STEPS[:3]], observed=rows,
            score_from=1,
        )  # fmt: skip
    return model


def ode_with_counts():
    decay = psf.StateSpaceModel(
        transition=psf.RungeKutta4(lambda x, rate: [-rate * x[0]], dt=0.5),
        observation_dist=lambda x: [pm.Poisson.dist(x[0])],
        initial_mean=lambda first: [first],
        initial_cov=0.0,
    )
    with pm.Model() as model:
        pm.HalfNormal("rate", 1.0)
        pm.HalfNormal("first", 20.0)
        psf.StateSpace("d", decay, psf.EKF(), steps=[0, 2, 4], observed=[12, 7, 3])
    return model


def counts():
    with pm.Model() as model:
        pm.Uniform("a", 0, 1)
        psf.StateSpace("d", systems.counts(), psf.IPLF(), steps=[1, 2, 4], observed=[1, 0, 3])
    return model


# Panels and late scores are together in one, and each filter with a gradient is in one.
MODELS = {
    "EKF": pair_model,
    "score_from": scored_later,
    "two variables": two_variables,
    "panel, score_from": panel,
    "ODE with counts": ode_with_counts,
    "counts": counts,
}


def near_the_start(model):
    """A point that is no special one."""
    return {
        name: value + 0.1 * np.cos(np.arange(np.size(value))).reshape(np.shape(value))
        for name, value in model.initial_point().items()
    }


def assert_value_and_gradient(found, wanted):
    gradients = [np.concatenate([np.ravel(bar) for bar in one[1]]) for one in (found, wanted)]
    np.testing.assert_allclose(found[0], wanted[0], rtol=1e-12)
    np.testing.assert_allclose(*gradients, rtol=1e-12, atol=1e-12 * abs(gradients[1]).max())


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
def test_value_and_gradient_of_a_model(make):
    """The reference is the same graph in Python, around the machine code of numba."""
    model = make()
    point, graphs = near_the_start(model), [model.logp(), model.dlogp()]
    wanted = model.compile_fn(graphs)(point)
    assert_value_and_gradient(model.compile_fn(graphs, mode="JAX")(point), wanted)
    logp = jax.value_and_grad(pymc_jax.get_jaxified_logp(model))
    assert_value_and_gradient(jax.jit(logp)([*map(jnp.asarray, point.values())]), wanted)


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize("name", ["EKF", "panel, score_from"])
def test_value_and_gradient_of_a_model_at_many_points(name):
    """As a vmap in JAX."""
    model = MODELS[name]()
    point = near_the_start(model)
    wanted = model.compile_fn([model.logp(), model.dlogp()])(point)
    logp = jax.jit(jax.vmap(jax.value_and_grad(pymc_jax.get_jaxified_logp(model))))
    value, bars = logp([jnp.stack([n + 0.1, n, n]) for n in point.values()])
    assert_value_and_gradient((value[2], [bar[2] for bar in bars]), wanted)


def test_data_may_be_replaced():
    full = np.nan_to_num(PAIR_DATA)
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.2)
        steps, observed = pm.Data("steps", STEPS), pm.Data("observed", full)
        psf.StateSpace("d", PAIR, psf.EKF(), steps=steps, observed=observed)
    compiled = model.compile_fn([model.logp(), model.dlogp()], mode="JAX")
    point = {"a": np.array(0.4)}
    prior = -np.log(0.2 * np.sqrt(2 * np.pi)) - 0.5 * 0.5**2
    longer = {"steps": [1, 2, 4, 5, 9], "observed": np.append(full, [[0.2, 0.1]], axis=0)}
    for data in ({}, longer):
        with model:
            pm.set_data(data)
        exact = prior + pair_terms(0.4, **{"steps": STEPS, "observed": full} | data).sum()
        np.testing.assert_allclose(compiled(point)[0], exact, rtol=1e-10)
        logp = pymc_jax.get_jaxified_logp(model)
        np.testing.assert_allclose(logp([jnp.array(0.4)]), exact, rtol=1e-10)
    with model:
        pm.set_data({"observed": full})
    with pytest.raises(Exception, match="observed must have a row for each step") as caught:
        compiled(point)
    assert "ModelError" in str(caught.value)


# Calls.


def test_an_evaluation_is_one_call_for_the_value_and_one_for_the_gradient(calls):
    function = jax.jit(jax.value_and_grad(lambda theta: terms_in_jax()(theta).sum()))
    theta = jnp.asarray(POINTS[0])
    function(theta)
    assert sorted(calls) == [("gradients", (2,)), ("values", (2,))]


@pytest.mark.parametrize("jit", [jax.jit, lambda function: function], ids=["jit", "not jitted"])
def test_all_points_of_a_vmap_are_one_call(calls, jit):
    total = jax.value_and_grad(lambda theta: terms_in_jax()(theta).sum())
    alone = [total(jnp.asarray(point)) for point in POINTS]
    calls.clear()
    value, gradient = jit(jax.vmap(total))(jnp.asarray(POINTS))
    assert sorted(calls) == [("gradients", (11, 2)), ("values", (11, 2))]
    np.testing.assert_allclose(value, [one[0] for one in alone], rtol=1e-12)
    np.testing.assert_allclose(gradient, [one[1] for one in alone], rtol=1e-12, atol=1e-13)
    exact = [pair_terms(a, b).sum() for a, b in POINTS]
    np.testing.assert_allclose(value, exact, rtol=1e-10)


def test_a_vmap_in_a_vmap_is_one_call(calls):
    points = jnp.asarray(POINTS[:6].reshape(2, 3, 2))
    terms = jax.jit(jax.vmap(jax.vmap(terms_in_jax())))(points)
    assert calls == [("values", (2, 3, 2))]
    np.testing.assert_allclose(terms.reshape(6, 4), [pair_terms(a, b) for a, b in POINTS[:6]])


def test_the_jacobian_of_the_terms_is_one_call_backwards(calls):
    """Each term has its cotangent, at one theta."""
    jacobian = jax.jacrev(terms_in_jax())(jnp.asarray(POINTS[0]))
    assert [name for name, _ in calls] == ["values", "gradients"]
    h = 1e-6 * np.eye(2)
    differences = [
        (pair_terms(*(POINTS[0] + step)) - pair_terms(*(POINTS[0] - step))) / 2e-6 for step in h
    ]
    np.testing.assert_allclose(jacobian, np.transpose(differences), rtol=1e-7, atol=1e-8)


def test_chains_on_several_devices_have_their_own_numbers():
    theta = POINTS[:3]
    value, gradient = jax.pmap(jax.value_and_grad(lambda t: terms_in_jax()(t).sum()))(theta)
    alone = jax.vmap(jax.value_and_grad(lambda t: terms_in_jax()(t).sum()))(theta)
    np.testing.assert_allclose(value, alone[0], rtol=1e-12)
    np.testing.assert_allclose(gradient, alone[1], rtol=1e-12, atol=1e-13)


def test_a_device_with_a_memory_of_its_own_gets_copies():
    """The path of a GPU, on the processor."""
    op = LogLikelihood(PAIR, psf.EKF())
    shapes = [jax.ShapeDtypeStruct(shape, float) for shape in ((4,), (3,))]
    by_copies = conversions._by_copies(lambda *inputs: conversions.values(op, *inputs), shapes)

    def terms(theta):
        return by_copies(theta, *map(jnp.asarray, RECORD))[0]

    got = jax.jit(jax.vmap(terms))(jnp.asarray(POINTS))
    np.testing.assert_allclose(got, [pair_terms(a, b) for a, b in POINTS], rtol=1e-10)


def test_a_point_where_the_filter_fails_has_no_gradient_and_touches_no_other():
    total = jax.jit(jax.vmap(jax.value_and_grad(lambda theta: terms_in_jax()(theta).sum())))
    points = POINTS[:3].copy()
    points[1, 0] = 1e300
    value, gradient = total(jnp.asarray(points))
    assert value[1] == -np.inf
    np.testing.assert_array_equal(gradient[1], 0.0)
    np.testing.assert_allclose(value[0], pair_terms(*POINTS[0]).sum(), rtol=1e-10)
    assert np.isfinite(gradient[2]).all()


# What is refused.


def test_an_estimate_has_a_value():
    wanted = psf.log_likelihood(
        PAIR, psf.BootstrapPF(20), {"a": 0.4, "b": 0.2}, PAIR_DATA, steps=STEPS, seed=7
    )
    terms = jax.jit(terms_in_jax(psf.BootstrapPF(20)))(jnp.array([0.4, 0.2]))
    np.testing.assert_array_equal(terms, wanted)


@pytest.mark.parametrize(
    ("system", "filter"),
    [
        (PAIR, psf.EnKF(20)),
        (PAIR, psf.BootstrapPF(20)),
        (PAIR, psf.PFEnKF(20)),
        (PAIR, psf.GuidedPF(20)),
        (FREE, psf.GridFilter()),
    ],
    ids=lambda value: type(value).__name__,
)
def test_filters_without_a_gradient_name_other_samplers(system, filter):
    terms = terms_in_jax(filter, system, (STEPS, PAIR_DATA[:, : system.p], *RECORD[2:]))
    theta = jnp.full(len(system.parameters), 0.4)
    with pytest.raises(GradientUnavailableError, match=r"pm\.sample\(step=psf\.DRAM\(\)\)"):
        jax.jit(jax.grad(lambda theta: terms(theta).sum()))(theta)


def test_a_gradient_by_the_data_is_refused():
    likelihood = conversions.jax_funcify(LogLikelihood(PAIR, psf.EKF()))

    def total(observed):
        return likelihood(jnp.asarray(POINTS[0]), STEPS, observed, *map(jnp.asarray, RECORD[2:]))[
            0
        ].sum()

    with pytest.raises(GradientUnavailableError, match="parameters of the system only"):
        jax.grad(total)(jnp.asarray(PAIR_DATA))


def test_single_precision_is_refused():
    logp = pymc_jax.get_jaxified_logp(pair_model())
    with (
        jax.enable_x64(False),
        pytest.raises(ModelError, match=r"single precision here.*'jax_enable_x64', True"),
    ):
        jax.jit(logp)([jnp.array(0.4), jnp.array(0.1)])


# What is imported.


def test_jax_is_imported_only_for_graphs_that_are_compiled_with_it():
    script = """
import sys
import numpy as np, pymc as pm, pytensor
import pymc_statespace_filters as psf
from tests.systems import PAIR, PAIR_DATA, STEPS
with pytensor.config.change_flags(mode="FAST_COMPILE"), pm.Model() as model:
    pm.Normal("a")
    psf.StateSpace("d", PAIR, psf.EKF(), steps=STEPS, observed=PAIR_DATA)
    value = model.compile_logp()({"a": np.array(0.3)})
assert not any(name in sys.modules for name in ("jax", "numpyro", "blackjax"))
"""
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=ROOT,
        capture_output=True,
        timeout=LIMIT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
