"""Other filters than the model's: `inner`, and what follows from the results; `screen`."""

import json
import logging

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.checks.filters.checks import kept
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.filters.written import filter_from, short_form
from pymc_statespace_filters.parameter_particles.filter_doubts import kept_from
from pymc_statespace_filters.pymc_model.other_filter import model_with
from tests.modes import AS_IT_STANDS
from tests.parameter_particles.autoregression import DATA, STEPS, exact, model
from tests.sampling.test_filter_check import N, model_of, outcome_of

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
    with pm.Model() as other:
        pm.Normal("a")
    with pytest.raises(ModelError, match="inner must be None for a model without"):
        psf.sample_smc(model=other, inner=psf.EKF())


# The check of the filter at the end of a run, and what an extension keeps of it.


SETTINGS = {"random_seed": 1, "progressbar": False, "populations": 4}


@pytest.mark.parametrize("data", ["tempered", "sequential"])
def test_a_filter_that_is_off_is_warned_of_at_the_call(data):
    with pytest.warns(psf.errors.FilterWarning, match=r"^d: EKF\(\) is .* Use G") as caught:
        idata = psf.sample_smc(150, model=model_of(1.0), data=data, **SETTINGS)
    assert [one.filename for one in caught] == [__file__]
    assert outcome_of(idata) == "off"
    assert "EKF() is" in str(idata["evidence"]["doubts"].values)
    if data == "sequential":
        _keeps_the_doubt(idata)


def _keeps_the_doubt(idata):
    new = {"observed": [0.2], "steps": [N]}
    with pytest.warns(psf.errors.FilterWarning, match=r"^d: EKF\(\) is .* Use G") as caught:
        longer = psf.extend(idata, model_of(1.0), progressbar=False, **new)
    assert [one.filename for one in caught] == [__file__]
    assert longer.attrs["filter_check"] == idata.attrs["filter_check"]
    assert "EKF() is" in str(longer["evidence"]["doubts"].values)


def test_a_filter_that_is_right_has_a_sentence_in_the_log(caplog):
    with caplog.at_level(logging.DEBUG, "pymc.stats.convergence"):
        idata = psf.sample_smc(150, model=model_of(0.02), **SETTINGS)
    assert outcome_of(idata) == "no sign"
    (said,) = [one for one in caplog.records if "EKF() is close to GridFilter()" in one.message]
    assert said.levelno == logging.DEBUG


@pytest.mark.parametrize("changes", [{"compute_convergence_checks": False}, {"populations": 3}])
def test_it_is_left_out_on_demand_and_after_short_runs(changes):
    idata = psf.sample_smc(150, model=model_of(1.0), **SETTINGS | changes)
    assert "filter_check" not in idata.attrs


def _with_outcome(outcome, filter):
    found = {"d": {"filter": filter, "outcome": outcome, "verdict": f"{filter} is {outcome}"}}
    return xr.DataTree(xr.Dataset(attrs={"filter_check": json.dumps(found)}))


def test_what_holds_for_further_rows():
    assert kept(_with_outcome("off", "EnKF(50)"), psf.EnKF(50))["d"]["outcome"] == "off"
    assert not kept(_with_outcome("off", "EnKF(50)"), psf.EnKF(100))
    assert not kept(_with_outcome("no sign", "EKF()"), psf.EKF())
    tree, is_exact = xr.DataTree(), kept_from(_with_outcome("exact", "BootstrapPF(50)"))
    assert not is_exact(tree, psf.BootstrapPF(100), 1.0)  # no doubt, and what is known stays
    assert "BootstrapPF(100)" in tree.attrs["filter_check"]
    (doubled,) = kept(_with_outcome("exact", "BootstrapPF(50)"), psf.BootstrapPF(100)).values()
    assert (doubled["filter"], doubled["outcome"]) == ("BootstrapPF(100)", "exact")
