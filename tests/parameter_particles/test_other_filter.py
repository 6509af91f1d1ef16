"""Other filters than the model's: `inner`, and what follows from the results; `screen`."""

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.written import filter_from, short_form
from pymc_statespace_filters.pymc_model.other_filter import model_with
from tests.evaluation.test_resumption import Stateless
from tests.modes import AS_IT_STANDS
from tests.parameter_particles.autoregression import DATA, STEPS, exact, model

QUIET = {"random_seed": 2, "progressbar": False}
SMALL = QUIET | {"draws": 30, "populations": 2, "compute_convergence_checks": False}


def _equal(one, other, *groups):
    return all(one[name].to_dataset().equals(other[name].to_dataset()) for name in groups)


@pytest.mark.filterwarnings("ignore:the log-evidence")  # few particles, of parameters
@pytest.mark.filterwarnings("ignore:BootstrapPF")  # and of states
@pytest.mark.parametrize("data", ["tempered", "sequential"])
def test_it_is_a_run_of_a_model_with_that_filter(data):
    """The members are doubled on the way, and more rows, states and terms take the same model."""
    settings, written = SMALL | {"data": data}, model(psf.EKF(), 12)
    inner = psf.BootstrapPF(6)
    found = psf.sample_smc(model=written, inner=inner, **settings)
    own = psf.sample_smc(model=model(inner, 12), **settings)
    assert found.attrs == own.attrs
    assert _equal(found, own, "posterior", "sample_stats", "smc", "evidence")
    if data == "sequential":
        more = {"observed": DATA[12:14], "steps": STEPS[12:14], "progressbar": False}
        found, own = psf.extend(found, written, **more), psf.extend(own, model(inner, 12), **more)
        assert _equal(found, own, "posterior", "smc", "evidence")
        written = model(psf.EKF(), 14)
    used = filter_from(found.attrs["filter"].split('"')[3])
    assert isinstance(used, psf.BootstrapPF)
    states = psf.filtered_states(found, written, n_draws=20, **QUIET)
    those = psf.filtered_states(own, model(used, written["d"].shape.eval()[0]), n_draws=20, **QUIET)
    assert _equal(states, those, "filtered_states")


def test_a_biased_filter_is_corrected():
    """`reweight` of an ensemble filter whose members were doubled, by the exact filter."""
    written = model(psf.EKF())
    found = psf.sample_smc(
        100, model=written, data="sequential", inner=psf.EnKF(6), **QUIET,
        compute_convergence_checks=False,
    )  # fmt: skip
    truth = exact()
    assert found.attrs["exact"] == 0
    assert "EnKF(6)" not in found.attrs["filter"]
    corrected = psf.reweight(found, written, filter=psf.EKF(), **QUIET).attrs
    assert corrected["pareto_k"] < 0.7
    assert abs(corrected["log_evidence"] - truth.path[-1]) < 4 * corrected["log_evidence_se"] < 0.5


@pytest.mark.filterwarnings("ignore:the log-evidence")  # few particles
@pytest.mark.parametrize("data", ["tempered", "sequential"])
def test_a_screen_spares_evaluations_and_nothing_else(data):
    """Within 4 errors of quadrature; the run that is extended is one run."""
    written, settings = model(psf.BootstrapPF(20)), SMALL | {"data": data, "populations": 6}
    found = psf.sample_smc(model=written, screen=psf.EKF(), **settings)
    truth, error = exact(), found.attrs["log_evidence_se"]
    assert abs(found.attrs["log_evidence"] - truth.path[-1]) < 4 * error < 2.0
    if data == "tempered":
        return
    without = psf.sample_smc(model=written, **settings)
    assert found["smc"]["n_updates"].sum() < 0.9 * without["smc"]["n_updates"].sum()
    first = psf.sample_smc(model=model(psf.BootstrapPF(20), 10), screen=psf.EKF(), **settings)
    more = {"observed": DATA[10:], "steps": STEPS[10:], "progressbar": False}
    longer = psf.extend(first, written, **more)
    assert _equal(longer, found, "posterior", "smc", "smc_state")


@pytest.mark.parametrize(
    "filter",
    [
        psf.EKF(),
        psf.UKF(alpha=0.5),
        psf.IPLF(n_iterations=3),
        psf.EnKF(20, likelihood="gaussian"),
        psf.BootstrapPF(10, resample_below=0.5, resampling="multinomial"),
        psf.RBPF(7, inner=psf.UKF()),
        psf.IMM(),
        psf.GridFilter(tolerance=1e-6),
    ],
)
def test_a_filter_is_read_as_it_was_written(filter):
    assert filter_from(short_form(filter)) == filter


def test_a_filter_of_a_users_own_is_not_read():
    assert filter_from("Mine(3)") is None
    assert filter_from("Mine(<object at 0x1>)") is None


def log_density(model, point):
    return model.compile_logp(mode=AS_IT_STANDS)(point)


def test_the_other_parts_of_a_model_stay():
    with model(psf.EKF()) as built:
        free = pm.Normal("b", 1.0, initval=2.0)
        pm.Potential("bent", -(built["a"] ** 2))
        pm.Deterministic("twice", 2 * free)
    other, point = model_with(built, "inner", psf.BootstrapPF(9)), {"a": 0.4, "b": 0.1}
    with model(psf.BootstrapPF(9)) as expected:
        pm.Potential("bent", -(expected["a"] ** 2))
        pm.Normal("b", 1.0)
    np.testing.assert_allclose(log_density(other, point), log_density(expected, point))
    assert set(other.named_vars) == {*built.named_vars, "d_seed"}
    assert set(built.named_vars) == {"a", "b", "bent", "twice", "d"}
    back = model_with(other, "inner", psf.EKF())
    np.testing.assert_allclose(log_density(back, point), log_density(built, point))


def test_what_is_no_filter_for_the_model_is_refused():
    with pytest.raises(ModelError, match=r"inner must be a filter, such as .*, got 3"):
        psf.sample_smc(model=model(psf.EKF(), 3), inner=3)
    with pytest.raises(ModelError, match=r"screen must be .* without noise, .* got EnKF"):
        psf.sample_smc(model=model(psf.EKF(), 3), screen=psf.EnKF(20))
    settings = SMALL | {"data": "sequential"}
    with pytest.raises(ModelError, match="Stateless cannot: it has no state"):
        psf.sample_smc(model=model(psf.EKF(), 3), screen=Stateless(), **settings)
    with pm.Model() as other:
        pm.Normal("a")
    with pytest.raises(ModelError, match="inner must be None for a model without"):
        psf.sample_smc(model=other, inner=psf.EKF())
