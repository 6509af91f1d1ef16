"""Eigenvalues of the step's Jacobian along a system's path, against what they are by hand."""

import re
from pathlib import Path

import numpy as np
import pymc as pm
import pytensor
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.pymc_model.step_refinement import (
    densities_by_halvings,
    path_eigenvalues,
    step_accuracy,
    step_stability,
)
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.record import read_record
from tests.modes import AS_IT_STANDS

pytestmark = pytest.mark.usefixtures("interpreted")

OBSERVED = {"observation": lambda x: [x[0]], "observation_noise": [[0.1]]}


def euler(drift, n=1, substeps=1, mean=1.0, **kwargs):
    return psf.StateSpaceModel(
        transition=psf.EulerMaruyama(drift, 0.3 * np.eye(n), dt=0.1, substeps=substeps),
        initial_mean=[mean] * n,
        initial_cov=np.eye(n),
        **OBSERVED,
        **kwargs,
    )


def multiplier(system, theta, n_steps=100, inputs=None, t0=0.0):
    """Smallest real part of an eigenvalue, which decides on Euler-Maruyama steps."""
    return eigenvalues(system, theta, n_steps, inputs, t0).real.min(axis=(1, 2))


def eigenvalues(system, theta, n_steps=100, inputs=None, t0=0.0):
    m = len(theta)
    inputs = np.zeros((0, system.n_inputs)) if inputs is None else inputs
    [found] = path_eigenvalues(
        [system],
        np.asarray(theta),
        np.tile(np.arange(n_steps + 1), (m, 1)),
        np.tile(inputs, (m, 1, 1)),
        np.full(m, t0),
    )
    return found


@pytest.mark.parametrize("substeps", [1, 2, 5])
def test_a_linear_state(substeps):
    """Of one substep: that of two is positive again where each overshoots."""
    a = np.array([[-1.0], [-9.0], [-15.0], [2.0]])
    found = multiplier(euler(lambda x, a: [a * x[0]], substeps=substeps), a, n_steps=10)
    np.testing.assert_allclose(found, 1 + a[:, 0] * 0.1 / substeps, rtol=1e-12)


def test_the_path_finds_the_well():
    """From 0.5 it falls into the well at 1, where the slope is -2 alpha."""
    found = multiplier(euler(lambda x, a: [a * (x[0] - x[0] ** 3)], mean=0.5), [[3.0], [6.0]])
    np.testing.assert_allclose(found, [1 - 0.6, 1 - 1.2], atol=1e-4)


def test_a_path_that_diverges_is_not_stable():
    system = euler(lambda x, a: [a * x[0] ** 3], mean=5.0)
    found = eigenvalues(system, [[-1.0], [-0.01]])
    assert np.isnan(found[0]).any()
    assert np.isfinite(found[1]).all()
    assert list(system.integrator.is_stable_at(found).all(axis=1)) == [False, True]


def test_an_oscillator_does_not_overshoot():
    """Complex multipliers 1 - c h / 2 +- i w h: it is their real part that counts."""
    found = multiplier(euler(lambda x, c: [x[1], -25 * x[0] - c * x[1]], n=2), [[0.4]])
    np.testing.assert_allclose(found, 1 - 0.4 * 0.1 / 2, rtol=1e-9)


def test_inputs_and_time_move_the_path():
    """A slope of -(u + t) x at steps of 0.1: the last of u and of t count."""
    system = euler(lambda x, u, t, b: [-(u[0] + t) * b * x[0]], substeps=2, inputs=["u"])
    found = multiplier(system, [[1.0]], 10, np.arange(10.0)[:, None], t0=3.0)
    np.testing.assert_allclose(found, 1 - (9 + 4.0) * 0.05, rtol=1e-9)


def test_an_euler_step_is_stable_while_no_eigenvalue_is_negative():
    step = psf.EulerMaruyama(lambda x, a: [a * x[0]], [[0.3]], dt=0.1)
    eigenvalues = np.array([[0.5, -0.1], [0.5, 0.0], [0.5, 0.1 + 2j], [0.5, np.nan]])
    assert list(step.is_stable_at(eigenvalues)) == [False, True, True, False]


@pytest.fixture(scope="module")
def runge_kutta():
    """The integrator of the guide, which inherits nothing."""
    page = Path(__file__).parents[2] / "docs/howto/integrator.md"
    cell = re.search(r"```\{code-cell\} python3\n(.*?)```", page.read_text(), re.DOTALL).group(1)
    modules = re.findall(r"^(?:from|import) (pymc_statespace_filters[\w.]*)", cell, re.MULTILINE)
    assert modules == ["pymc_statespace_filters", "pymc_statespace_filters.system"]
    namespace = {"__name__": "runge_kutta"}
    exec(cell, namespace)
    return namespace["RungeKutta4"]


def linear_by(integrator):
    return psf.StateSpaceModel(
        transition=integrator, initial_mean=[1.0], initial_cov=[[0.5]], **OBSERVED
    )


def test_an_integrator_of_a_user_says_where_it_is_stable(runge_kutta):
    """The rule multiplies by 1 + z + z^2 / 2 + z^3 / 6 + z^4 / 24, above one for z < -2.785."""
    system = linear_by(runge_kutta(lambda x, a: [a * x[0]], ((0.3,),), 0.2, substeps=2))
    z = np.array([-0.1, -1.0, -2.7, -2.9, -4.0])
    found = eigenvalues(system, z[:, None] / 0.1, n_steps=10)
    by_hand = 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24
    np.testing.assert_allclose(found, np.broadcast_to(by_hand[:, None, None], found.shape))
    stable = system.integrator.is_stable_at(found).all(axis=1)
    assert list(stable) == [True, True, True, False, False]


def test_a_model_with_an_integrator_of_a_user_is_refined(runge_kutta):
    system = linear_by(runge_kutta(lambda x, a: [a * x[0]], ((0.3,),), 0.1))
    with pm.Model() as model:
        a = pm.Normal("a")
        psf.StateSpace("d", system, psf.EKF(), steps=[10, 20], observed=[0.4, 0.2])
    assert list(step_stability(model)(np.array([[-1.0], [-29.0]]))) == [True, False]
    coarse, fine = pytensor.function(
        [model.rvs_to_values[a]], densities_by_halvings(model, 1), mode=AS_IT_STANDS
    )(-1.0)
    assert 0 < abs(coarse - fine) < 0.05


def test_exact_steps_are_not_examined():
    """They are as they are at any length; beside others the others alone count."""
    exact = linear_by(psf.ExactLinear(lambda a: [[a]], [[0.3]], dt=0.1))
    rough = linear_by(psf.EulerMaruyama(lambda x, a: [a * x[0]], [[0.3]], dt=0.1))

    def examined(*systems):
        with pm.Model() as model:
            pm.Normal("a")
            for i, system in enumerate(systems):
                given = {"steps": [10, 20], "observed": [0.4, 0.2]}
                psf.StateSpace(f"d{i}", system, psf.EKF(), **given)
        return [function(model) for function in (step_stability, step_accuracy)]

    assert examined(exact) == [None, None]
    points = np.array([[-1.0], [-29.0]])
    for both, alone in zip(examined(exact, rough), examined(rough), strict=True):
        np.testing.assert_array_equal(both(points), alone(points))


def test_an_incomplete_integrator_is_refused():
    class Step:
        dt, equations = 0.1, ()

        def step(self, values):
            return values["x"]

    with pytest.raises(
        psf.errors.ModelError, match="without noise_size, substep, refined, is_stable_at"
    ):
        linear_by(Step())


def test_a_panel_is_stable_where_each_record_is():
    """Every record with its own parameter and its own stretch of inputs."""
    system = euler(lambda x, u, a: [-a * x[0] ** 3 + u[0]], mean=0.5, inputs=["u"])
    steps, observed = np.array([0, 4, 2, 5, 9]), np.zeros(5)
    rows, forces = [[0, 1], [2, 3, 4]], [np.full((4, 1), 9.0), np.zeros((9, 1))]
    points = np.array([[1.0, 1.0], [5.0, 1.0], [1.0, 5.0], [1.0, 90.0]])

    def stable(x, **data):
        with pm.Model() as model:
            pm.Normal("a", shape=x.shape[1] if "panel" in data else ())
            psf.StateSpace("d", system, psf.EKF(), **data)
        return step_stability(model)(x)

    found = stable(points, panel=[-1, -1, 7, 7, 7], steps=steps, observed=observed, inputs=forces)
    alone = [
        stable(points[:, [g]], steps=steps[own], observed=observed[own], inputs=forces[g])
        for g, own in enumerate(rows)
    ]
    assert [one.all() for one in alone] == [False, False]
    np.testing.assert_array_equal(found, np.all(alone, axis=0))


TIMES = np.array([0.03, 0.21, 0.3, 0.47])


@pytest.mark.parametrize("substeps", [1, 2])
def test_steps_of_a_record_at_any_times_have_their_own_lengths(substeps):
    record = read_record(
        euler(lambda x, t, a: [a * t * x[0]], substeps=substeps),
        GivenRecord(np.zeros(4), times=TIMES),
    )
    found = eigenvalues(record.system, [[-2.0]], int(record.axes[0].steps[-1]), record.inputs)
    starts, lengths = (part[:-1] for part in record.axes[0].rows())
    last = starts + lengths * (substeps - 1) / substeps  # where the last substep begins
    slopes = 1 - 2.0 * last * lengths / substeps
    assert found.real.min() == pytest.approx(slopes.min(), rel=1e-12)


@pytest.mark.parametrize("filter", [psf.EKF(), psf.GridFilter()])
def test_halved_steps_of_a_record_at_any_times(filter):
    def model(substeps, filter=filter):
        system = euler(lambda x, a: [-a * x[0]], substeps=substeps)
        with pm.Model() as built:
            pm.Normal("a")
            psf.StateSpace("d", system, filter, times=TIMES, observed=[0.9, 0.8, np.nan, 1.1])
        return built

    coarse = model(1)
    found = [
        pytensor.function(coarse.value_vars, one, mode=AS_IT_STANDS)(1.3)
        for one in densities_by_halvings(coarse, 1)
    ]
    at = {"a": 1.3}
    assert found[0] == pytest.approx(coarse.compile_logp()(at), abs=1e-12)
    # The exact filters of a linear system; a GridFilter takes shorter steps instead of substeps.
    exact = model(2, psf.EKF()).compile_logp()(at)
    assert found[1] == pytest.approx(exact, abs=1e-12 if filter == psf.EKF() else 1e-8)
    assert abs(found[1] - found[0]) > 1e-4
