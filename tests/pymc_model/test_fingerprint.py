"""Fingerprints agree for two builds of a model, in any process, and differ after any change."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.pymc_model.fingerprint import (
    model_data_fingerprint,
    model_fingerprint,
)
from pymc_statespace_filters.system.graph_digest import describe
from tests.systems import PAIR_DATA, STEPS, pair
from tests.waiting import LIMIT

X, Y = np.array([0.5, 1.0, -0.3]), np.array([1.0, 2.5, -0.5])


def regression(
    prior=pm.Normal,
    mean=0.0,
    sd=(1.0, 2.0),
    lower=0.0,
    noise="s",
    potential=lambda mu: -(mu[0] ** 2),
    derived=lambda mu: 2.0 * mu,
    derived_name="twice",
    dims="coefficient",
    coords=("slope", "offset"),
    start=None,
    x=X,
    y=Y,
    x_name="x",
):
    with pm.Model(coords={"coefficient": coords, "other": coords}) as model:
        mu = prior("mu", mean, np.array(sd), dims=dims, initval=start)
        s = pm.TruncatedNormal(noise, 0.0, 1.0, lower=lower)
        given = pm.Data(x_name, x)
        pm.Potential("pull", potential(mu))
        pm.Deterministic(derived_name, derived(mu))
        pm.Normal("y", mu[0] * given + mu[1], s, observed=y)
    return model


def shares(weights=(1.0, 2.0, 3.0), transform=pm.distributions.transforms.Interval):
    with pm.Model() as model:
        w = pm.Dirichlet("w", weights)
        pm.Uniform("u", 0.0, 1.0, default_transform=transform(0.0, 1.0))
        pm.Categorical("c", w, observed=[0, 1, 2])
    return model


def autoregression(decay=0.5, lag=-1, steps=4):
    """A Scan, whose inner graph and whose taps are both outside the graph around it."""
    with pm.Model() as model:
        a = pm.Normal("a")
        path = pytensor.scan(
            lambda past, a: decay * pt.tanh(a * past),
            outputs_info=[{"initial": pt.as_tensor([1.0, 2.0]), "taps": [lag]}],
            non_sequences=[a],
            n_steps=steps,
            return_updates=False,
        )
        pm.Potential("fit", -((path - 0.3) ** 2).sum())
    return model


def double(x, scale=2.0):
    return scale * x


def nested(factor=2.0):
    """A graph within an operation."""
    z = pt.dscalar("z")
    inner = pytensor.compile.builders.OpFromGraph([z], [factor * z**2])
    with pm.Model() as model:
        pm.Potential("p", -inner(pm.Normal("a")))
    return model


def state_space(filter=None, seed=0, name="d", dims=None, observed=PAIR_DATA, prior=1.0, **changes):
    with pm.Model() as model:
        pm.Normal("a", 0.0, prior)
        psf.StateSpace(
            name,
            pair(**changes),
            psf.EKF() if filter is None else filter,
            steps=STEPS,
            observed=observed,
            seed=seed,
            dims=dims,
        )
    return model


def particles(n=30, **settings):
    return psf.BootstrapPF(n, **settings)


def transition(factor, wave=pt.sin):
    return lambda x, q, a, b=0.2: [
        a * x[0] + b * wave(x[1]) + q[0],
        factor * x[1] + q[1],
    ]


MODELS = {
    "regression": regression,
    "shares": shares,
    "autoregression": autoregression,
    "nested": nested,
    "EKF": state_space,
    "BootstrapPF": lambda: state_space(particles()),
}

# Each differs from all others.
VARIANTS = {
    **MODELS,
    "prior's family": lambda: regression(prior=pm.Cauchy),
    "prior's mean": lambda: regression(mean=np.nextafter(0.0, 1.0)),
    "one number in an array": lambda: regression(sd=(1.0, 2.1)),
    "order in an array": lambda: regression(sd=(2.0, 1.0)),
    "type of an array": lambda: regression(sd=(1, 2)),
    "bound of a transform": lambda: regression(lower=0.1),
    "no bound": lambda: regression(lower=None),
    "name of a variable": lambda: regression(noise="sigma"),
    "constant of a potential": lambda: regression(potential=lambda mu: -2.0 * mu[0] ** 2),
    "power": lambda: regression(potential=lambda mu: -(mu[0] ** 4)),
    "index": lambda: regression(potential=lambda mu: -(mu[1] ** 2)),
    "operation": lambda: regression(potential=lambda mu: -abs(mu[0])),
    "axis": lambda: regression(potential=lambda mu: -mu[None].sum(axis=0)[0]),
    "other axis": lambda: regression(potential=lambda mu: -mu[None].sum(axis=1)[0]),
    "order of arguments": lambda: regression(derived=lambda mu: mu**2.0),
    "other order of arguments": lambda: regression(derived=lambda mu: 2.0**mu),
    "deterministic": lambda: regression(derived=lambda mu: 3.0 * mu),
    "name of a deterministic": lambda: regression(derived_name="double"),
    "dimension": lambda: regression(dims="other"),
    "coordinates": lambda: regression(coords=("slope", "level")),
    "start": lambda: regression(start=[0.1, 0.2]),
    "named start": lambda: regression(start="prior"),
    "name of data": lambda: regression(x_name="covariate"),
    "concentration": lambda: shares(weights=(1.0, 2.0, 3.5)),
    "transform": lambda: shares(transform=lambda *_: None),
    "constant in a loop": lambda: autoregression(decay=0.6),
    "lag of a loop": lambda: autoregression(lag=-2),
    "length of a loop": lambda: autoregression(steps=5),
    "constant within an operation": lambda: nested(factor=3.0),
    "filter": lambda: state_space(psf.EnKF(30)),
    "particles": lambda: state_space(particles(31)),
    "threshold": lambda: state_space(particles(resample_below=0.5)),
    "resampling": lambda: state_space(particles(resampling="multinomial")),
    "likelihood": lambda: state_space(psf.EnKF(30, likelihood="gaussian")),
    "constant of an equation": lambda: state_space(transition=transition(0.8)),
    "other constant": lambda: state_space(transition=transition(0.9)),
    "function in an equation": lambda: state_space(transition=transition(0.8, pt.cos)),
    "default of a parameter": lambda: state_space(
        transition=lambda x, q, a, b=0.3: [a * x[0] + b * x[1] + q[0], 0.8 * x[1] + q[1]]
    ),
    "process noise": lambda: state_space(process_noise=[[1.0, 0.0], [0.0, 0.6]]),
    "observation": lambda: state_space(observation=lambda x: [x[0], 2.0 * x[1]]),
    "observation noise": lambda: state_space(observation_noise=[[0.5, 0.1], [0.1, 0.5]]),
    "initial mean": lambda: state_space(initial_mean=[0.0, 0.4]),
    "initial covariance": lambda: state_space(initial_cov=[[1.0, 0.1], [0.1, 2.0]]),
    "time step": lambda: state_space(dt=0.5),
    "name of a state": lambda: state_space(states=["s", "v"]),
    "name of an observable": lambda: state_space(observables=["position", "velocity"]),
    "prior of a parameter": lambda: state_space(prior=2.0),
    "name of a record": lambda: state_space(name="record"),
    "dimension of a record": lambda: state_space(dims=("when", "what")),
}


def fingerprints(models):
    built = {name: build() for name, build in models.items()}
    return {name: (model_fingerprint(m), model_data_fingerprint(m)) for name, m in built.items()}


def test_fingerprints_agree_for_two_builds_and_in_another_process():
    here = fingerprints(MODELS)
    script = (
        "from tests.pymc_model.test_fingerprint import *\n"
        "for name, prints in fingerprints(MODELS).items(): print(name, *prints)"
    )
    again = fingerprints(MODELS)
    assert again == here
    hash_seed = "1" if os.environ.get("PYTHONHASHSEED") != "1" else "2"
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=Path(__file__).parents[2],
        env=os.environ | {"PYTHONHASHSEED": hash_seed},
        capture_output=True,
        timeout=LIMIT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    assert {name: tuple(prints) for name, *prints in lines} == here


def test_every_change_of_a_model_changes_its_fingerprint():
    found = {}
    for name, build in VARIANTS.items():
        found.setdefault(model_fingerprint(build()), []).append(name)
    assert [names for names in found.values() if len(names) > 1] == []


def test_fingerprints_do_not_depend_on_what_was_done_with_the_model():
    model, fresh = regression(), regression()
    model.compile_logp()(model.initial_point())
    assert model_fingerprint(model) == model_fingerprint(fresh)
    assert model_data_fingerprint(model) == model_data_fingerprint(fresh)


def test_generators_are_no_part_of_a_model():
    def model(seed):
        with pm.Model() as model:
            rng = pt.random.shared_rng(seed=seed)
            mu = pm.Normal("mu")
            _, noise = pt.random.normal(mu, rng=rng, return_next_rng=True)
            pm.Deterministic("replicated", noise, dims=())
        return model

    assert model_fingerprint(model(1)) == model_fingerprint(model(2))
    assert model_data_fingerprint(model(1)) == model_data_fingerprint(model(2))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (regression, lambda: regression(y=np.array([1.0, 2.5, -0.6]))),
        (regression, lambda: regression(x=np.array([0.5, -0.3, 1.0]))),
        (regression, lambda: regression(y=X, x=Y)),
        (state_space, lambda: state_space(observed=np.nan_to_num(PAIR_DATA))),
        (state_space, lambda: state_space(observed=PAIR_DATA[::-1])),
        (MODELS["BootstrapPF"], lambda: state_space(particles(), seed=1)),
    ],
)
def test_other_data_are_another_fingerprint_of_data_alone(one, other):
    assert model_fingerprint(one()) == model_fingerprint(other())
    assert model_data_fingerprint(one()) != model_data_fingerprint(other())


def test_data_that_were_exchanged_are_seen():
    model = regression()
    whole, before = model_fingerprint(model), model_data_fingerprint(model)
    pm.set_data({"x": 2.0 * X}, model=model)
    assert model_fingerprint(model) == whole
    assert model_data_fingerprint(model) == model_data_fingerprint(regression(x=2.0 * X)) != before


def test_shared_variables_without_a_name_or_with_one_name_are_data_in_order():
    def model(values, names=(None, None)):
        first, second = (pytensor.shared(v, name=n) for v, n in zip(values, names, strict=True))
        with pm.Model() as model:
            a = pm.Normal("a")
            pm.Potential("p", -((a - first) ** 2) / second)
        return model

    for names in [(None, None), ("s", "s")]:
        one, other = model((1.0, 2.0), names), model((2.0, 1.0), names)
        assert model_data_fingerprint(one) != model_data_fingerprint(other)
        assert model_fingerprint(one) == model_fingerprint(other)


class Scaled(Op):
    """An operation of a user who declares no properties."""

    def __init__(self, scale):
        self.scale = scale

    def make_node(self, x):
        return Apply(self, [x], [x.type()])

    def perform(self, node, inputs, outputs):
        outputs[0][0] = inputs[0] * 2.0


def scaled(scale):
    with pm.Model() as model:
        pm.Potential("p", Scaled(scale)(pm.Normal("a")))
    return model


def test_operations_without_properties_are_what_their_attributes_are():
    scales = [2.0, 2, np.array([2.0]), np.array([3.0]), double, {"a": 1}, {"a": 2}, None]
    prints = [model_fingerprint(scaled(scale)) for scale in scales]
    assert len(set(prints)) == len(scales)
    assert prints[2] == model_fingerprint(scaled(np.array([2.0])))


@pytest.mark.parametrize("scale", [lambda x: x, object(), [object()], {"f": iter([])}])
def test_operations_that_look_different_in_every_process_are_refused(scale):
    with pytest.raises(ModelError) as caught:
        model_fingerprint(scaled(scale))
    assert "'scale' of the operation" in str(caught.value)
    assert "Scaled" in str(caught.value)
    assert "cannot be recognised in another process" in str(caught.value)


def test_wrapped_python_functions_are_refused():
    wrapped = pytensor.wrap_py([pt.dscalar], [pt.dscalar])(lambda x: x)
    with pm.Model() as model:
        pm.Potential("p", wrapped(pm.Normal("a")))
    with pytest.raises(
        ModelError, match=r"of the operation pytensor.*FromFunctionOp must have .* got the fun"
    ):
        model_fingerprint(model)


def test_descriptions_do_not_depend_on_the_order_of_sets_and_mappings():
    assert describe({"a": 1, "b": {2, 3}}) == describe({"b": {3, 2}, "a": 1})
    texts = [
        describe(v) for v in ({"a": 1}, {"a": 1.0}, {"a": True}, ("a", 1), ["a", 1], "a", b"a")
    ]
    assert len(set(texts)) == len(texts)
