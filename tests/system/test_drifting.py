"""Drifting parameters: against exact Kalman recursions, and against the system without drift."""

import pickle

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy.stats import norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.errors import FilterWarning, ModelError
from pymc_statespace_filters.pymc_model.density import RowFunction
from pymc_statespace_filters.pymc_model.step_refinement import (
    densities_by_halvings,
    path_eigenvalues,
)
from pymc_statespace_filters.system.given_record import GivenRecord
from pymc_statespace_filters.system.input_columns import divided
from pymc_statespace_filters.system.integrators.substeps import CoupledNoise
from pymc_statespace_filters.system.own_units import (
    law_in_own_units,
    moments_in_own_units,
    moments_of_members,
)
from pymc_statespace_filters.system.record import read_record
from tests.systems import DOUBLE_WELL_SYSTEM, PAIR, PAIR_DATA, STEPS, log_likelihoods

pytestmark = pytest.mark.usefixtures("interpreted")

DT = 0.1
GRID = np.array([0, 3, 7, 8, 20])
TIMES = np.array([0.05, 0.33, 0.7, 1.0, 1.234])
DATA = np.array([0.2, -0.4, np.nan, 0.5, 0.1])
PUSH = np.random.default_rng(1).normal(size=20)
PARAMS = {"a": 1.2, "gain": 0.7}


def pushed(**changes):
    """A decay, pushed by an input with a gain."""
    settings = {
        "transition": psf.EulerMaruyama(
            lambda x, u, a, gain: [-a * x[0] + gain * u[0]], [[0.5]], dt=DT, substeps=2
        ),
        "observation": lambda x: [x[0]],
        "observation_noise": [[0.04]],
        "initial_mean": [0.3],
        "initial_cov": [[0.5]],
        "inputs": ["push"],
    }
    return psf.StateSpaceModel(**settings | changes)


def kalman(lengths, starts, seen, push, strength, rate=0.0, every=None):
    """Exact terms of `pushed` with a gain that drifts; rows ``seen`` of the steps have data."""
    a, gain = PARAMS["a"], PARAMS["gain"]
    mean, cov, terms = np.array([0.3, gain]), np.diag([0.5, 0.0]), []
    for k, (length, begin) in enumerate(zip([*lengths, 0.0], [*starts, 0.0], strict=True)):
        if k in seen:
            terms.append(0.0)
            if not np.isnan(d := DATA[len(terms) - 1]):
                spread, rest = cov[0, 0] + 0.04, d - mean[0]
                terms[-1] = -0.5 * (np.log(2 * np.pi * spread) + rest**2 / spread)
                mean, cov = (
                    mean + cov[:, 0] / spread * rest,
                    cov - np.outer(cov[:, 0], cov[0]) / spread,
                )
        h = length / 2
        for _ in range(2):
            step = np.array([[1 - a * h, h * push[min(k, len(push) - 1)]], [0.0, 1.0]])
            mean, cov = step @ mean, step @ cov @ step.T + np.diag([0.25 * h, 0.0])
        span = length
        if every is not None:
            held = every * DT
            moves = np.floor((begin + length) / held + 1e-6) > np.floor(begin / held + 1e-6)
            span = held if moves else 0.0
        back = np.exp(-rate * span)
        added = strength**2 * (span if rate == 0 else (1 - back**2) / (2 * rate))
        mean = np.array([mean[0], gain + back * (mean[1] - gain)])
        back = np.diag([1.0, back])
        cov = back @ cov @ back + np.diag([0.0, added])
    return terms


PROCESSES = {
    "walk": (psf.RandomWalk(), {"gain_strength": 0.8}),
    "held walk": (psf.RandomWalk(every=3), {"gain_strength": 0.8}),
    "return": (psf.OrnsteinUhlenbeck(), {"gain_strength": 0.8, "gain_rate": 0.9}),
    "held return": (psf.OrnsteinUhlenbeck(every=3), {"gain_strength": 0.8, "gain_rate": 0.9}),
}


@pytest.mark.parametrize("at", ["grid", "any times"])
@pytest.mark.parametrize("case", PROCESSES)
def test_a_drifting_gain_of_a_linear_system_has_the_exact_likelihood(case, at):
    process, params = PROCESSES[case]
    system = psf.drifting(pushed(), gain=process)
    record = {"steps": GRID} if at == "grid" else {"times": TIMES}
    record |= (
        {"inputs": PUSH, "input_times": np.arange(20) * DT} if at != "grid" else {"inputs": PUSH}
    )
    found = psf.log_likelihood(system, psf.EKF(), PARAMS | params, DATA, **record)
    checked = read_record(system, GivenRecord(DATA, **record))
    starts, lengths = checked.axes[0].rows()
    rows = checked.arguments[2]
    expected = kalman(
        lengths[:-1], starts[:-1], list(checked.axes[0].steps), rows[:, 0],
        params["gain_strength"], params.get("gain_rate", 0.0),
        process.every if process.every > 1 else None,
    )  # fmt: skip
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


FILTERS = [psf.EKF(), psf.UKF(), psf.IPLF(), psf.EnKF(50), psf.GuidedPF(50), psf.BootstrapPF(50)]


@pytest.mark.parametrize("filter", FILTERS, ids=lambda one: type(one).__name__)
def test_without_strength_the_system_is_the_one_without_drift(filter):
    system = psf.drifting(DOUBLE_WELL_SYSTEM, alpha=psf.RandomWalk(scale="log"))
    params = {
        "alpha": 1.0, "beta": -0.6, "sigma": 0.6, "noise_var": 0.08, "initial_mean": 1.0,
        "initial_var": 0.5,
    }  # fmt: skip
    record = {"observed": DATA, "steps": [2, 10, 20, 40, 41]}
    constant = psf.log_likelihood(DOUBLE_WELL_SYSTEM, filter, params, **record)
    still = psf.log_likelihood(system, filter, params | {"alpha_strength": 0.0}, **record)
    if isinstance(filter, psf.BootstrapPF | psf.EnKF):
        assert (still == constant).all()
    np.testing.assert_allclose(still, constant, rtol=0, atol=1e-12)
    moved = psf.log_likelihood(system, filter, params | {"alpha_strength": 3.0}, **record)
    assert abs(moved - constant).max() > 1e-3


def double_well_density(observed, steps, params, dt):
    """Log-likelihood of the double well whose alpha walks on the log scale, by trapezoids."""
    x, z = np.arange(-2.6, 2.6, 0.02), np.log(params["alpha"]) + np.arange(-1.4, 1.4, 0.02)
    sd_x, sd_z = params["sigma"] * np.sqrt(dt), params["alpha_strength"] * np.sqrt(dt)

    def moved(slope):
        return norm.pdf(x[:, None], x + dt * (slope * x + params["beta"] * x**3), sd_x) * 0.02

    to_x = np.stack([moved(slope) for slope in np.exp(z)])
    to_z = norm.pdf(z[:, None], z, sd_z) * 0.02
    density = norm.pdf(x, params["initial_mean"], np.sqrt(params["initial_var"]))
    density = np.outer(norm.pdf(z, z[70], sd_z), moved(params["alpha"]) @ density)
    assert steps[0] > 0
    total = 0.0
    for k in range(1, steps[-1] + 1):
        if k > 1:
            density = to_z @ np.einsum("zyx,zx->zy", to_x, density)
        if k in steps:
            seen = observed[list(steps).index(k)]
            density = density * norm.pdf(seen, x, np.sqrt(params["noise_var"]))
            mass = density.sum() * 0.02**2
            total, density = total + np.log(mass), density / mass
    return total


def test_a_drifting_slope_of_a_double_well_has_the_likelihood_of_a_quadrature():
    system = psf.drifting(DOUBLE_WELL_SYSTEM, alpha=psf.RandomWalk(scale="log"))
    params = {
        "alpha": 1.5, "alpha_strength": 0.6, "beta": -1.0, "sigma": 0.6, "noise_var": 0.01,
        "initial_mean": 0.8, "initial_var": 0.04,
    }  # fmt: skip
    steps, observed = np.array([10, 30, 50, 70]), np.array([1.1, 1.5, 1.6, 1.2])
    exact = double_well_density(observed, steps, params, system.dt)
    for filter in (psf.BootstrapPF(4000), psf.GuidedPF(1000)):
        logs = log_likelihoods(system, filter, params, range(40), observed=observed, steps=steps)
        ratios = np.exp(logs - exact)
        error = ratios.std(ddof=1) / np.sqrt(len(ratios))
        assert error < 0.03
        assert abs(ratios.mean() - 1) < 4 * error  # of right filters 1 in 10^4


def test_elements_and_arrays_of_parameters_drift():
    def coupled(x, q, b):
        return [b[0] * x[0] + b[1] * x[1] + q[0], b[2] * x[1] + q[1]]

    system = psf.StateSpaceModel(
        transition=coupled,
        process_noise=[[1.0, 0.0], [0.0, 0.5]],
        observation=lambda x: [x[0], x[1]],
        observation_noise=[[0.5, 0.1], [0.1, 0.4]],
        initial_mean=[0.0, 0.3],
        initial_cov=[[1.0, 0.0], [0.0, 2.0]],
        shapes={"b": (3,)},
    )
    b = [0.7, 0.2, 0.8]
    whole = psf.drifting(system, b=psf.RandomWalk())
    assert whole.states == ("x0", "x1", "b[0]", "b[1]", "b[2]")
    assert dict(zip(whole.parameters, whole.parameter_shapes, strict=True)) == {
        "b": (3,), "b_strength": (3,)
    }  # fmt: skip
    element = psf.drifting(system, **{"b[1]": psf.RandomWalk()})
    assert element.parameters == ("b", "b[1]_strength")
    scalar = psf.drifting(PAIR, b=psf.RandomWalk())
    expected = psf.log_likelihood(
        scalar, psf.EKF(), {"a": 0.7, "b": 0.2, "b_strength": 0.4}, PAIR_DATA, steps=STEPS
    )
    for one, params in (
        (whole, {"b": b, "b_strength": [0.0, 0.4, 0.0]}),
        (element, {"b": b, "b[1]_strength": 0.4}),
    ):
        found = psf.log_likelihood(one, psf.EKF(), params, PAIR_DATA, steps=STEPS)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_parameters_drift_independently():
    system = psf.drifting(pushed(), a=psf.RandomWalk(), gain=psf.RandomWalk())
    params = PARAMS | {"a_strength": 0.3, "gain_strength": 0.5}
    nothing = np.full(5, np.nan)
    run = psf.run_filter(system, psf.EKF(), params, nothing, steps=GRID, inputs=PUSH)
    found = run["cov"].values[-1][1:, 1:]
    np.testing.assert_allclose(found, GRID[-1] * DT * np.diag([0.09, 0.25]), atol=1e-12)


def test_several_calls_are_one():
    walk = psf.RandomWalk()
    twice = psf.drifting(psf.drifting(pushed(), a=walk), gain=walk)
    once = psf.drifting(pushed(), a=walk, gain=walk)
    assert twice.states == once.states == ("x0", "a", "gain")
    assert twice.parameters == ("a", "gain", "a_strength", "gain_strength")
    assert pickle.loads(pickle.dumps(once)).drifting == once.drifting
    assert once.with_drifting(()).parameters == ("a", "gain")


@pytest.mark.parametrize("names", [("c",), ("b",)], ids=["matrix", "offset"])
def test_exact_linear_steps_follow_a_parameter_that_drifts(names):
    exact = psf.StateSpaceModel(
        transition=psf.ExactLinear(lambda c: [[-c]], 0.4, dt=DT, offset=lambda b: [b]),
        observation=lambda x: [x[0]],
        observation_noise=[[0.04]],
        initial_mean=[0.3],
        initial_cov=[[0.5]],
    )
    system = psf.drifting(exact, **dict.fromkeys(names, psf.RandomWalk()))
    params = {"c": 1.1, "b": 0.4}
    constant = psf.log_likelihood(exact, psf.EKF(), params, DATA, steps=GRID)
    params |= {f"{name}_strength": 0.0 for name in names}
    still = psf.log_likelihood(system, psf.EKF(), params, DATA, steps=GRID)
    np.testing.assert_allclose(still, constant, rtol=0, atol=1e-12)


def test_integrators_of_shorter_steps_keep_the_drift():
    system = psf.drifting(pushed(), gain=psf.RandomWalk(every=2))
    finer = system.with_integrator(system.integrator.refined())
    coarse = system.with_integrator(CoupledNoise(system.integrator, 2), keeps_noises=True)
    assert finer.drifting == coarse.drifting == system.drifting
    assert (system.m, finer.m, coarse.m) == (3, 5, 5)
    theta = np.array([[1.2, 0.7, 0.5]])
    rows = np.column_stack([PUSH, np.arange(20) % 2])[None]
    [eigenvalues] = path_eigenvalues([system], theta, np.array([[20]]), rows, np.zeros(1))
    np.testing.assert_allclose(sorted(eigenvalues[0, 0].real), [1 - 1.2 * DT / 2, 1.0])


def test_lengths_of_a_step_are_compared_with_one_path_of_the_noise():
    """By plain particles, the estimates differ by the step and not by the noise."""
    system = psf.drifting(pushed(), gain=psf.RandomWalk())
    with pm.Model() as model:
        pm.HalfNormal("a")
        params = {"gain": 0.7, "gain_strength": 0.3}
        filter = psf.BootstrapPF(200)
        psf.StateSpace(
            "d", system, filter, steps=GRID, observed=DATA, inputs=PUSH, params=params
        )  # fmt: skip
        densities = densities_by_halvings(model, 1)
        coarse, fine = (RowFunction(model, density) for density in densities)
    seeds = np.arange(20)[:, None]
    found = [one.evaluate(np.zeros((20, 1)), seeds) for one in (coarse, fine)]
    assert np.std(found[1] - found[0]) < 0.2 * np.std(found[0])


def test_the_column_of_a_held_parameter_moves_once_in_a_divided_step():
    system = psf.drifting(pushed(), gain=psf.RandomWalk(every=2))
    rows = read_record(system, GivenRecord(DATA, steps=GRID, inputs=PUSH)).arguments[2]
    np.testing.assert_array_equal(rows[:, 1], np.arange(20) % 2)
    finer = divided(system, rows, 3)
    np.testing.assert_array_equal(np.flatnonzero(finer[:, 1]), np.arange(5, 60, 6))


def test_draws_of_other_distributions_accumulators_and_times_go_together():
    system = psf.StateSpaceModel(
        transition=lambda x, q: [x[0], x[1] + q[0]],
        process_dist=lambda x, rate: [pm.Poisson.dist(rate * x[0])],
        observation=lambda x: [x[1]],
        observation_noise=[[400.0]],
        initial_mean=[20.0, 0.0],
        initial_cov=np.zeros((2, 2)),
        states=["size", "cases"],
        accumulators=["cases"],
    )
    moving = psf.drifting(system, rate=psf.RandomWalk(scale="log", every=7))
    params = {"rate": 0.4, "rate_strength": 0.2}
    record = psf.simulate(moving, params, steps=[7, 14, 21], random_seed=3)
    rate = record["states"].sel(state="rate").values
    assert np.flatnonzero(np.diff(rate)).tolist() == [6, 13, 20]
    assert (record["states"].sel(state="cases").values[[0, 8, 15]] < 30).all()
    still = {"rate": 0.4, "rate_strength": 0.0}
    data = record["observations"].values
    of_moving = psf.log_likelihood(moving, psf.BootstrapPF(512), still, data, steps=[7, 14, 21])
    of_constant = psf.log_likelihood(
        system, psf.BootstrapPF(512), {"rate": 0.4}, data, steps=[7, 14, 21]
    )
    assert (of_moving == of_constant).all()


def test_records_of_a_panel_have_paths_of_their_own():
    system = psf.drifting(pushed(), gain=psf.RandomWalk(every=3))
    strengths = np.array([0.5, 0.9])
    labels = ["A"] * 5 + ["B"] * 5
    params = PARAMS | {"gain_strength": strengths}
    record = {"panel": labels, "steps": np.tile(GRID, 2), "inputs": PUSH}
    found = psf.log_likelihood(system, psf.EKF(), params, np.tile(DATA, 2), **record)
    alone = [
        psf.log_likelihood(
            system, psf.EKF(), PARAMS | {"gain_strength": s}, DATA, steps=GRID, inputs=PUSH
        )
        for s in strengths
    ]
    np.testing.assert_allclose(found, np.concatenate(alone), rtol=0, atol=1e-12)


def test_a_run_goes_on_with_a_held_parameter():
    system = psf.drifting(pushed(), gain=psf.RandomWalk(scale="log", every=3))
    params = PARAMS | {"gain_strength": 0.5}
    whole = psf.run_filter(system, psf.EKF(), params, DATA, steps=GRID, inputs=PUSH)
    first = psf.run_filter(system, psf.EKF(), params, DATA[:2], steps=GRID[:2], inputs=PUSH)
    rest = psf.run_filter(
        system, psf.EKF(), params, DATA[2:], steps=GRID[2:], inputs=PUSH, state=first
    )
    np.testing.assert_array_equal(rest["mean"].values, whole["mean"].values[2:])
    assert (whole["mean"].sel(state="gain") > 0).all()


def test_laws_in_own_units_are_those_of_draws():
    system = psf.drifting(
        pushed(), a=psf.RandomWalk(scale="log"), gain=psf.RandomWalk(scale=("logit", -1, 3))
    )
    mean, root = (
        np.array([0.3, -0.2, 0.5]),
        np.array([[1.2, 0, 0], [0.3, 0.4, 0], [-0.5, 0.2, 0.6]]),
    )
    cov = root @ root.T
    (found_mean,), (found,) = law_in_own_units(system, mean[None], cov[None])
    sd, one = np.sqrt(np.diagonal(cov)), np.exp(mean[1] + cov[1, 1] / 2)
    np.testing.assert_allclose(found_mean[1], one, rtol=1e-12)
    np.testing.assert_allclose(found[0, 1], cov[0, 1] * one, rtol=1e-10)  # Stein's lemma
    np.testing.assert_allclose(found[1, 1], one**2 * np.expm1(sd[1] ** 2), rtol=1e-10)
    for i, alone in enumerate(moments_in_own_units(system, mean, sd)):
        np.testing.assert_allclose(alone, [found_mean, np.sqrt(np.diagonal(found))][i], rtol=1e-9)
    draws = mean + np.random.default_rng(0).normal(size=(400_000, 3)) @ root.T
    draws[:, 1], draws[:, 2] = np.exp(draws[:, 1]), -1 + 4 / (1 + np.exp(-draws[:, 2]))
    weights = np.full((1, len(draws)), 1 / len(draws))
    (drawn_mean,), (drawn,) = moments_of_members(draws[None], weights)
    np.testing.assert_allclose(found_mean, drawn_mean, atol=0.01)  # four standard errors or more
    np.testing.assert_allclose(found, drawn, atol=0.015)


def test_moments_of_few_members_are_unbiased():
    members, w = np.array([[0.0, 1.0], [2.0, 0.0], [3.0, 5.0]]), np.array([0.5, 0.3, 0.2])
    (mean,), (cov,) = moments_of_members(members[None], w[None])
    np.testing.assert_allclose(mean, w @ members)
    expected = np.cov(members.T, aweights=w, bias=True) / (1 - (w**2).sum())
    np.testing.assert_allclose(cov, expected)


def test_a_start_between_bounds_is_where_it_was():
    system = psf.drifting(pushed(), gain=psf.RandomWalk(scale=("logit", -1, 3)))
    still = PARAMS | {"gain_strength": 0.0}
    record = {"observed": DATA, "steps": GRID, "inputs": PUSH}
    found = psf.log_likelihood(system, psf.EKF(), still, **record)
    constant = psf.log_likelihood(pushed(), psf.EKF(), PARAMS, **record)
    np.testing.assert_allclose(found, constant, rtol=0, atol=1e-12)


def test_a_start_outside_the_scale_is_named():
    system = psf.drifting(pushed(), gain=psf.RandomWalk(scale="log"))
    params = {"a": 1.0, "gain": -0.3, "gain_strength": 0.1}
    with pytest.warns(FilterWarning, match="gain starts at -0.3, outside its scale 'log'"):
        psf.log_likelihood(system, psf.EKF(), params, DATA, steps=GRID, inputs=PUSH)
    with pm.Model(), pytest.raises(ModelError, match=r"'gain' must start on.*'log'.*-0.3"):
        psf.StateSpace(
            "d", system, psf.EKF(), steps=GRID, observed=DATA, inputs=PUSH, params=params
        )


def test_a_model_of_pymc_has_the_columns_of_held_parameters():
    system = psf.drifting(pushed(), gain=psf.OrnsteinUhlenbeck(scale="log", every=3))
    params = PARAMS | {"gain_strength": 0.4, "gain_rate": 0.5}
    expected = psf.log_likelihood(system, psf.EKF(), params, DATA, steps=GRID, inputs=PUSH)
    for steps in (GRID, pm.Data):
        with pm.Model() as model:
            at = steps if steps is GRID else pm.Data("at", GRID)
            pm.Normal("a")
            psf.StateSpace(
                "d", system, psf.EKF(), steps=at, observed=DATA, inputs=PUSH,
                params={name: value for name, value in params.items() if name != "a"},
            )  # fmt: skip
            found = model.compile_logp(vars=[model["d"]], sum=True)({"a": params["a"]})
        np.testing.assert_allclose(found, expected.sum(), rtol=1e-12)
    gradient = model.compile_dlogp()({"a": params["a"]})
    assert np.isfinite(gradient).all()


def test_a_parameter_that_moves_a_jump_is_for_particles():
    system = pushed(
        transition=lambda x, q, t, tau: [pt.switch(t < tau, 0.9, -0.9) * x[0] + q[0]],
        process_noise=[[0.01]],
        inputs=None,
    )
    moving = psf.drifting(system, tau=psf.RandomWalk())
    params = {"tau": 5.0, "tau_strength": 0.3}
    with pytest.raises(
        ModelError, match=r"EKF cannot follow the drifting tau, at which.*Bootstrap"
    ):
        psf.log_likelihood(moving, psf.EKF(), params, DATA, steps=GRID)
    psf.log_likelihood(moving, psf.BootstrapPF(64), params, DATA, steps=GRID)


def test_held_parameters_have_no_transition_density():
    assert compile_system(psf.drifting(pushed(), gain=psf.RandomWalk())).has_transition_density
    held = psf.drifting(pushed(), gain=psf.RandomWalk(every=3))
    assert not compile_system(held).has_transition_density


def negative():
    """A system with a parameter that is negative by default."""
    return pushed(transition=lambda x, q, c=-1.0: [c * x[0] + q[0]], process_noise=[[1.0]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: psf.drifting(pushed(), k=psf.RandomWalk()), r"k must be a parameter.*'gain'"),
        (lambda: psf.drifting(pushed(), a=psf.RandomWalk), r"a class: write psf.RandomWalk\(\)"),
        (lambda: psf.drifting(pushed(), a=0.1), r"a must be psf.RandomWalk\(...\)"),
        (lambda: psf.drifting(pushed()), "give a process for at least one parameter"),
        (lambda: psf.drifting(3, a=psf.RandomWalk()), "system must be a StateSpaceModel, got 3"),
        (lambda: psf.RandomWalk(every=0), "every must be an integer of at least 1, got 0"),
        (lambda: psf.RandomWalk(scale="logit"), r'scale must be "identity".*got \'logit\''),
        (lambda: psf.RandomWalk(scale=("logit", 2, 1)), "low < high"),
        (
            lambda: psf.drifting(pushed(), **{"a[1]": psf.RandomWalk()}),
            r"a\[1\] must be an element of a, which has the shape \(\)",
        ),
        (
            lambda: psf.drifting(psf.drifting(pushed(), a=psf.RandomWalk()), a=psf.RandomWalk()),
            "a drifts already",
        ),
        (
            lambda: psf.drifting(pushed(states=["a"]), a=psf.RandomWalk()),
            "a must not be the name of a state",
        ),
        (
            lambda: psf.drifting(
                psf.drifting(pushed(), a=psf.RandomWalk()), a_strength=psf.RandomWalk()
            ),
            "a_strength must not drift",
        ),
        (
            lambda: psf.drifting(
                pushed(observation_noise=lambda r: [[r]]), r=psf.RandomWalk(scale="log")
            ),
            r"observation_noise must not depend on drifting parameters, \['r'\]",
        ),
        (
            lambda: psf.drifting(pushed(initial_mean=lambda m: [m]), m=psf.RandomWalk()),
            "m must be a parameter of a step or an observation",
        ),
        (
            lambda: psf.drifting(negative(), c=psf.RandomWalk(scale="log")),
            "c must start on the scale 'log', got its default -1",
        ),
        (
            lambda: psf.drifting(pickle.loads(pickle.dumps(pushed())), a=psf.RandomWalk()),
            "system must not have been unpickled",
        ),
        (
            lambda: psf.log_likelihood(
                psf.drifting(pushed(), a=psf.RandomWalk()), psf.GridFilter(),
                PARAMS | {"a_strength": 0.1}, DATA, steps=GRID, inputs=PUSH,
            ),
            r"GridFilter treats systems of one state, got 2 states \['x0', 'a'\], of which \['a'\] "
            "are drifting parameters",
        ),
    ],
)  # fmt: skip
def test_what_cannot_drift_is_refused(call, message):
    with pytest.raises(ModelError, match=message):
        call()
