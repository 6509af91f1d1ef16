"""What a user writes is what the system is: traced once, immutable, equal by its equations."""

import multiprocessing
import pickle

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.compiler.lowering.symbols import call


def drift(x, alpha, beta):
    return [alpha * x[0] + beta * x[0] ** 3]


def drift_with_default(x, alpha, beta=1.0):
    return drift(x, alpha, beta)


def diffusion(sigma_m):
    return [[0.6, sigma_m]]


def position(x):
    return [x[0]]


def double_well(**changes):
    arguments = dict(
        transition=psf.EulerMaruyama(drift, diffusion, dt=0.01),
        observation=position,
        observation_noise=[[0.08]],
        initial_mean=[1.0],
        initial_cov=[[0.5]],
        states=["x"],
        observables=["position"],
    )
    return psf.StateSpaceModel(**(arguments | changes))


def moved(system, params, x, q=None, inputs=None, k=0, t=0.0):
    """One transition of one member, by the compiled code."""
    machine = compile_system(system)
    theta = np.concatenate([np.ravel(params[name]).astype(float) for name in system.parameters])
    X, Z = np.array(x, dtype=float)[:, None], np.zeros((system.m, 64))
    Z[:, 0] = 0.0 if q is None else q
    inputs = np.zeros((k + 1, 0)) if inputs is None else np.asarray(inputs, dtype=float)
    machine.propagate.function(machine.prepare.function(theta), inputs, k, t, Z, X)
    return X[:, 0]


def traced(system, params, x, q, inputs=(), t=0.0):
    """One transition as it was traced, with every noise by itself."""
    theta = np.concatenate([np.ravel(params[name]).astype(float) for name in system.parameters])
    values = {"theta": theta, "x": x, "q": q, "u": inputs, "t": t}
    symbols = {name: pt.as_tensor(np.asarray(v, dtype="float64")) for name, v in values.items()}
    return call(system.equations.transition, system, symbols).eval()


def test_the_first_example():
    system = double_well()
    assert system.parameters == ("alpha", "beta", "sigma_m")
    assert (system.n, system.m, system.p, system.dt) == (1, 2, 1, 0.01)
    assert (system.states, system.observables) == (("x",), ("position",))
    point = {"alpha": 4.0, "beta": -4.0, "sigma_m": 0.8}
    expected = 1.5 + 0.01 * (4 * 1.5 - 4 * 1.5**3) + 0.1 * (0.6 * 0.3 + 0.8 * -0.7)
    np.testing.assert_allclose(traced(system, point, [1.5], [0.3, -0.7]), [expected], rtol=1e-14)


def test_default_names():
    system = double_well(states=None, observables=None)
    assert (system.states, system.observables) == (("x0",), ("y0",))


@pytest.mark.parametrize("form", ["unpacked", "indexed", "matrix", "nested", "closure"])
def test_ways_to_write_an_oscillator(form):
    matrix = np.array([[0.0, 1.0], [-2.0, -0.5]])

    def unpacked(x, k, c):
        place, velocity = x
        return [velocity, -k * place - c * velocity]

    ways = {
        "unpacked": unpacked,
        "indexed": lambda x, k, c: [x[1], -k * x[0] - c * x[1]],
        "matrix": lambda x, k, c: pt.stack([[0, 1], [-k, -c]]) @ x,
        "nested": lambda x, k, c: pt.stack([[0, 1], [0, -c]]) @ x - [0.0, k * x[0]],
        "closure": lambda x, k, c: matrix @ x + 0 * (k + c),
    }
    system = double_well(
        transition=psf.EulerMaruyama(ways[form], [[0.0], [1.0]], dt=0.1),
        initial_mean=[1.0, 0.0], initial_cov=np.eye(2), states=None,
    )  # fmt: skip
    assert system.parameters == ("k", "c")
    x = np.array([0.7, -0.2])
    expected = x + 0.1 * matrix @ x + np.sqrt(0.1) * np.array([0.0, 0.4])
    got = moved(system, {"k": 2.0, "c": 0.5}, x, [0.4])
    np.testing.assert_allclose(got, expected, rtol=1e-13)


def test_substeps_are_euler_steps_with_noise_of_their_own():
    step = psf.EulerMaruyama(lambda x, t, u, a: [a * x[0] + t + u[0]], [[0.6]], 0.2, substeps=2)
    system = double_well(transition=step, inputs=["force"])
    assert system.m == 2
    x = 1.0
    for i, q in enumerate([0.3, -0.5]):
        x += 0.1 * (-1.5 * x + (2.0 + 0.1 * i) + 7.0) + np.sqrt(0.1) * 0.6 * q
    got = traced(system, {"a": -1.5}, [1.0], [0.3, -0.5], inputs=[7.0], t=2.0)
    np.testing.assert_allclose(got, [x], rtol=1e-14)


def test_parameters_come_in_order_of_first_appearance_and_share_defaults():
    def rival(x, alpha, beta=0.0):
        return [alpha * x[0] + beta * x[0] ** 3]

    system = double_well(
        transition=psf.EulerMaruyama(rival, diffusion, dt=0.01),
        observation=lambda x, gain: [gain * x[0] + 0 * x[0]],
        observation_noise=lambda noise, gain: [[noise * gain]],
        initial_mean=lambda start=1.0: [start],
        initial_cov=lambda alpha, spread: [[spread]],
    )
    assert system.parameters == (
        "alpha", "beta", "sigma_m", "gain", "noise", "start", "spread",
    )  # fmt: skip
    assert dict(system.defaults) == {"beta": 0.0, "start": 1.0}


def test_functions_of_parameters_for_every_covariance():
    system = psf.StateSpaceModel(
        transition=lambda x, q, a: a * x + q,
        process_noise=lambda s, r: [[s, r], [r, 2 * s]],
        observation=lambda x: x,
        observation_noise=lambda g: g * pt.eye(2),
        initial_mean=lambda m: pt.stack([m, 2 * m]),
        initial_cov=lambda L: L @ L.T,
        shapes={"L": (2, 2)},
    )
    assert system.parameters == ("a", "g", "s", "r", "m", "L")  # in the order of the arguments
    machine = compile_system(system)
    c = machine.prepare.function(np.array([0.9, 4.0, 1.0, 0.5, 3.0, 1.0, 0.0, 0.5, 2.0]))
    X, Z = np.empty((2, 1)), np.zeros((2, 64))
    Z[:, 0] = [1.0, -1.0]
    machine.initialise.function(c, Z, X)
    np.testing.assert_allclose(X[:, 0], [3 + 1, 6 + 0.5 - 2], rtol=1e-14)
    machine.propagate.function(c, np.zeros((1, 0)), 0, 0.0, Z, X)
    root = np.linalg.cholesky([[1.0, 0.5], [0.5, 2.0]])
    np.testing.assert_allclose(X[:, 0], 0.9 * np.array([4, 4.5]) + root @ [1, -1], rtol=1e-14)


def test_vector_parameters():
    system = psf.StateSpaceModel(
        transition=lambda x, k, c: [k[0] * x[0] + k[1], c * x[1]],
        observation=lambda x: [x[0]],
        observation_noise=[[1.0]],
        initial_mean=[0.0, 0.0],
        initial_cov=np.eye(2),
        shapes={"k": (2,)},
    )
    assert (system.n_theta, system.m, system.dt) == (3, 0, 1.0)
    np.testing.assert_allclose(
        moved(system, {"k": [2.0, 3.0], "c": 0.5}, [1.0, 4.0]), [5.0, 2.0], rtol=1e-15
    )


def test_an_observation_may_return_what_has_no_shape_of_its_own():
    system = double_well(
        observation=lambda x: pt.roll(pt.concatenate([x, 2 * x]), 1), observation_noise=np.eye(2),
        observables=["twice", "once"],
    )  # fmt: skip
    assert system.p == 2


# Identity


def test_a_system_is_immutable():
    system = double_well()
    with pytest.raises(AttributeError, match="immutable"):
        system.dt = 1.0
    with pytest.raises(AttributeError):
        del system.dt


def test_an_array_changed_afterwards_does_not_change_the_system():
    noise = np.array([[0.08]])
    system, other = double_well(observation_noise=noise), double_well()
    noise[:] = 5.0
    assert system == other


def test_equal_equations_make_equal_systems():
    one = double_well(observation=lambda x: [x[0]])
    two = double_well(observation=lambda x: [x[0]])
    assert one == two
    assert hash(one) == hash(two)
    assert one.fingerprint == two.fingerprint
    assert compile_system(one) is compile_system(two)  # compiled once


@pytest.mark.parametrize(
    "changes",
    [
        dict(observation=lambda x: [2 * x[0]]),
        dict(observation=lambda x: [x[0] + 1e-12]),
        dict(observation_noise=[[0.09]]),
        dict(initial_mean=[1.5]),
        dict(initial_cov=[[0.0]]),
        dict(states=["y"]),
        dict(observables=["y"]),
        dict(inputs=["force"]),
        dict(carried=["x"]),
        dict(transition=psf.EulerMaruyama(drift, diffusion, dt=0.02)),
        dict(transition=psf.EulerMaruyama(drift, diffusion, dt=0.01, substeps=2)),
        dict(transition=psf.EulerMaruyama(lambda x, a, b: drift(x, a, b), diffusion, dt=0.01)),
        dict(transition=psf.EulerMaruyama(drift_with_default, diffusion, dt=0.01)),
    ],
)  # fmt: skip
def test_any_difference_makes_another_system(changes):
    system, other = double_well(), double_well(**changes)
    assert system != other
    assert system.fingerprint != other.fingerprint


def test_a_closure_is_a_constant():
    def with_gain(gain):
        return double_well(observation=lambda x: [gain * x[0]])

    assert with_gain(2.0) == with_gain(2.0)
    assert with_gain(2.0) != with_gain(3.0)


def fingerprint_and_equality(data):
    system = pickle.loads(data)
    return system.fingerprint, system == double_well(), hash(system) == hash(double_well())


def test_a_system_goes_to_another_process():
    system = double_well()
    hash(system)  # a hash differs between processes and must stay behind
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        fingerprint, equal, same_hash = pool.apply(fingerprint_and_equality, [pickle.dumps(system)])
    assert fingerprint == system.fingerprint
    assert equal
    assert same_hash


def test_systems_of_lambdas_and_distributions_are_picklable():
    system = double_well(
        observation=None, observation_noise=None,
        observation_dist=lambda x, c: [pm.Poisson.dist(mu=pt.exp(c + x[0]))],
    )  # fmt: skip
    copy = pickle.loads(pickle.dumps(system))
    assert copy == system
    assert copy.fingerprint == system.fingerprint
    assert psf.simulate(copy, {"alpha": -1.0, "beta": 0.0, "sigma_m": 0.1, "c": 1.0}, steps=[3])


def test_repr_is_short():
    assert repr(double_well()) == (
        "StateSpaceModel(states=['x'], observables=['position'], "
        "parameters=['alpha', 'beta', 'sigma_m'], dt=0.01)"
    )
