"""Free variables of which the likelihood is a staircase: found, and said to samplers and maxima."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.lowering.jumps import stepped_parameters
from pymc_statespace_filters.pymc_model.inspection import state_space_nodes
from pymc_statespace_filters.pymc_model.stepped import stepped_variables

pytestmark = pytest.mark.usefixtures("interpreted")

STEPS = np.arange(1, 21)


def system(transition):
    return psf.StateSpaceModel(
        transition=transition, process_noise=0.1,
        observation=lambda x: x[0], observation_noise=0.1, initial_mean=0.0, initial_cov=0.1,
    )  # fmt: skip


def switched(x, q, t, a, tau):
    return a * x[0] + pt.switch(t < tau, 0.0, 1.0) + q[0]


CASES = {
    "time": (switched, ("tau",)),
    "rounded": (lambda x, q, t, a, tau: a * x[0] + 1e-3 * pt.floor(tau) * t + q[0], ("tau",)),
    "kink": (lambda x, q, t, a, tau: a * x[0] + pt.switch(t > tau, t - tau, 0.0) + q[0], ()),
    "threshold": (lambda x, q, a, tau: pt.switch(x[0] < tau, a * x[0], 2.0) + q[0], ()),
    "guard": (
        lambda x, q, a, tau: a * x[0] + pt.switch(pt.abs(tau) < 1e-8, 1.0, pt.expm1(tau) / tau),
        (),
    ),
    "guard with rounding": (
        lambda x, q, w: pt.switch(w > 1e-8, (1 - pt.cos(w)) / w**2, 0.5) * x[0] + q[0],
        (),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_parameters_compared_with_the_time_are_found(case):
    transition, expected = CASES[case]
    assert stepped_parameters(system(transition)) == expected


def test_a_condition_inside_a_matrix_exponential_is_no_staircase():
    """The root of the covariance of a step at uneven times has one."""
    equation = psf.ExactLinear(
        lambda w2, c: [[0.0, 1.0], [-w2, -c]], lambda s: [[0.0], [s]], dt=1.0
    )
    oscillator = psf.StateSpaceModel(
        transition=equation, observation=lambda x: x[0], observation_noise=0.1,
        initial_mean=[0.0, 0.0], initial_cov=0.1 * np.eye(2),
    )  # fmt: skip
    with pm.Model() as model:
        for name in ("w2", "c", "s"):
            pm.HalfNormal(name)
        psf.StateSpace("d", oscillator, psf.EKF(), times=[0.1, 0.5, 1.1], observed=np.zeros(3))
    assert stepped_parameters(state_space_nodes(model)["d"].op.system) == ()


def model_of(tau, observed=None):
    rng = np.random.default_rng(1)
    if observed is None:
        observed = np.cumsum(0.3 * rng.standard_normal(len(STEPS)))
    with pm.Model() as model:
        pm.Normal("a", 0.5, 0.1)
        values = {} if callable(tau) else {"tau": tau}
        if callable(tau):
            tau()
        psf.StateSpace(
            "d", system(switched), psf.EKF(), steps=STEPS, observed=observed, params=values
        )
    return model


def test_free_variables_behind_a_stepped_parameter_are_named():
    assert stepped_variables(model_of(lambda: pm.Uniform("tau", 0, 20))) == ("tau",)
    assert stepped_variables(model_of(7.3)) == ()

    def through_another():
        centre = pm.Normal("centre", 10, 3)
        pm.Deterministic("tau", centre + 1)

    assert stepped_variables(model_of(through_another)) == ("centre",)


def test_conditions_outside_the_equations_count_if_they_leave_a_gap():
    years = np.arange(10.0)
    with pm.Model() as model:
        year, low, high = pm.Uniform("year", 0, 10), pm.Normal("low"), pm.Normal("high")
        pm.Poisson("n", pt.exp(pt.switch(year > years, low, high)), observed=years.astype(int))
    assert stepped_variables(model) == ("year",)
    with pm.Model() as kinked:
        year, slope = pm.Uniform("year", 0, 10), pm.Normal("slope")
        mean = slope * pt.switch(years > year, years - year, 0.0)
        pm.Normal("d", mean, pm.HalfNormal("sigma"), observed=years)
    assert stepped_variables(kinked) == ()


def asked_by(module, model):
    """The log-density as a function of this module would ask for it."""
    exec("model.logp()", {"__name__": module, "model": model})


@pytest.mark.parametrize("module", ["pymc.step_methods.hmc.nuts", "nutpie.compile_pymc"])
def test_a_sampler_with_gradients_is_told_of_the_staircase(module):
    with pytest.warns(psf.errors.FilterWarning, match="staircase of tau.*sample_dram"):
        asked_by(module, model_of(lambda: pm.Uniform("tau", 0, 20)))
    asked_by(module, model_of(7.3))  # a number: warnings are errors
    asked_by("pymc.step_methods.metropolis", model_of(lambda: pm.Uniform("tau", 0, 20)))
