"""Several estimators at once: the names, the streams, the verdict."""

from dataclasses import fields, replace

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import multivariate_normal, norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import EvidenceWarning, ModelError
from pymc_statespace_filters.evidence import Evidence, chib_jeliazkov
from pymc_statespace_filters.evidence.agreement import assess_agreement
from pymc_statespace_filters.evidence.estimation import ESTIMATORS, EvidenceEstimates
from pymc_statespace_filters.evidence.estimators.protocol import Estimate, Estimator
from pymc_statespace_filters.evidence.evidence import store_evidence, stored_evidences
from tests.evidence.analytic import Regression
from tests.evidence.test_models import REGRESSION, exact_draws

ALL = tuple(ESTIMATORS)


@pytest.fixture(scope="module")
def model():
    return REGRESSION.model()


@pytest.fixture(scope="module")
def idata():
    return exact_draws((4, 1000))


@pytest.fixture(scope="module")
def found(idata, model):
    return psf.estimate_evidence(idata, model, estimators=ALL, random_seed=5)


def test_every_estimator_meets_the_truth(found):
    assert tuple(found) == ALL
    for name, evidence in found.items():
        assert evidence.estimator == name
        assert 0 < evidence.se < 0.3
        assert abs(evidence.log_evidence - REGRESSION.log_evidence) < 4 * evidence.se
    assert found.agreement


def test_all_are_stored_beside_the_draws(found, idata):
    group = idata["evidence"].to_dataset()
    assert tuple(group["estimator"].values) == ALL
    for name, evidence in found.items():
        assert group["log_evidence"].sel(estimator=name).item() == evidence.log_evidence


def test_an_estimate_does_not_depend_on_its_company(found, idata, model):
    names = ["importance", "chib_jeliazkov"]
    without_bridge = psf.estimate_evidence(
        idata, model, estimators=names, random_seed=5, extend_inferencedata=False
    )
    assert list(without_bridge) == names
    assert without_bridge == {name: found[name] for name in names}


class LaplaceFromDraws:
    """An estimator outside the package: a Gaussian with the moments of the draws."""

    name = "laplace_from_draws"

    def n_evaluations(self, posterior):
        return 1

    def estimate(self, posterior, *, rng):
        draws = posterior.draws.reshape(-1, posterior.draws.shape[-1])
        normal = multivariate_normal(draws.mean(axis=0), np.cov(draws.T))
        (at_mean,) = posterior.evaluate(normal.mean[np.newaxis], rng)
        log_evidence = at_mean - normal.logpdf(normal.mean)
        return Estimate(float(log_evidence), 0.1, {"n_draws": len(draws)}, ("a rough check",))


def test_an_estimator_from_outside(idata, model):
    idata = xr.DataTree.from_dict({"posterior": idata["posterior"].to_dataset()})
    found = psf.estimate_evidence(
        idata, model, estimators=["bridge", LaplaceFromDraws()], random_seed=5
    )
    assert list(found) == ["bridge", "laplace_from_draws"]
    evidence = found["laplace_from_draws"]
    assert evidence.log_evidence == pytest.approx(REGRESSION.log_evidence, abs=0.1)
    assert evidence.doubts == "a rough check"
    assert idata["evidence"]["n_draws"].sel(estimator="laplace_from_draws") == 4000
    alone = psf.estimate_evidence(
        idata, model, estimators="bridge", random_seed=5, extend_inferencedata=False
    )
    assert alone["bridge"] == found["bridge"]


def test_doubts_about_the_check_are_in_the_result_alone():
    """500 draws of 20 parameters are too few for Chib and Jeliazkov's ordinate, not for bridge."""
    regression = Regression(20, 40, np.random.default_rng(2))
    w = regression.posterior((4, 125), np.random.default_rng(52), correlation=0.5).draws
    idata = az.from_dict({"posterior": {"w": w}})
    found = psf.estimate_evidence(idata, regression.model(), random_seed=2)
    assert "effective draws, fewer than 100" in found["chib_jeliazkov"].doubts
    assert found["chib_jeliazkov"].doubts in repr(found)
    row = psf.compare_evidence({"a": idata}).loc["a"]
    assert row["se"] == found["bridge"].se < 0.05
    assert abs(row["log_evidence"] - regression.log_evidence) < 4 * row["se"]
    assert not row["warning"]


def test_every_built_in_estimator_satisfies_the_protocol():
    assert all(isinstance(estimator, Estimator) for estimator in ESTIMATORS.values())


def test_what_the_diagnosis_names_knows_better():
    """Two equal modes, in one of which the chains have spent a twentieth of their time."""
    rng = np.random.default_rng(3)
    with pm.Model() as model:
        x = pm.Normal("x", 0, 3)
        pm.Normal("y", abs(x), 0.3, observed=3.0)
    truth = np.log(2) + norm.logpdf(3.0, 0, np.hypot(3, 0.3))
    draws = rng.normal(2.97, 0.2985, (4, 1000))  # conjugate: precision 1/9 + 1/0.09
    draws[:, ::20] *= -1.0
    idata = az.from_dict({"posterior": {"x": draws}})
    with pytest.warns(EvidenceWarning) as caught:
        found = psf.estimate_evidence(
            idata, model, estimators=("bridge", "importance"), random_seed=4
        )
    assert "compare with the evidence of sample_smc" in str(caught[-1].message)
    assert not found.agreement
    assert abs(found["bridge"].log_evidence - truth) > 4 * found["bridge"].se
    smc = psf.sample_smc(200, model=model, random_seed=1, progressbar=False)
    table = psf.compare_evidence({"chains": idata, "smc": smc})
    assert table["warning"].to_dict() == {"smc": False, "chains": True}
    assert abs(table["log_evidence"]["smc"] - truth) < 4 * table["se"]["smc"] < 0.3


def evidence(name, log_evidence, se):
    return Evidence(log_evidence, se, name, 2, 10, -3.0, "0c5f")


def estimates(**values):
    return EvidenceEstimates({name: evidence(name, *value) for name, value in values.items()})


class TestAgreement:
    def test_chi_square_by_hand(self):
        found = assess_agreement(estimates(bridge=(-10.0, 0.3), importance=(-10.8, 0.4)))
        assert found.p_value == pytest.approx(0.10960, abs=1e-5)  # z = 0.8 / 0.5 = 1.6
        assert found.difference == pytest.approx(0.8)
        assert found

    def test_what_no_choice_depends_on_is_agreement(self):
        assert assess_agreement(estimates(bridge=(-10.0, 0.001), importance=(-10.04, 0.001)))

    def test_estimates_without_errors_take_no_part(self):
        found = estimates(bridge=(-10.0, 0.01), mine=(-12.0, np.nan))
        assert found.agreement
        assert "agreement not tested" in repr(found)

    def test_an_error_of_zero(self):
        assert assess_agreement(estimates(bridge=(-10.0, 0.0), importance=(-10.0, 0.0)))

    def test_of_three_the_pair_furthest_apart_in_its_errors_is_named(self):
        found = estimates(bridge=(-10.0, 0.01), importance=(-10.5, 0.01), mine=(-9.0, 1.0))
        assert found.agreement.diagnosis.startswith("bridge is 0.50 above importance; ")

    def test_a_diagnosis_without_a_doubt_names_what_looks_elsewhere(self):
        found = estimates(bridge=(-10.0, 0.01), importance=(-11.0, 0.1))
        assert not found.agreement
        assert "draw more, and compare with the evidence of sample_smc" in found.agreement.diagnosis
        assert found.agreement.diagnosis in repr(found)
        assert found.agreement.diagnosis in found._repr_html_()


def test_a_doubt_about_several_estimates_is_shown_once():
    doubts = {"a": "the chains disagree; few terms", "b": "the chains disagree; R-hat < 2"}
    shown = EvidenceEstimates(
        {name: replace(evidence(name, -4.1, 0.25), doubts=text) for name, text in doubts.items()}
    )
    lines = ["a, b: the chains disagree", "a: few terms", "b: R-hat < 2"]
    assert repr(shown).splitlines()[-3:] == lines
    html = shown._repr_html_()
    assert html.count("the chains disagree") == 1
    assert "R-hat &lt; 2" in html


def test_a_long_doubt_does_not_hide_the_errors():
    doubtful = Evidence(-4.0, 0.125, "b", 2, 10, -3.0, "0c5f", doubts="the chains disagree " * 9)
    shown = repr(EvidenceEstimates({"a": evidence("a", -4.1, 0.25), "b": doubtful}))
    for error in ("0.125", "0.250"):
        assert error in shown
    assert shown.endswith(f"b: {doubtful.doubts}")


def test_an_error_names_the_estimator_that_raised_it(idata, model):
    class Refusing(LaplaceFromDraws):
        def estimate(self, posterior, *, rng):
            raise ModelError("not this model")

    with pytest.raises(ModelError, match="not this model") as caught:
        psf.estimate_evidence(idata, model, estimators=[Refusing()])
    assert caught.value.__notes__ == ["raised by the estimator 'laplace_from_draws'"]


# An evidence as it is shown, stored and read back.


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
