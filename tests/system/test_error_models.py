"""Errors of measurements: their density given the state, in every filter that takes them."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy.stats import lognorm, norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.pharmacometrics import log_normal_error, normal_error

pytestmark = pytest.mark.usefixtures("interpreted")

AT = {"V": 4.0, "CL": 2.0, "a": 0.3, "b": 0.2, "c": 0.5}
STATE, DATA = [8.0, -3.0], [2.4, -2.6]
PREDICTED = np.array([2.0, -3.0])
FILTERS = [
    psf.EKF(),
    psf.UKF(),
    psf.IPLF(),
    psf.EnKF(8),
    psf.BootstrapPF(8),
    psf.GuidedPF(8),
    psf.PFEnKF(8),
]


def both(x, V):
    return [x[0] / V, x[1]]


def system_of(error, state=STATE, **changes):
    """A system whose state is known at step 0."""
    n = len(state)
    arguments = dict(
        transition=lambda x, q: [x[i] + q[i] for i in range(n)],
        process_noise=np.eye(n),
        initial_mean=state,
        initial_cov=np.zeros((n, n)),
    )
    return psf.StateSpaceModel(**arguments | changes, **error)


def at(system):
    return {name: AT[name] for name in system.parameters}


def density(system, filter, data=DATA):
    return psf.log_likelihood(system, filter, at(system), [data], steps=[0])[0]


ERRORS = {
    "additive": (dict(additive=["a", "c"]), [0.3, 0.5]),
    "proportional": (dict(proportional=["b", "c"]), [0.2 * 2, 0.5 * 3]),
    "both": (dict(additive=["a", "a"], proportional=["b", "c"]), np.hypot(0.3, [0.4, 1.5])),
    "one of each": (dict(additive=["a", None], proportional=[None, "b"]), [0.3, 0.6]),
}


@pytest.mark.parametrize("filter", FILTERS, ids=lambda f: type(f).__name__)
def test_a_normal_error_is_the_same_in_every_filter(filter):
    for names, sd in ERRORS.values() if isinstance(filter, psf.BootstrapPF) else [ERRORS["both"]]:
        found = density(system_of(normal_error(both, **names)), filter)
        assert found == pytest.approx(norm.logpdf(DATA, PREDICTED, sd).sum(), abs=1e-10)


@pytest.mark.parametrize("filter", [FILTERS[2], *FILTERS[4:]], ids=lambda f: type(f).__name__)
def test_a_log_normal_error_is_a_density_of_the_data(filter):
    system = system_of(log_normal_error(lambda x, V: [x[0] / V], "a"), [8.0])
    found = density(system, filter, [2.4])
    assert found == pytest.approx(lognorm.logpdf(2.4, 0.3, scale=2.0), abs=1e-10)


@pytest.mark.parametrize("filter", [psf.EKF(), psf.EnKF(8)], ids=repr)
def test_a_filter_without_a_log_normal_error_says_which_have_one(filter):
    system = system_of(log_normal_error(lambda x: [x[0]], "a"), [8.0])
    with pytest.raises(ModelError, match=r"observation_dist.*can be treated by .*IPLF\(\)"):
        density(system, filter, [2.4])


def test_logarithms_with_a_normal_error_differ_by_their_sum():
    """The advice for filters that take Gaussian noise alone."""
    logs = normal_error(lambda x, V: [pt.log(x[0] / V)], additive="a")
    raw = system_of(log_normal_error(lambda x, V: [x[0] / V], "a"), [8.0])
    found = density(system_of(logs, [8.0]), psf.EKF(), [np.log(2.4)])
    assert found == pytest.approx(density(raw, psf.BootstrapPF(8), [2.4]) + np.log(2.4))


def test_an_ode_takes_a_log_normal_error_with_ekf():
    decay = psf.StateSpaceModel(
        transition=psf.RungeKutta4(lambda x, CL, V: [-CL / V * x[0]], dt=0.1),
        initial_mean=[8.0],
        initial_cov=[[0.0]],
        **log_normal_error(lambda x, V: [x[0] / V], "a"),
    )
    found = psf.log_likelihood(decay, psf.EKF(), at(decay), [1.3], times=[1.0])
    expected = lognorm.logpdf(1.3, 0.3, scale=2 * np.exp(-0.5))
    assert found[0] == pytest.approx(expected, abs=1e-6)


def test_simulated_errors_have_the_sizes_of_their_parameters():
    n = 4000
    for error, of in (
        (normal_error(lambda x, V: [x[0] / V], additive="a", proportional="b"), np.asarray),
        (log_normal_error(lambda x, V: [x[0] / V], "a"), np.log),
    ):
        system = system_of(error, [8.0], transition=lambda x: [x[0]], process_noise=None)
        drawn = psf.simulate(system, at(system), steps=np.arange(n), random_seed=1)["observations"]
        sd = np.hypot(0.3, 0.4) if of is np.asarray else 0.3
        values = of(drawn.values[:, 0])
        # A correct one fails with probability 1e-4, as each of two z is within 4.
        assert abs(values.mean() - of(2.0)) < 4 * sd / np.sqrt(n)
        assert abs(values.std() / sd - 1) < 4 / np.sqrt(2 * n)


def test_names_and_defaults_are_those_of_prediction_and_errors():
    error = normal_error(lambda x, V=4.0, *, t: [x[0] / V + 0 * t], additive="a", proportional="a")
    system = system_of(error, [8.0])
    assert system.parameters == ("V", "a")
    found = psf.log_likelihood(system, psf.EKF(), {"a": 0.3}, [2.4], steps=[0])[0]
    assert found == pytest.approx(norm.logpdf(2.4, 2.0, np.hypot(0.3, 0.6)))
    assert system == system_of(error, [8.0])


def test_nuts_has_a_gradient_of_the_sizes():
    error = normal_error(lambda x, V: [x[0] / V], additive="a", proportional="b")
    with pm.Model() as model:
        a, b = pm.HalfNormal("a"), pm.HalfNormal("b")
        psf.StateSpace(
            "d", system_of(error, [8.0]), psf.EKF(), params={"V": 4.0}, steps=[0], observed=[2.4]
        )
        slope = model.compile_dlogp([a, b], jacobian=False)
    values = {"a_log__": np.log(0.3), "b_log__": np.log(0.2)}
    found = slope(values)
    variance, r = 0.3**2 + 0.4**2, 0.4
    by_variance = 0.5 * (r**2 / variance**2 - 1 / variance)
    prior = np.array([-0.3, -0.2])
    expected = by_variance * np.array([2 * 0.3, 2 * 0.2 * 4]) + prior
    np.testing.assert_allclose(found, expected * np.array([0.3, 0.2]), rtol=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: normal_error(both), "must name an error for each observable.*got None and None"),
        (lambda: normal_error(both, additive=["a", None]), "an error for each observable"),
        (lambda: normal_error(both, additive=["a"], proportional=["b", "c"]), "of one length"),
        (lambda: normal_error(both, additive=0.3), "additive must name a parameter.*got 0.3"),
        (lambda: normal_error(both, proportional="t"), "proportional must name .*got 't'"),
        (lambda: log_normal_error(both, ["a", None]), r"sd must name .*got \['a', None\]"),
        (lambda: log_normal_error(2.0, "a"), "prediction must be a function, got 2.0"),
        (lambda: system_of(normal_error(both, proportional="b")), r"prediction must have shape"),
        (lambda: system_of(log_normal_error(both, "b")), r"prediction must have shape \(1,"),
        (lambda: system_of(normal_error(lambda *x: x, proportional="b")), "named arguments only"),
    ],
)  # fmt: skip
def test_wrong_errors_are_refused(make, message):
    with pytest.raises(ModelError, match=message):
        make()
