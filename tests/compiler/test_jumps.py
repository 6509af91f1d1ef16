"""Which equations jump as the state moves: not those with kinks or with steps of anything else."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.advice.choice import jump_problem
from pymc_statespace_filters.advice.collapse import collapse_remedy
from pymc_statespace_filters.compiler.lowering.compiled_system import compile_system
from pymc_statespace_filters.compiler.lowering.jumps import jumping_equations
from pymc_statespace_filters.pymc_model.graph_rewrites import pilot_filters, with_filter


def system(step=lambda x, a: a * x, **changes):
    settings = dict(
        transition=lambda x, q, a: step(x[0], a) + q[0], process_noise=1.0,
        observation=lambda x: x[0], observation_noise=1.0, initial_mean=0.5, initial_cov=0.25,
    )  # fmt: skip
    return psf.StateSpaceModel(**settings | changes)


def drift(function, dt=0.05):
    return system(
        transition=psf.EulerMaruyama(lambda x: function(x[0]), 0.5, dt=dt), process_noise=None
    )


JUMPS = {
    "switch": lambda x, a: pt.switch(x > a, x - 0.8, x + 0.5),
    "far threshold": lambda x, a: pt.switch(x > 700, 0.0, x),
    "very far threshold": lambda x, a: pt.switch(x > 1e5, 0.5 * x, x),
    "two thresholds": lambda x, a: pt.switch(pt.and_(x > 0, x < a), 3.0, 0.0),
    "threshold model": lambda x, a: pt.switch(x > 0.5, a + x, x - a),
    "sign": lambda x, a: pt.sign(x - a),
    "floor": lambda x, a: 2 * a * pt.floor(x),
    "ceil": lambda x, a: 2 * a * pt.ceil(x),
    "round": lambda x, a: 2 * a * pt.round(x),
    "remainder": lambda x, a: x % 1.0,
    "truth value": lambda x, a: 2 * (x > 3),
}
CONTINUOUS = {
    "smooth": lambda x, a: pt.tanh(a * x),
    "kink": lambda x, a: pt.switch(x > a, a + 2 * (x - a), x),
    "ramp": lambda x, a: pt.switch(x > 0, x, 0.0),
    "freeplay": lambda x, a: x - 0.1 * psf.mechanics.freeplay(x, 2.0, a),
    "rounded freeplay": lambda x, a: x - 0.1 * psf.mechanics.freeplay(x, 2.0, a, width=0.1),
    "absolute value": lambda x, a: a * abs(x),
    "maximum": lambda x, a: pt.maximum(x, a),
    "clip": lambda x, a: pt.clip(x, -a, a),
    "by its sign": lambda x, a: x * pt.sign(x),
    "of a parameter": lambda x, a: pt.switch(a > 1, a * x, 2 * x),
    "beside much noise": lambda x, a: x + 0.1 * pt.sign(x),
}


@pytest.mark.parametrize("name", JUMPS)
def test_steps_of_the_state_are_jumps(name):
    assert jumping_equations(system(JUMPS[name])) == ("transition",)


@pytest.mark.parametrize("name", CONTINUOUS)
def test_kinks_and_steps_of_anything_else_are_none(name):
    assert jumping_equations(system(CONTINUOUS[name])) == ()


def test_steps_of_time_and_inputs_are_no_jumps_of_the_state():
    of_time = system(transition=lambda x, q, t: pt.switch(t > 2, 5.0, -5.0) * x[0] + q[0])
    of_input = system(
        transition=lambda x, q, u: pt.switch(u[0] > 2, 9.0, 0.0) + x[0] + q[0], inputs=["force"]
    )
    assert jumping_equations(of_time) == jumping_equations(of_input) == ()


def test_observations_and_drifts():
    assert jumping_equations(system(observation=lambda x: 3 * pt.round(x[0]))) == ("observation",)
    # A drift moves the state of a step by dt times its jump: 0.9, 0.4 (of which the sign 0 at the
    # threshold itself leaves a half) and 0.06 standard deviations.
    assert jumping_equations(drift(lambda x: -pt.sign(x))) == ("transition",)
    assert jumping_equations(drift(lambda x: -pt.sign(x), dt=0.01)) == ("transition",)
    assert jumping_equations(drift(lambda x: -pt.sign(x), dt=0.0002)) == ()
    assert jumping_equations(drift(lambda x: -psf.mechanics.freeplay(x, 2.0, 0.5))) == ()


def test_a_carried_memory_is_no_jump():
    memory = dict(
        transition=lambda x, q: [pt.switch(x[1] > 0, 0.9, -2.0) * x[0] + q[0], pt.sign(x[0])],
        initial_mean=[0.0, 1.0], initial_cov=np.diag([1.0, 0.0]), states=["z", "side"],
    )  # fmt: skip
    assert jumping_equations(system(**memory, carried=["side"])) == ()
    assert jumping_equations(system(**memory)) == ("transition",)


RECORD = dict(observed=[0.1, 0.2], steps=[1, 2])


def test_a_filter_that_linearises_a_jump_is_warned_of_once():
    switched = system(JUMPS["switch"])
    with pytest.warns(psf.errors.FilterWarning) as caught:
        psf.log_likelihood(switched, psf.EKF(), {"a": [0.1, 0.2, 0.3]}, **RECORD)
    assert [str(w.message) for w in caught] == [
        "EKF(): the transition of this system jumps where the state crosses a threshold, which no "
        "linearisation follows, and the log-likelihood may be far off; use BootstrapPF(1000)."
    ]
    assert caught[0].filename == __file__
    with pytest.warns(psf.errors.FilterWarning, match="jumps") as caught:
        psf.run_filter(switched, psf.EKF(), {"a": 0.1}, **RECORD)
    assert caught[0].filename == __file__


def test_a_model_with_such_a_filter_is_warned_of_where_it_is_built():
    switched = system(JUMPS["switch"])
    with pm.Model():
        pm.Normal("a")
        with pytest.warns(psf.errors.FilterWarning, match="EKF.*jumps") as caught:
            psf.StateSpace("d", switched, psf.EKF(), **RECORD)
        assert caught[0].filename == __file__
    # None of a filter that does not linearise, nor where the package itself takes an EKF.
    with pm.Model() as model:
        pm.Normal("a")
        psf.StateSpace("e", switched, psf.BootstrapPF(10), **RECORD)
    assert pilot_filters(model, takes_counts=False) == {"e": psf.EKF()}
    with_filter([model.logp()], model, pilot_filters(model, takes_counts=False))


@pytest.mark.parametrize(
    ("filter", "of_step", "of_drift"),
    [
        (psf.EKF(), True, True), (psf.UKF(), True, False), (psf.IPLF(), True, False),
        (psf.EnKF(10), False, False), (psf.GridFilter(), False, False),
        (psf.GuidedPF(10), False, False),
    ],
)  # fmt: skip
def test_which_filters_do_not_follow(filter, of_step, of_drift):
    """UKF and IPLF were up to 14 nats off beside a jump of the state, 2 beside one of a drift."""
    found = [
        jump_problem(compile_system(s), filter) is not None
        for s in (system(JUMPS["switch"]), drift(lambda x: -pt.sign(x)), system())
    ]
    assert found == [of_step, of_drift, False]
    states = np.eye(2)
    two = system(
        transition=lambda x, q: [pt.sign(x[1]) + q[0], x[0]],
        initial_mean=[0.0, 0.0], initial_cov=states, observation=lambda x: pt.sign(x[0]),
    )  # fmt: skip
    said = jump_problem(compile_system(two), psf.EKF())
    assert "the transition and the observation of this system jump where" in said
    assert "GridFilter" not in said


def test_a_collapse_beside_a_jump_is_not_cured_by_a_guide_or_a_grid():
    compiled = compile_system(system(JUMPS["switch"]))
    assert collapse_remedy(compiled, psf.BootstrapPF(9)).startswith("Use more particles")
    assert collapse_remedy(compiled, psf.GuidedPF(9)).startswith("Use BootstrapPF(1000), which")
    kinked = compile_system(system(CONTINUOUS["freeplay"]))
    assert "Use GridFilter(tolerance=0.0001)" in collapse_remedy(kinked, psf.BootstrapPF(9))


def test_a_step_of_the_state_is_not_linear_although_its_derivative_is_constant():
    for equation in (
        lambda x, q: [0.7 * x[0] + pt.sign(x[0]) + q[0]],
        lambda x, q: [0.7 * x[0] + 1.5 * (x[0] > 0) + q[0]],
        lambda x, q: [0.7 * x[0] + pt.switch(x[0] > 1, 1.0, 0.0) + q[0]],
        lambda x, q: [0.7 * x[0] + pt.cast(x[0], "int64") + q[0]],
        lambda x, q: [pt.floor(x[0]) + q[0]],
        lambda x, q: [x[0] + pt.sign(q[0])],
    ):
        system = linear_but_for(equation)
        assert not system.is_linear
        assert not psf.EKF().is_exact_for(system)
    for equation in (
        lambda x, q, t: [pt.switch(t < 3, x[0], 2.0 * x[0]) + q[0]],
        lambda x, q, t, a: [pt.sign(a) * x[0] + q[0]],
    ):
        assert linear_but_for(equation).is_linear


def linear_but_for(transition):
    return compile_system(
        psf.StateSpaceModel(
            transition=transition,
            process_noise=[[0.1]],
            observation=lambda x: [x[0]],
            observation_noise=[[1.0]],
            initial_mean=[0.0],
            initial_cov=[[1.0]],
        )
    )
