"""Drifts of second order: against the equations written by hand, with inputs and parameters."""

import numpy as np
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.symbols import call, jacobian_of
from tests.modes import AS_IT_STANDS

MASS = np.array([[2.0, 0.5], [0.5, 1.0]])
DAMPING = np.array([[0.3, -0.1], [-0.1, 0.2]])
STIFFNESS = np.array([[7.0, -3.0], [-3.0, 3.5]])


def system_of(drift, n=4, **changes):
    settings = dict(
        transition=psf.EulerMaruyama(drift, np.zeros((n, 1)), dt=0.1),
        observation=lambda x: [x[0]],
        observation_noise=[[0.01]],
        initial_mean=np.zeros(n),
        initial_cov=np.zeros((n, n)),
    )
    return psf.StateSpaceModel(**settings | changes)


def drift_at(drift, x, params=None, u=(), t=0.0, **changes):
    """The drift of a system at numbers, by its Euler step."""
    x = np.array(x, dtype=float)
    system = system_of(drift, len(x), **changes)
    theta = np.concatenate(
        [np.ravel((params or {})[name]).astype(float) for name in system.parameters] or [[]]
    )
    values = {"theta": theta, "x": x, "u": u, "t": t}
    symbols = {name: pt.as_tensor(np.asarray(v, dtype="float64")) for name, v in values.items()}
    moved = call(system.equations.transition, system, symbols).eval(mode=AS_IT_STANDS)
    return (moved - x) / 0.1


X = np.array([0.4, -0.7, 1.1, 0.3])
Q, V = X[:2], X[2:]
LINEAR = -DAMPING @ V - STIFFNESS @ Q


def assert_drift(found, force, mass=MASS, v=V):
    np.testing.assert_allclose(found, [*v, *np.linalg.solve(mass, force)], rtol=1e-12)


def test_matrices_of_numbers():
    """In lists too, and without symmetry; a diagonal mass matrix is divided by."""
    mass = np.array([[2.0, 0.8], [0.5, 1.0]])
    drift = psf.mechanics.second_order(mass, DAMPING.tolist(), STIFFNESS.tolist())
    assert_drift(drift_at(drift, X), LINEAR, mass)
    diagonal = np.diag([2.0, 0.5])
    drift = psf.mechanics.second_order(diagonal, DAMPING, STIFFNESS)
    assert_drift(drift_at(drift, X), LINEAR, diagonal)


def test_matrices_of_parameters():
    """In order of appearance, with defaults and shapes; a mass matrix that is not symmetric."""
    drift = psf.mechanics.second_order(
        mass=lambda m, off=0.5: [[m[0], off], [-off, m[1]]],
        damping=lambda c: pt.stack([[c, -c / 2], [-c / 2, c]]),
        stiffness=lambda k, m, k2=2.0: [[k + k2, -k], [-k, k * m[1]]],
        force=lambda q, v, t, k3, k: [k3 * q[0] ** 3 + k * v[1], t * q[1]],
    )
    assert system_of(drift, shapes={"m": (2,)}).parameters == ("m", "off", "c", "k", "k2", "k3")
    assert dict(system_of(drift, shapes={"m": (2,)}).defaults) == {"off": 0.5, "k2": 2.0}
    m, off, c, k, k2, k3, t = [2.0, 3.0], 0.7, 0.4, 5.0, 1.5, 0.8, 2.5
    found = drift_at(
        drift, X, dict(m=m, off=off, c=c, k=k, k2=k2, k3=k3), t=t, shapes={"m": (2,)}
    )  # fmt: skip
    force = -np.array([[c, -c / 2], [-c / 2, c]]) @ V
    force -= np.array([[k + k2, -k], [-k, k * m[1]]]) @ Q
    force -= [k3 * Q[0] ** 3 + k * V[1], t * Q[1]]
    assert_drift(found, force, np.array([[m[0], off], [-off, m[1]]]))


def test_a_single_position():
    drift = psf.mechanics.second_order(lambda m: m, 0.3, lambda k: [[k]], lambda q: [q[0] ** 3])
    found = drift_at(drift, [0.5, -1.0], dict(m=2.0, k=4.0))
    np.testing.assert_allclose(found, [-1.0, (0.3 - 2.0 - 0.125) / 2.0], rtol=1e-12)


def test_inputs_are_forces_on_the_positions():
    """One each, beside a force without inputs; none without inputs; else where the force says."""
    u, named = [0.9, -0.4], {"inputs": ["left", "right"]}
    plain = psf.mechanics.second_order(MASS, DAMPING, STIFFNESS)
    assert_drift(drift_at(plain, X, u=u, **named), LINEAR + u)
    cubic = psf.mechanics.second_order(MASS, DAMPING, STIFFNESS, lambda q: q**3)
    assert_drift(drift_at(cubic, X, u=u, **named), LINEAR - Q**3 + u)
    ground = psf.mechanics.second_order(
        MASS, DAMPING, STIFFNESS, lambda u: [2.0 * u[0], 1.0 * u[0]]
    )
    assert_drift(
        drift_at(ground, X, u=[0.9], inputs=["ground"]), LINEAR - 0.9 * np.array([2.0, 1.0])
    )
    two = psf.mechanics.second_order(MASS, DAMPING, STIFFNESS, lambda u: [u[1], 0.0])
    assert_drift(drift_at(two, X, u=u, **named), LINEAR - [u[1], 0.0])


def test_equal_equations_are_equal_systems():
    def system():
        return system_of(psf.mechanics.second_order(MASS, lambda c: c * DAMPING, STIFFNESS))

    assert system() == system()
    assert hash(system()) == hash(system())
    assert system() != system_of(
        psf.mechanics.second_order(MASS, lambda c: 2 * c * DAMPING, STIFFNESS)
    )


def test_a_mass_matrix_of_parameters_has_its_derivative_by_the_state():
    """A free oscillation has the frequencies of the matrices."""
    drift = psf.mechanics.second_order(
        lambda m: [[m, 0.5], [0.5, 1.0]], np.zeros((2, 2)), lambda k: [[k, -3.0], [-3.0, 3.5]]
    )
    system, x = system_of(drift), pt.dvector("x", shape=(4,))
    values = {"theta": pt.constant([2.0, 7.0]), "x": x, "u": pt.zeros(0), "t": pt.constant(0.0)}
    step = jacobian_of(call(system.equations.transition, system, values), x)
    found = np.linalg.eigvals((step.eval({x: np.zeros(4)}, mode=AS_IT_STANDS) - np.eye(4)) / 0.1)
    squares = np.linalg.eigvals(np.linalg.solve(MASS, STIFFNESS)).real
    np.testing.assert_allclose(np.sort(np.abs(found)), np.sqrt(np.repeat(np.sort(squares), 2)))
    np.testing.assert_allclose(found.real, 0.0, atol=1e-12)


def drift_with(**changes):
    return lambda: psf.mechanics.second_order(
        **{"mass": MASS, "damping": DAMPING, "stiffness": STIFFNESS} | changes
    )


def in_system(n=4, inputs=None, **changes):
    return lambda: system_of(drift_with(**changes)(), n, inputs=inputs)


WRONG = [
    (drift_with(mass=[1.0, 2.0]), r"mass must be a square matrix of finite .* got \[1.0, 2.0\]"),
    (drift_with(damping=[[np.nan]]), r"damping must be a square .*got \[\[nan\]\]"),
    (drift_with(stiffness="soft"), "stiffness must be .* got 'soft'"),
    (drift_with(mass=np.ones((2, 2))), "mass must be an invertible matrix, got"),
    (drift_with(mass=lambda q: q), "mass: the argument name 'q' is reserved"),
    (drift_with(mass=lambda v: [[v]]), "no parameter 'v', the velocities"),
    (drift_with(force=lambda x: x), "force: the argument name 'x' is reserved for the state"),
    (drift_with(force=1.0), "force must be a function, got 1.0"),
    (
        drift_with(mass=lambda k=1.0: k, stiffness=lambda k=2.0: k),
        "parameter 'k' must have one default, got 1.0 and 2.0",
    ),
    (in_system(n=3), "an even number of states, got 3"),
    (in_system(n=6), r"mass must have shape \(3, 3\), got \(2, 2\)"),
    (in_system(force=lambda q: [q[0]]), r"force must have shape \(2,\), got \(1,\)"),
    (in_system(inputs=["one"]), r"one force per position \(2\), got 1: name as many, or let force"),
    (in_system(force=lambda u: u), "drift has the argument u, so inputs must name the inputs"),
]


@pytest.mark.parametrize(("make", "message"), WRONG)
def test_what_is_no_equation_of_motion(make, message):
    with pytest.raises(psf.errors.ModelError, match=message):
        make()
