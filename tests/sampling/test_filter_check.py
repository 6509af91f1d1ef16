"""The check of the filters at the end of a run: its warning, its sentence, where it is left out."""

import json
import logging
import warnings

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.pymc_model.filter_estimates import VariableAtPoints
from tests.systems import autoregression

pytestmark = pytest.mark.usefixtures("without_compilation")

N = 30
SETTINGS = {"draws": 300, "tune": 300, "chains": 2, "random_seed": 1, "cores": 1}


def model_of(bend, filter=None):
    """A sensor that is linear at 0, and squares at 1."""
    system = autoregression(
        spread=0.5,
        observation=lambda x, bend: [(1.0 - bend) * x[0] + bend * x[0] ** 2],
        observation_noise=0.04,
    )
    given = {"phi": 0.8, "bend": bend}
    record = psf.simulate(system, given, steps=range(N), random_seed=1)["observations"]
    with pm.Model() as model:
        phi = pm.Uniform("phi", 0.3, 1.0)
        psf.StateSpace(
            "d",
            system,
            filter or psf.EKF(),
            params={"phi": phi, "bend": bend},
            steps=range(N),
            observed=record,
        )
    return model


def outcome_of(idata):
    return json.loads(idata.attrs["filter_check"])["d"]["outcome"]


def test_a_filter_that_is_off_is_warned_of_at_the_call():
    with pytest.warns(psf.errors.FilterWarning, match=r"d: EKF\(\) is .* Use G") as caught:
        idata = psf.sample_dram(model=model_of(1.0), progressbar=False, **SETTINGS)
    assert [one.filename for one in caught] == [__file__]
    assert outcome_of(idata) == "off"


def test_a_filter_that_is_right_has_a_sentence_in_the_report(caplog):
    with caplog.at_level(logging.DEBUG, "pymc.stats.convergence"):
        idata = psf.sample_dram(model=model_of(0.02), progressbar=False, **SETTINGS)
    assert outcome_of(idata) == "no sign"
    (said,) = [one for one in caplog.records if "EKF() is close to GridFilter()" in one.message]
    assert said.levelno == logging.DEBUG


def test_nothing_is_said_where_nothing_was_compared(caplog):
    with caplog.at_level(logging.DEBUG, "pymc.stats.convergence"):
        idata = psf.sample_dram(
            model=model_of(1.0, psf.BootstrapPF(50)), progressbar=False, **SETTINGS
        )
    assert outcome_of(idata) == "exact"
    assert not [one for one in caplog.records if one.message.startswith("d: ")]


def test_several_models_are_named():
    models = {"bent": model_of(1.0), "exact": model_of(1.0, psf.GridFilter())}
    with pytest.warns(psf.errors.FilterWarning, match=r"^Model 'bent': d: EKF") as caught:
        trees = psf.run_models(models, sampler="dram", progressbar=False, **SETTINGS)
    assert len(caught) == 1
    assert {name: outcome_of(tree) for name, tree in trees.items()} == {
        "bent": "off",
        "exact": "exact",
    }


@pytest.mark.parametrize(
    "changes", [{"check": False}, {"compute_convergence_checks": False}, {"draws": 290}]
)
def test_it_is_left_out_on_demand_and_after_short_runs(changes):
    settings = SETTINGS | changes
    idata = psf.sample_dram(model=model_of(1.0), progressbar=False, **settings)
    assert "filter_check" not in idata.attrs


def test_sample_and_run_models_leave_it_out_on_demand():
    for check in (False, True):
        given = SETTINGS | {"until_ess": None, "check": check, "progressbar": False}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore" if check else "error", psf.errors.FilterWarning)
            sampled = psf.sample(model=model_of(1.0), sampler="dram", **given)
            run = psf.run_models({"m": model_of(1.0)}, **given)["m"]
        assert all(("filter_check" in tree.attrs) == check for tree in (sampled, run))


def test_check_is_a_flag():
    with pytest.raises(psf.errors.ModelError, match="check must be True or False, got 1"):
        psf.sample_dram(model=model_of(1.0), check=1)


def test_the_report_names_the_call_that_takes_the_time_to_compile(caplog, monkeypatch):
    monkeypatch.setattr(VariableAtPoints, "is_compiled", lambda variable, filter: False)
    model = model_of(1.0)
    with caplog.at_level(logging.DEBUG, "pymc.stats.convergence"):
        idata = psf.sample_dram(model=model, progressbar=False, **SETTINGS)
    assert outcome_of(idata) == "undecided"
    assert "is not compiled yet; psf.check_filter(idata, model) takes" in caplog.text
    found = psf.check_filter(idata, model, random_seed=1, progressbar=False)
    assert found["outcome"][0] == "off"


def test_a_model_without_such_a_variable_has_none():
    with pm.Model():
        mu = pm.Normal("mu")
        pm.Normal("y", mu, 1.0, observed=np.ones(3))
        idata = psf.sample_dram(progressbar=False, **SETTINGS)
    assert "filter_check" not in idata.attrs
