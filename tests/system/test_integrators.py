"""Integrators: the measured order of each, against solutions in closed form."""

import pickle

import numpy as np
import pytensor.tensor as pt
import pytest
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.ops.base import kernel
from pymc_statespace_filters.ops.likelihood import LogLikelihoodGradient
from pymc_statespace_filters.pymc_model.step_refinement import path_eigenvalues

BLOCK = 64  # columns of an ensemble are padded to whole blocks


def system_of(integrator, mean=(1.0, 0.5), **settings):
    n = len(mean)
    return psf.StateSpaceModel(
        transition=integrator,
        observation=lambda x: [x[0]],
        observation_noise=[[0.01]],
        initial_mean=list(mean),
        initial_cov=np.zeros((n, n)),
        **settings,
    )


def ends(system, params, X, n_steps, Z=None, inputs=None):
    """The states (n, N) after so many steps by the compiled step; Z (steps, m, N)."""
    machine = compile_system(system)
    theta = np.array([params[name] for name in system.parameters], dtype=float)
    c = machine.prepare.function(theta)
    X = np.array(X, dtype=float)
    inputs = np.zeros((n_steps, 0)) if inputs is None else inputs
    nothing = np.zeros((machine.m, X.shape[1]))
    for k in range(n_steps):
        z = nothing if Z is None else np.ascontiguousarray(Z[k])
        machine.propagate.function(c, inputs, k, k * system.dt, z, X)
    return X


def slope_of(lengths, errors):
    """Slope of log error against log length, and its standard error from the residuals."""
    x, y = np.log(lengths), np.log(errors)
    design = np.stack([x - x.mean(), np.ones_like(x)], axis=1)
    coefficients, residual, *_ = np.linalg.lstsq(design, y, rcond=None)
    variance = residual.sum() / (len(x) - 2) / ((x - x.mean()) ** 2).sum()
    return coefficients[0], np.sqrt(variance)


# Without noise: x1'' + 0.2 x1' + 4 x1 = u + 5 t, a vector with inputs and time.

OSCILLATOR = np.array([[0.0, 1.0], [-4.0, -0.2]])


def forced(x, u, t, k, c):
    return [x[1], -k * x[0] - c * x[1] + u[0] + 5.0 * t]


def forced_exactly(start, n_steps, dt, u):
    """The exact solution: the forcing is linear in time over each step, by an augmented matrix."""
    state = np.array(start)
    for k in range(n_steps):
        whole = np.zeros((4, 4))
        whole[:2, :2] = OSCILLATOR
        whole[1, 2], whole[1, 3], whole[2, 3] = 1.0, u[k], 1.0
        force = np.array([5.0 * k * dt, 1.0])  # 5 t, and the constant 1
        whole[2, 3] = 5.0
        state = (expm(whole * dt) @ np.concatenate([state, force]))[:2]
    return state


def of_forced(name, dt, substeps=1):
    if name == "SemiImplicitEuler":
        return psf.SemiImplicitEuler(forced, dt=dt, velocities=[1], substeps=substeps)
    if name in ("RungeKutta4", "LocalLinearization"):
        return getattr(psf, name)(forced, None, dt=dt, substeps=substeps)
    return getattr(psf, name)(forced, np.zeros((2, 1)), dt=dt, substeps=substeps)


@pytest.mark.parametrize(
    ("name", "order", "numbers"),
    [
        ("RungeKutta4", 4, [8, 16, 24]),
        ("LocalLinearization", 1, [16, 32, 48]),
        ("SemiImplicitEuler", 1, [64, 128, 256]),
        ("EulerMaruyama", 1, [64, 128, 256]),
    ],
)
def test_order_of_the_drift_with_inputs_and_time(name, order, numbers):
    """The slope tends to the order as the steps get shorter."""
    u, start = np.array([0.3, -1.0, 2.0, 0.5]), np.array([1.0, 0.5])
    exact = forced_exactly(start, 4, 0.5, u)
    errors = []
    for number in numbers:
        system = system_of(of_forced(name, 0.5 / number), inputs=["force"])
        held = np.repeat(u, number)[:, None]
        X = np.repeat(start[:, None], BLOCK, axis=1)
        found = ends(system, {"k": 4.0, "c": 0.2}, X, 4 * number, inputs=held)[:, 0]
        errors.append(np.linalg.norm(found - exact))
    slope, error = slope_of(0.5 / np.array(numbers), errors)
    assert abs(slope - order) < 0.1
    assert error < 0.05


@pytest.mark.parametrize("name", ["RungeKutta4", "SemiImplicitEuler", "EulerMaruyama", "Milstein"])
def test_substeps_are_shorter_steps_with_inputs_held(name):
    params, X = {"k": 4.0, "c": 0.2}, np.repeat(np.array([[1.0], [0.5]]), BLOCK, axis=1)
    whole = system_of(of_forced(name, 0.2, substeps=2), inputs=["force"])
    parts = system_of(of_forced(name, 0.1), inputs=["force"])
    found = ends(whole, params, X, 2, inputs=np.array([[0.3], [-1.0]]))
    expected = ends(parts, params, X, 4, inputs=np.repeat([[0.3], [-1.0]], 2, axis=0))
    np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_an_undamped_oscillator_gains_no_energy_in_100_000_steps():
    """Its energy swings by a fraction w h and does not drift; that of Euler's grows by w^2 h^2."""

    def oscillator(x, w):
        return [x[1], -(w**2) * x[0]]

    def after(integrator, n_steps):
        system = system_of(integrator, mean=(1.0, 0.0), states=["place", "speed"])
        X = np.zeros((2, BLOCK))
        X[0] = np.linspace(0.1, 1.0, BLOCK)  # members of other energies and phases
        X[1] = np.linspace(0.5, 0.0, BLOCK)
        return (X**2).sum(axis=0), (ends(system, {"w": 1.0}, X, n_steps) ** 2).sum(axis=0)

    start, end = after(psf.SemiImplicitEuler(oscillator, dt=0.1, velocities=["speed"]), 100_000)
    assert (np.abs(end / start - 1) < 0.1).all()
    assert (np.abs(end / start - 1) > 0.001).any()
    start, end = after(psf.EulerMaruyama(oscillator, np.zeros((2, 1)), 0.1, 1), 1000)
    np.testing.assert_allclose(end, 1.01**1000 * start, rtol=1e-9)


def test_semi_implicit_step_by_hand():
    """Velocities first, with their noise; the positions by the new velocities and old positions."""

    def drift(x, t, a):
        return [x[1] + a * x[0], -x[0] * x[2], x[2] * x[1] + t]

    def diffusion(x, s):
        return [[0.1, 0.0], [s * x[0], 0.0], [0.0, x[1]]]

    integrator = psf.SemiImplicitEuler(drift, diffusion, dt=0.1, velocities=[1, -1])
    system = system_of(integrator, mean=(1.0, 0.5, 2.0))
    Z = np.zeros((1, 2, BLOCK))
    Z[0, :, 0] = 0.7, -0.4
    X = np.repeat(np.array([[1.0], [0.5], [2.0]]), BLOCK, axis=1)
    found = ends(system, {"a": 0.3, "s": 0.2}, X, 1, Z)[:, 0]
    root = np.sqrt(0.1)
    v1 = 0.5 - 0.1 * 1.0 * 2.0 + root * 0.2 * 1.0 * 0.7
    v2 = 2.0 + 0.1 * (2.0 * 0.5 + 0.0) + root * 0.5 * -0.4
    p = 1.0 + 0.1 * (v1 + 0.3 * 1.0) + root * 0.1 * 0.7
    np.testing.assert_allclose(found, [p, v1, v2], rtol=1e-12)


# With noise


def errors_of_gbm(make, levels, n_paths=4096, seed=1):
    """Root mean square error at time 1 of geometric Brownian motion, per number of steps."""
    r, s, finest = 0.5, 0.8, max(levels)
    rng = np.random.default_rng(seed)
    fine = rng.normal(size=(finest, 1, n_paths))
    exact = np.exp(r - s**2 / 2 + s * fine.sum(axis=0)[0] / np.sqrt(finest))
    errors = []
    for n_steps in levels:
        ratio = finest // n_steps
        z = fine.reshape(n_steps, ratio, 1, n_paths).sum(axis=1) / np.sqrt(ratio)
        system = system_of(make(1.0 / n_steps), mean=(1.0,))
        found = ends(system, {"r": r, "s": s}, np.ones((1, n_paths)), n_steps, z)[0]
        errors.append(np.sqrt(np.mean((found - exact) ** 2)))
    return np.array(errors)


@pytest.mark.parametrize(("name", "order"), [("Milstein", 1.0), ("EulerMaruyama", 0.5)])
def test_strong_order_with_noise_that_depends_on_the_state(name, order):
    levels = [16, 32, 64, 128]

    def make(dt):
        integrator = getattr(psf, name)
        return integrator(lambda x, r: [r * x[0]], lambda x, s: [[s * x[0]]], dt=dt)

    slope, error = slope_of(1.0 / np.array(levels), errors_of_gbm(make, levels))
    assert abs(slope - order) < 0.1
    assert error < 0.05


@pytest.mark.parametrize("noise", ["diagonal", "one column", "of states without noise"])
def test_milstein_step_by_hand(noise):
    diffusion = {
        "diagonal": lambda x, s: pt.diag(s * x**2),
        "one column": lambda x, s: [[s * x[0] ** 2], [x[0] * x[1]]],
        "of states without noise": lambda x, s: [[0.0, 0.0], [s * x[0], x[0] ** 2]],
    }[noise]
    integrator = psf.Milstein(lambda x: [-x[0], x[0]], diffusion, dt=0.1, substeps=2)
    system = system_of(integrator)
    m = 1 if noise == "one column" else 2
    q = np.array([[0.7, -0.3], [0.2, 1.4]])[:, :m]
    x, s, h = np.array([1.0, 0.5]), 0.4, 0.05
    for noises in q:
        a, b = x
        if noise == "diagonal":
            along = [(np.array([s * a * a, 0]), np.array([2 * s * s * a**3, 0]))]
            along += [(np.array([0, s * b * b]), np.array([0, 2 * s * s * b**3]))]
        elif noise == "one column":
            g = np.array([s * a * a, a * b])
            along = [(g, np.array([2 * s * a * g[0], b * g[0] + a * g[1]]))]
        else:
            along = [(np.array([0, s * a]), np.zeros(2)), (np.array([0, a * a]), np.zeros(2))]
        moved = x + h * np.array([-a, a])
        for (g, correction), q_j in zip(along, noises, strict=True):
            moved = moved + np.sqrt(h) * g * q_j + h / 2 * correction * (q_j**2 - 1)
        x = moved
    Z = np.zeros((1, compile_system(system).m, BLOCK))
    Z[0, :, 0] = q.ravel()
    X = np.repeat(np.array([[1.0], [0.5]]), BLOCK, axis=1)
    np.testing.assert_allclose(ends(system, {"s": s}, X, 1, Z)[:, 0], x, rtol=1e-12)


def test_milstein_is_euler_maruyama_with_additive_noise():
    settings = dict(drift=lambda x, a: [-a * x[0], x[0]], diffusion=[[0.3, 0.1], [0.0, 0.2]])
    milstein = system_of(psf.Milstein(**settings, dt=0.1))
    assert milstein.equations == system_of(psf.EulerMaruyama(**settings, dt=0.1)).equations


def test_filters_of_moments_take_the_mean_and_covariance_of_milstein_steps():
    """Without noise a Milstein step is biased: the mean of q^2 - 1 is zero, not its value at 0."""
    settings = dict(drift=lambda x, a: [-a * x[0]], diffusion=lambda x: [[0.5 * x[0]]])
    values = [
        psf.log_likelihood(
            system_of(integrator, mean=(1.0,)), psf.EKF(), {"a": 0.3}, [[0.8]], steps=[3]
        )
        for integrator in (psf.Milstein(**settings, dt=0.2), psf.EulerMaruyama(**settings, dt=0.2))
    ]
    assert values[0] == values[1]


def test_runge_kutta_adds_noise_at_the_end_of_a_substep():
    def drift(x, a):
        return [-a * x[0]]

    integrator = psf.RungeKutta4(drift, lambda t, s: [[s * (1 + t)]], dt=0.2, substeps=2)
    Z = np.zeros((1, 2, BLOCK))
    Z[0, :, 0] = 0.7, -0.3
    found = ends(
        system_of(integrator, mean=(1.0,)), {"a": 2.0, "s": 0.5}, np.ones((1, BLOCK)), 1, Z
    )
    factor = 1 - 0.2 + 0.02 - 0.008 / 6 + 0.0016 / 24
    x = factor + np.sqrt(0.1) * 0.5 * 0.7
    x = factor * x + np.sqrt(0.1) * 0.5 * 1.1 * -0.3
    np.testing.assert_allclose(found[0, 0], x, rtol=1e-13)
    one_noise = compile_system(system_of(psf.RungeKutta4(drift, 0.3, dt=0.2), mean=(1.0,)))
    assert one_noise.has_additive_process_noise


def test_equations_without_noise_take_no_normals():
    for integrator in (
        psf.RungeKutta4(forced, dt=0.1),
        psf.SemiImplicitEuler(forced, dt=0.1, velocities=[1]),
    ):
        system = system_of(integrator, inputs=["force"])
        assert system.m == 0
        assert compile_system(system).is_deterministic


# Exact steps of linear equations


def exact_moments(a, b, offset, dt):
    def power(s):
        return expm(a * s)

    cov = quad_vec(lambda s: power(s) @ b @ b.T @ power(s).T, 0, dt, epsabs=1e-14)[0]
    return power(dt), quad_vec(lambda s: power(s) @ offset, 0, dt, epsabs=1e-14)[0], cov


def test_exact_linear_moments():
    """An oscillator, a singular matrix, a stiff one."""
    b, offset, dt = np.array([[0.0], [0.3]]), np.array([0.5, -1.0]), 0.7
    integrator = psf.ExactLinear(lambda a: a, b, dt=dt, offset=lambda o: o)
    system = system_of(integrator, shapes={"a": (2, 2), "o": (2,)})
    machine = compile_system(system)
    for a in ([[0.0, 1.0], [-4.0, -0.2]], [[0.0, 1.0], [0.0, 0.0]], [[-300.0, 1.0], [0.0, -0.5]]):
        phi, moved, cov = exact_moments(np.array(a), b, offset, dt)
        c = machine.prepare.function(np.concatenate([np.ravel(a), offset]))
        X, Z = np.zeros((2, BLOCK)), np.zeros((2, BLOCK))
        X[:, :2] = Z[:, 2:4] = np.eye(2)
        machine.propagate.function(c, np.zeros((1, 0)), 0, 0.0, Z, X)
        np.testing.assert_allclose(X[:, :2], phi + moved[:, None], rtol=1e-10, atol=1e-13)
        root = X[:, 2:4] - moved[:, None]
        np.testing.assert_allclose(root @ root.T, cov, rtol=1e-7, atol=1e-13)


def test_two_exact_steps_are_one_of_twice_the_length():
    """Sensitive to every digit of the covariance, and of its use by the EKF."""
    y = np.array([[0.3], [-0.7], [0.4]])

    def matrix(k, c):
        return [[0.0, 1.0], [-k, -c]]

    values = []
    for dt, stride in ((0.5, 1), (0.125, 4)):
        integrator = psf.ExactLinear(matrix, lambda s: [[0.0], [s]], dt=dt, offset=[0.0, 0.3])
        steps = stride * np.array([1, 3, 4])
        params = {"k": 4.0, "c": 0.2, "s": 0.8}
        values.append(psf.log_likelihood(system_of(integrator), psf.EKF(), params, y, steps=steps))
    np.testing.assert_allclose(values[1], values[0], rtol=1e-11)


def test_local_linearization_is_exact_for_linear_equations():
    """Mean and covariance of a step, for noise on one state alone and for none."""
    a, b, offset, dt = OSCILLATOR, np.array([[0.0], [0.3]]), np.array([0.0, -1.0]), 0.7

    def drift(x):
        return [x[1], -4.0 * x[0] - 0.2 * x[1] - 1.0]

    phi, moved, cov = exact_moments(a, b, offset, dt)
    for diffusion in (b, None):
        integrator = psf.LocalLinearization(drift, diffusion, dt=dt)
        X, Z = np.zeros((2, BLOCK)), np.zeros((1, 2, BLOCK))
        X[:, :2] = Z[0, :, 2:4] = np.eye(2)
        found = ends(system_of(integrator), {}, X, 1, None if diffusion is None else Z)
        np.testing.assert_allclose(found[:, :2], phi + moved[:, None], rtol=1e-9)
        root = found[:, 2:4] - moved[:, None]
        expected = 0 * cov if diffusion is None else cov
        np.testing.assert_allclose(root @ root.T, expected, rtol=1e-6, atol=1e-13)


def test_order_of_local_linearization_without_time():
    def pendulum(x):
        return [x[1], -4.0 * pt.sin(x[0])]

    exact = solve_ivp(
        lambda t, x: [x[1], -4.0 * np.sin(x[0])], (0.0, 2.0), [1.0, 0.5], rtol=1e-11, atol=1e-12
    ).y[:, -1]
    errors, numbers = [], [16, 32, 64]
    for number in numbers:
        system = system_of(psf.LocalLinearization(pendulum, None, dt=2.0 / number))
        X = np.repeat(np.array([[1.0], [0.5]]), BLOCK, axis=1)
        errors.append(np.linalg.norm(ends(system, {}, X, number)[:, 0] - exact))
    slope, error = slope_of(1.0 / np.array(numbers), errors)
    assert abs(slope - 2) < 0.1
    assert error < 0.05


def test_local_linearization_follows_a_stiff_decay():
    """The relaxation oscillator on its slow branch, with steps 7.5 times its time constant."""

    def relaxation(x, mu):
        return [x[1], mu * (1.0 - x[0] ** 2) * x[1] - x[0]]

    system = system_of(psf.LocalLinearization(relaxation, None, dt=0.05), mean=(2.0, 0.0))
    X = np.repeat(np.array([[2.0], [0.0]]), BLOCK, axis=1)
    found = ends(system, {"mu": 50.0}, X, 200)[:, 0]
    exact = solve_ivp(
        lambda t, x: relaxation(x, 50.0), (0.0, 10.0), [2.0, 0.0], "Radau", rtol=1e-9, atol=1e-9
    ).y[:, -1]
    np.testing.assert_allclose(found, exact, rtol=1e-3)


def test_constants_of_an_evaluation_are_not_part_of_a_step():
    """The step reads the matrices of an exact step; filters see a linear system."""
    integrator = psf.ExactLinear(lambda k: [[0.0, 1.0], [-k, 0.0]], np.eye(2), dt=0.5)
    system = system_of(integrator)
    machine = compile_system(system)
    assert machine.is_linear
    assert machine.has_transition_density
    assert system.n_theta == 1
    names = {type(node.op).__name__ for node in machine.model.equations.transition.apply_nodes}
    assert "LinearStep" not in names
    assert machine.n_theta == 1 + 4 + 4


def test_linear_algebra_of_a_user_is_done_once_per_evaluation():
    def transition(x, a):
        return pt.linalg.inv(pt.stack([pt.stack([a, 0.2]), pt.stack([0.1, -a])])) @ x

    system = system_of(transition)
    by_hand = np.linalg.inv([[0.7, 0.2], [0.1, -0.7]])
    found = ends(system, {"a": 0.7}, np.ones((2, BLOCK)), 1)[:, 0]
    np.testing.assert_allclose(found, by_hand @ np.ones(2), rtol=1e-12)
    assert compile_system(system).n_theta == 1 + 4
    assert compile_system(system).is_linear


# Every integrator


def pull(x, u, t, k):
    return [x[1], -k * x[0] - 0.3 * x[1] + u[0] + pt.sin(t)]


def spread(s):
    return [[0.0], [s]]


EVERY = {
    "EulerMaruyama": psf.EulerMaruyama(pull, spread, dt=0.2, substeps=2),
    "RungeKutta4": psf.RungeKutta4(pull, spread, dt=0.2),
    "SemiImplicitEuler": psf.SemiImplicitEuler(pull, spread, dt=0.2, velocities=["v"]),
    "Milstein": psf.Milstein(pull, lambda x, s: [[0.0], [s * x[0]]], dt=0.2),
    "LocalLinearization": psf.LocalLinearization(pull, spread, dt=0.2),
    "ExactLinear": psf.ExactLinear(
        lambda k: [[0.0, 1.0], [-k, -0.3]], spread, dt=0.2, offset=lambda k: [0.0, 0.1 * k]
    ),
}
FILTERS = [psf.UKF(), psf.EnKF(200), psf.GuidedPF(100)]
STEPS, Y = np.array([2, 4]), np.array([[0.6], [-0.2]])


def every(name):
    return psf.StateSpaceModel(
        transition=EVERY[name],
        observation=lambda x: [x[0]],
        observation_noise=[[0.2]],
        initial_mean=[1.0, 0.5],
        initial_cov=0.01 * np.eye(2),
        states=["p", "v"],
        inputs=[] if name == "ExactLinear" else ["force"],
    )


def evaluated(system, filter, params):
    inputs = np.array([[0.3], [-1.0], [2.0], [0.5]])
    inputs = inputs if system.n_inputs else None
    return psf.log_likelihood(system, filter, params, Y, steps=STEPS, inputs=inputs)


# Steps that only compose operations of PyTensor are among the slow tests.
COMPOSED = ("EulerMaruyama", "RungeKutta4", "SemiImplicitEuler")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n in COMPOSED)) for n in EVERY]
)
def test_the_gradient_of_the_ekf_is_that_of_finite_differences(name):
    system, steps = every(name), 1e-5 * np.eye(2)
    inputs = np.array([[0.3], [-1.0], [2.0], [0.5]])[:, : system.n_inputs]
    point, gradient = np.array([4.0, 0.6]), kernel(LogLikelihoodGradient(system, psf.EKF()))
    found = gradient(point, STEPS, Y, inputs, 0.0, 0, np.array([1.0, -2.0]))

    def value(theta):
        params = dict(zip(system.parameters, theta, strict=True))
        return evaluated(system, psf.EKF(), params) @ [1.0, -2.0]

    numerical = [(value(point + h) - value(point - h)) / 2e-5 for h in steps]
    np.testing.assert_allclose(found, numerical, rtol=1e-6)


def test_each_kind_of_filter_takes_an_exact_step():
    """The steps read constants of the evaluation, in the machine code of each filter."""
    system, params = every("ExactLinear"), {"k": 4.0, "s": 0.6}
    exact = evaluated(system, psf.EKF(), params).sum()
    found = {type(f).__name__: evaluated(system, f, params).sum() for f in FILTERS}
    for name in ("UKF", "GuidedPF"):
        assert found.pop(name) == pytest.approx(exact, abs=1e-9)
    # Errors of 200 members: some tenths of a nat at most over 100 seeds.
    assert all(abs(value - exact) < 1.0 for value in found.values())


@pytest.mark.parametrize("name", EVERY)
def test_systems_are_equal_and_pickle(name):
    system = every(name)
    again = pickle.loads(pickle.dumps(system))
    assert again == system == every(name)
    assert hash(again) == hash(system)
    assert isinstance(system.integrator, psf.system.Integrator)
    refined = system.with_integrator(system.integrator.refined())
    assert (refined == system) == (name == "ExactLinear")


# Where steps are stable


def eigenvalues_at(integrator, value, n=1):
    system = system_of(integrator, mean=(1.0,) * n)
    theta, steps = np.array(value, dtype=float)[:, None], np.ones((len(value), 1), dtype=int)
    nothing = np.zeros((len(value), 0, 0))
    [found] = path_eigenvalues([system], theta, steps, nothing, np.zeros(len(value)))
    return system.integrator, found


def test_runge_kutta_tells_slow_decays_from_fast_ones():
    """z = -0.1 and z = -2.7 give almost the same step, 0.905 and 0.88."""
    integrator, found = eigenvalues_at(
        psf.RungeKutta4(lambda x, a: [a * x[0]], dt=0.2, substeps=2),
        [-1.0, -15.0, -17.0, -27.0, -40.0],
    )
    np.testing.assert_allclose(found[:, 0, 0], 1 + np.array([-0.1, -1.5, -1.7, -2.7, -4.0]))
    assert list(integrator.is_stable_at(found).all(axis=1)) == [True, True, False, False, False]


@pytest.mark.parametrize(
    ("name", "stable_up_to"), [("RungeKutta4", 1.6), ("SemiImplicitEuler", np.sqrt(2))]
)
def test_an_oscillator_is_stable_while_its_period_is_resolved(name, stable_up_to):
    w = stable_up_to * np.array([0.1, 0.5, 0.99, 1.01, 2.0]) / 0.1
    settings = {"velocities": [1]} if name == "SemiImplicitEuler" else {}
    make = getattr(psf, name)(lambda x, w: [x[1], -(w**2) * x[0]], dt=0.1, **settings)
    integrator, found = eigenvalues_at(make, w, n=2)
    assert list(integrator.is_stable_at(found).all(axis=1)) == [True, True, True, False, False]


def test_an_exact_step_is_stable_at_any_length():
    integrator, found = eigenvalues_at(
        psf.ExactLinear(lambda a: [[a]], [[0.1]], dt=10.0), [-0.1, -50.0]
    )
    np.testing.assert_allclose(found[:, 0, 0], np.exp([-1.0, -500.0]), rtol=1e-12)
    assert integrator.is_stable_at(found).all()
    assert integrator.refined() is integrator.substep() is integrator


# Bad input

BAD = {
    "noise of the state": (
        lambda: system_of(psf.RungeKutta4(lambda x: -x, lambda x: [[0.0], [x[0]]], dt=0.1)),
        "diffusion must not depend on the state x in RungeKutta4.*Milstein or EulerMaruyama",
    ),
    "noise of the state in a tangent": (
        lambda: system_of(psf.LocalLinearization(lambda x: -x, lambda x: [[0.0], [x[0]]], dt=0.1)),
        "diffusion must not depend on the state x in LocalLinearization",
    ),
    "no diffusion": (
        lambda: psf.Milstein(pull, dt=0.1),
        "diffusion must be .* in Milstein, got None; RungeKutta4, .* treat equations without",
    ),
    "no diffusion of Euler": (
        lambda: psf.EulerMaruyama(pull, dt=0.1),
        "diffusion must be .* in EulerMaruyama, got None",
    ),
    "Levy areas": (
        lambda: system_of(psf.Milstein(lambda x: -x, lambda x: [[x[1], 0.0], [0.0, x[0]]], dt=0.1)),
        "diffusion must be diagonal .*noise 0 that depends on state 1, on which noise 1 acts.*Levy "
        "areas. Use EulerMaruyama",
    ),
    "no such name": (
        lambda: system_of(psf.SemiImplicitEuler(pull, dt=0.1, velocities="w"), states=["p", "v"]),
        r"velocities must be names of states, \['p', 'v'\].*got 'w'",
    ),
    "a name without names": (
        lambda: system_of(psf.SemiImplicitEuler(pull, dt=0.1, velocities="v")),
        r"velocities must be indices .*got 'v'; give the system states=",
    ),
    "no such index": (
        lambda: system_of(psf.SemiImplicitEuler(pull, dt=0.1, velocities=[2]), inputs=["f"]),
        "velocities must be indices of the 2 states, 0 to 1, got 2",
    ),
    "velocities only": (
        lambda: system_of(psf.SemiImplicitEuler(pull, dt=0.1, velocities=[0, 1]), inputs=["f"]),
        "velocities must leave a state .*EulerMaruyama",
    ),
    "a velocity twice": (
        lambda: system_of(psf.SemiImplicitEuler(pull, dt=0.1, velocities=[1, -1]), inputs=["f"]),
        "velocities must name every state once",
    ),
    "no velocities": (
        lambda: psf.SemiImplicitEuler(pull, dt=0.1, velocities=()),
        r"velocities must be indices or names .*got \(\)",
    ),
    "substeps": (
        lambda: psf.RungeKutta4(pull, dt=0.1, substeps=0),
        "substeps must be an integer of at least 1, got 0",
    ),
    "A not square": (
        lambda: system_of(psf.ExactLinear([[1.0, 2.0]], np.eye(2), dt=0.1)),
        r"A must have shape \(2, 2\), got \(1, 2\); initial_mean has 2 states",
    ),
    "A not finite": (
        lambda: psf.ExactLinear([[np.nan]], [[1.0]], dt=0.1),
        "A must be finite",
    ),
    "A of the state": (
        lambda: psf.ExactLinear(lambda x: [[x[0]]], [[1.0]], dt=0.1),
        "A: the argument name 'x' is reserved",
    ),
    "no B": (lambda: psf.ExactLinear([[1.0]], dt=0.1), "B must be a matrix .*got None; B of zeros"),
    "offset too long": (
        lambda: system_of(psf.ExactLinear(np.eye(2), np.eye(2), dt=0.1, offset=[1.0] * 3)),
        r"offset must have shape \(2,\), got \(3,\)",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(case):
    make, message = BAD[case]
    with pytest.raises(psf.errors.ModelError, match=message):
        make()
