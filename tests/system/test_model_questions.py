"""What samplers and evidence ask of a model: seeds, dependence, health, exactness."""

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.graph.basic import Variable

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.pymc_model.inspection import exactness, health_outputs, noise_seeds
from pymc_statespace_filters.system.equations import folded_constants
from tests.systems import PAIR, PAIR_DATA, STEPS

ENKF = psf.EnKF(20)


def pair_variable(name, filter=psf.EKF(), **changes):  # noqa: B008 (settings are frozen)
    return psf.StateSpace(name, PAIR, filter, steps=STEPS, observed=PAIR_DATA, **changes)


def test_noise_seeds_are_those_of_estimates_alone():
    with pm.Model() as model:
        pm.Normal("a", 0.5, 1)
        pair_variable("exact")
        pair_variable("noisy", filter=ENKF, seed=2**40 + 3)
        pair_variable("unbiased", filter=psf.BootstrapPF(20))
    seeds = noise_seeds(model)
    assert list(seeds) == ["noisy", "unbiased"]
    assert seeds["noisy"] is model["noisy_seed"]
    assert "exact_seed" not in model.named_vars
    assert seeds["noisy"].type == pytensor.shared(np.array(0, dtype="int64")).type
    assert seeds["noisy"].get_value() == 2**40 + 3


@pytest.mark.parametrize(
    ("filter", "exact"),
    [(psf.EKF(), True), (psf.BootstrapPF(20), True), (ENKF, False), (psf.PFEnKF(20), False)],
)
def test_exactness(filter, exact):
    with pm.Model() as model:
        pair_variable("d", filter=filter, params={"a": 0.6})
    assert exactness(model) is exact
    with model:
        pair_variable("e", filter=ENKF, params={"a": 0.6})
    assert not exactness(model)


@pytest.mark.parametrize("exact", [psf.EKF(), psf.BootstrapPF(20)], ids=["EKF", "PF"])
def test_a_filter_that_approximates_the_system_is_not_exact(exact):
    """The EKF is exact for linear systems, the bootstrap filter where the density is."""

    def system(power, observation):
        return psf.StateSpaceModel(
            lambda x, q: [x[0] ** power + q[0]],
            observation,
            process_noise=[[1.0]],
            observation_noise=[[1.0]],
            initial_mean=[0.0],
            initial_cov=[[1.0]],
        )

    additive, general = (lambda x: [x[0]]), (lambda x, e: [x[0] + x[0] * e[0]])
    assert exact.is_exact_for(compile_system(system(1, additive)))
    assert exact.is_exact_for(compile_system(system(3, additive))) is isinstance(
        exact, psf.BootstrapPF
    )
    assert not exact.is_exact_for(compile_system(system(1, general)))


def test_health_comes_out_of_the_same_evaluation():
    with pm.Model() as model:
        pm.Normal("a", 0.5, 1)
        pair_variable("first")
        pair_variable("second", params={"b": 1.0})
    logp = model.logp()
    health = health_outputs([logp])
    assert len(health) == 2
    assert [h.type.ndim for h in health] == [1, 1]
    values = model.compile_fn([logp, *health])({"a": 1e300})
    assert values[0] == -np.inf
    for record in values[1:]:
        assert record.dtype == "float64"
        assert record.shape == (3,)
        assert record[1] != 0
        assert record[2] == 1  # step 0 is met before any power of a


def test_constants_are_known_whatever_they_are_made_of():
    x, s = pt.vector("x", shape=(3,)), pt.scalar("s")
    known = folded_constants([pt.roll(x, 1).shape[0], 0.0 * s, pt.stack([s - s, 1.0])])
    assert known[0] == 3
    assert known[1] == 0.0
    np.testing.assert_array_equal(known[2], [0.0, 1.0])
    assert isinstance(folded_constants([2.0 * s])[0], Variable)


# One component may be written as a scalar: the system is that of the lists.


LISTS = dict(
    transition=lambda x, q, a: [a * x[0] + q[0]],
    process_noise=[[1.0]],
    observation=lambda x: [x[0]],
    observation_noise=[[0.04]],
    initial_mean=[0.0],
    initial_cov=[[1.0]],
)


@pytest.mark.parametrize(
    ("scalars", "lists"),
    [
        (dict(initial_mean=0.0, initial_cov=1.0, observation_noise=0.04, process_noise=1), {}),
        (dict(initial_mean=np.float64(0.0), initial_cov=np.array(1.0)), {}),
        (dict(transition=lambda x, q, a: a * x[0] + q[0], observation=lambda x: x[0]), {}),
        (dict(process_noise=lambda s: s**2), dict(process_noise=lambda s: [[s**2]])),
        (dict(observation_noise=lambda s: s), dict(observation_noise=lambda s: [[s]])),
        (dict(initial_cov=lambda s: 2.0), dict(initial_cov=lambda s: [[2.0]])),
        (dict(initial_mean=lambda m: m / 2), dict(initial_mean=lambda m: [m / 2])),
        (
            dict(observation=lambda x, e: x[0] * pt.exp(e[0]), observation_noise=0.1),
            dict(observation=lambda x, e: [x[0] * pt.exp(e[0])], observation_noise=[[0.1]]),
        ),
    ],
)
def test_a_scalar_is_the_list_of_one(scalars, lists):
    written = psf.StateSpaceModel(**LISTS | scalars)
    assert written == psf.StateSpaceModel(**LISTS | lists)
    assert (written.n, written.m, written.p, written.r) == (1, 1, 1, 1)


@pytest.mark.parametrize("diffusion", [0.6, lambda sigma: sigma, lambda x, s: s * x[0]])
def test_scalars_of_an_integrator(diffusion):
    def euler(drift, diffusion):
        step = psf.EulerMaruyama(drift, diffusion, dt=0.1)
        return psf.StateSpaceModel(**LISTS | dict(transition=step, process_noise=None))

    matrix = {1: lambda sigma: [[sigma]], 2: lambda x, s: [[s * x[0]]]}
    n_arguments = diffusion.__code__.co_argcount if callable(diffusion) else 0
    listed = euler(lambda x, a: [-a * x[0]], matrix.get(n_arguments, [[0.6]]))
    assert euler(lambda x, a: -a * x[0], diffusion) == listed


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (dict(initial_mean=[0.0, 0.0], initial_cov=np.eye(2)), r"transition .*one expression per"),
        (dict(observables=["a", "b"]), r"observation .*one expression per"),
        (dict(initial_cov=[1.0]), r"initial_cov .*square matrix, got shape \(1,\)"),
    ],
)
def test_a_scalar_is_not_repeated_for_several(changes, words):
    scalars = dict(transition=lambda x, q, a: a * x[0] + q[0], observation=lambda x: x[0])
    with pytest.raises(psf.errors.ModelError, match=words):
        psf.StateSpaceModel(**LISTS | scalars | changes)
