"""An evidence as it is shown, stored and read back."""

from dataclasses import fields, replace

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr

from pymc_statespace_filters.errors import EvidenceWarning
from pymc_statespace_filters.evidence import Evidence, chib_jeliazkov
from pymc_statespace_filters.evidence.evidence import store_evidence, stored_evidences

EVIDENCE = Evidence(-8.0, 0.1, "bridge", 2, 21, -5.0, "0c5f")
TOLD = replace(EVIDENCE, log_volume=5.3, uniform="a, b", improper="c", approximate=True)


def empty():
    return az.from_dict({"posterior": {"x": np.zeros((1, 4))}})


@pytest.mark.parametrize("evidence", [EVIDENCE, TOLD])
def test_what_is_stored_is_read(evidence):
    idata = empty()
    store_evidence(idata, evidence, {"scale": 1.0})
    assert stored_evidences(idata, "a") == {evidence.estimator: evidence}


@pytest.mark.parametrize("approximate", [None, False, True])
def test_a_file_holds_all_fields(tmp_path, approximate):
    idata, evidence = empty(), replace(TOLD, approximate=approximate)
    store_evidence(idata, evidence, {"scale": 1.0})
    idata.to_netcdf(tmp_path / "draws.nc")
    with xr.open_datatree(tmp_path / "draws.nc") as read:
        assert stored_evidences(read, "a") == {evidence.estimator: evidence}


def test_every_field_is_in_the_group():
    idata = empty()
    store_evidence(idata, TOLD, {})
    assert {f.name for f in fields(Evidence)} <= set(idata["evidence"].variables)


def test_only_what_is_worth_saying_is_said():
    assert EVIDENCE.prior_note == ""
    assert "improper" not in repr(EVIDENCE)
    assert "improper='c'" in repr(TOLD)
    assert "prior of c is improper or not normalised" in TOLD.prior_note
    assert "Uniform priors of a, b have a log volume of 5.30" in TOLD.prior_note
    # A volume of one is a volume too.
    assert "log volume of 0.00" in replace(EVIDENCE, uniform="a").prior_note


def line(prior):
    """Three observations of a mean, with draws of its posterior under a density of one."""
    with pm.Model() as model:
        prior()
        pm.Normal("y", model["mu"], 1, observed=[0.3, -0.4, 1.1])
    mu = 1 / 3 + np.random.default_rng(1).standard_normal((4, 1000)) / np.sqrt(3)
    return az.from_dict({"posterior": {"mu": mu}}), model


# The integral of the likelihood over the whole line, in closed form.
Y = np.array([0.3, -0.4, 1.1])
OVER_THE_LINE = -np.log(2 * np.pi) - 0.5 * np.log(3) - 0.5 * 3 * Y.var()


def test_uniform_priors_are_no_doubt_and_the_volume_gives_the_integral_of_the_likelihood():
    idata, model = line(lambda: pm.Uniform("mu", -20, 20))
    found = chib_jeliazkov(idata, model, random_seed=1)
    assert found.doubts == ""
    assert found.log_volume == pytest.approx(np.log(40))
    assert abs(found.log_evidence + found.log_volume - OVER_THE_LINE) < 4 * found.se < 0.2


def test_an_improper_prior_is_a_doubt():
    idata, model = line(lambda: pm.Flat("mu"))
    with pytest.warns(EvidenceWarning, match="the prior of mu is improper or not normalised"):
        found = chib_jeliazkov(idata, model, random_seed=1)
    assert found.improper == "mu"
    assert found.log_volume == 0.0
    assert abs(found.log_evidence - OVER_THE_LINE) < 4 * found.se < 0.1
