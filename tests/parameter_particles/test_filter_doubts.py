"""The check of the filter at the end of a run, and what an extension keeps of it."""

import json
import logging

import pytest
import xarray as xr

import pymc_statespace_filters as psf
from pymc_statespace_filters.checks.filters.checks import kept
from pymc_statespace_filters.parameter_particles.filter_doubts import kept_from
from tests.sampling.test_filter_check import N, model_of, outcome_of

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
