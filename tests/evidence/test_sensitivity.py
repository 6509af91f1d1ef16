"""Curves of model probability over the width of priors, in closed form."""

import math

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.special import softmax
from scipy.stats import multivariate_normal

from pymc_statespace_filters import prior_sensitivity
from pymc_statespace_filters.errors import DataMismatchError, EvidenceWarning, ModelError
from pymc_statespace_filters.evidence import Evidence
from pymc_statespace_filters.evidence.comparison.scaled_prior import ScaledPrior
from pymc_statespace_filters.evidence.evidence import store_evidence
from tests.evidence.analytic import Regression

SHAPE = (4, 1000)


def evidence(log_evidence, se=0.05, k=2):
    return Evidence(log_evidence, se, "bridge", k, 21, -5.0, "same")


RIVALS = {"small": evidence(-8, k=1), "large": evidence(-6, se=0.2, k=3)}


class Rival:
    """A regression on the first columns, with draws of its posterior and its stored evidence."""

    def __init__(self, k, seed, se=0.01):
        self.target = Regression(k, 8, np.random.default_rng(seed), sd=2.0)
        draws = self.target.posterior(SHAPE, np.random.default_rng(seed), correlation=0.3).draws
        self.idata = az.from_dict({"posterior": {"w": draws}})
        exact = Evidence(self.target.log_evidence, se, "bridge", k, 8, -5.0, "same")
        store_evidence(self.idata, exact, {})
        with pm.Model() as self.model:
            pm.Normal("w", 0, self.target.scale, shape=k)

    def log_evidence(self, width):
        x, sd = self.target.x, self.target.sd
        marginal = (width * self.target.scale) ** 2 * x @ x.T + sd**2 * np.eye(8)
        return multivariate_normal(np.zeros(8), marginal).logpdf(self.target.y)


def curves_of(rivals, **keywords):
    return prior_sensitivity(
        {name: rival.idata for name, rival in rivals.items()},
        models={name: rival.model for name, rival in rivals.items()},
        **keywords,
    )


class TestWidths:
    def test_in_closed_form(self):
        """Six numbers within 4 of their errors: a right implementation fails once in 2600 seeds."""
        rivals = {"line": Rival(2, 1), "plane": Rival(3, 2, se=0.02)}
        widths = [0.5, 1.0, 2.0]
        curves = curves_of(rivals, widths=widths, model_prior={"line": 1, "plane": 2})
        exact = np.array([[rival.log_evidence(w) for w in widths] for rival in rivals.values()])
        error, se = curves["width_log_evidence"] - exact, curves["width_se"]
        assert curves["width_prob"].dims == se.dims == ("model", "width")
        assert (abs(error) < 4 * se).all()
        assert (se < 0.05).all()
        np.testing.assert_allclose(error.sel(width=1), 0, atol=1e-10)
        np.testing.assert_allclose(se.sel(width=1), [0.01, 0.02])
        for name, own in (("line", 0.01), ("plane", 0.02)):
            rival = rivals[name]
            [of_width] = ScaledPrior(rival.model, ["w"]).curve(rival.idata, [0.5])
            assert of_width.error > own / 2
            assert se.sel(model=name, width=0.5) == pytest.approx(np.hypot(own, of_width.error))
        weights = curves["width_log_evidence"] + np.log([[1], [2]])
        np.testing.assert_allclose(curves["width_prob"], softmax(weights, axis=0))
        assert (curves["width_prob_low"] < curves["width_prob"]).all()
        assert (curves["width_prob"] < curves["width_prob_high"]).all()
        assert list(curves["model"].values) == ["line", "plane"]
        assert curves.attrs["ci_prob"] == 0.95

    def test_what_is_not_known_is_missing_with_its_reason(self):
        curves = curves_of({"line": Rival(2, 1), "plane": Rival(3, 2)}, widths=[0.05, 1, 2])
        assert curves["width_n_effective"].sel(width=0.05, model="plane") < 100
        missing = curves.sel(width=0.05, model="plane")
        assert missing["width_log_evidence"].isnull()
        assert missing["width_se"].isnull()
        assert curves["width_prob"].sel(width=0.05).isnull().all()
        assert curves["width_prob"].sel(width=[1, 2]).notnull().all()

    def test_only_the_variables_named(self):
        """Where a model has none of them its evidence does not change."""
        rivals = {"line": Rival(2, 1), "plane": Rival(3, 2)}
        with pm.Model() as renamed:
            pm.Normal("v", 0, 2, shape=3)
        rivals["plane"].model = renamed
        rivals["plane"].idata["posterior"] = (
            rivals["plane"].idata["posterior"].to_dataset().rename(w="v")
        )
        curves = curves_of(rivals, widths=[0.5, 2], var_names="w")
        both = curves_of(rivals, widths=[0.5, 2])
        line, plane = (curves["width_log_evidence"].sel(model=name) for name in rivals)
        np.testing.assert_allclose(line, both["width_log_evidence"].sel(model="line"))
        np.testing.assert_allclose(plane, rivals["plane"].target.log_evidence)

    def test_an_unknown_error_stays_unknown(self):
        rivals = {"line": Rival(2, 1), "plane": Rival(3, 2, se=math.nan)}
        curves = curves_of(rivals, widths=[0.5, 2])
        assert curves["width_se"].sel(model="plane").isnull().all()
        assert curves["width_log_evidence"].notnull().all()
        assert curves["width_prob"].notnull().all()
        assert curves["width_prob_low"].isnull().all()

    def test_default_widths_run_from_a_quarter_to_four(self):
        widths = curves_of({"line": Rival(2, 1)})["width"].values
        np.testing.assert_allclose(widths[[0, 8, -1]], [0.25, 1, 4])


class TestWhatIsRefused:
    @pytest.mark.parametrize("given", [[], 3, [[1, 2]], [1, math.nan], "abc", [1, "x"]])
    def test_widths_that_are_no_list_of_numbers(self, given):
        with pytest.raises(ModelError, match="widths must be one-dimensional finite numbers"):
            curves_of({"line": Rival(2, 1)}, widths=given)

    def test_widths_that_are_not_positive(self):
        with pytest.raises(ModelError, match=r"widths must be positive, got \[0, 1\]"):
            curves_of({"line": Rival(2, 1)}, widths=[0, 1])

    def test_widths_without_draws(self):
        models = {"small": pm.Model(), "large": pm.Model()}
        with pytest.raises(ModelError, match=r"evidences must be DataTrees .* got none of \['"):
            prior_sensitivity(RIVALS, models=models)

    def test_models_of_other_names(self):
        rival = Rival(2, 1)
        with pytest.raises(ModelError, match=r"models must map exactly .*\['line'\] to pm.Model"):
            prior_sensitivity({"line": rival.idata}, models={"lime": rival.model})
        with pytest.raises(ModelError, match=r"models must map exactly the names"):
            prior_sensitivity({"line": rival.idata}, models={"line": 3})

    def test_unknown_variables(self):
        with pytest.raises(ModelError, match=r"var_names must be free variables .*got \['v'\]"):
            curves_of({"line": Rival(2, 1)}, var_names=["w", "v"])

    def test_a_model_of_other_draws(self):
        line, plane = Rival(2, 1), Rival(3, 2)
        with pytest.raises(
            DataMismatchError, match=r"'w' in idata must have the model's shape \(3,\)"
        ):
            prior_sensitivity({"line": line.idata}, models={"line": plane.model})


class Undetermined:
    """Draws of w, which the data determine, and of k, uniform from 0 to 1."""

    def __init__(self, log_evidence, upper):
        rng = np.random.default_rng(1)
        with pm.Model() as self.model:
            pm.Normal("w", 0, 2)
            pm.Uniform("k", 0, upper)
        draws = {"w": rng.normal(0.5, 0.2, SHAPE), "k": rng.uniform(0, 1, SHAPE)}
        self.idata = az.from_dict({"posterior": draws})
        store_evidence(self.idata, evidence(log_evidence), {})


@pytest.fixture(scope="module")
def rivals():
    return {"tight": Undetermined(-8, upper=1), "loose": Undetermined(-9, upper=9)}


class TestPriorsThatSpoilTheCurves:
    """In one model k fills its prior; in the other its prior is wide enough."""

    WIDTHS = (0.5, 1, 2)

    def test_one_is_left_out_of_all_models_and_named(self, rivals):
        with pytest.warns(EvidenceWarning) as caught:
            curves = curves_of(rivals, widths=self.WIDTHS)
        assert len(caught) == 1
        assert caught[0].filename == __file__
        assert (
            str(caught[0].message)
            == curves.attrs["width_note"]
            == (
                "The prior of k keeps its width: in 'tight' the posterior reaches the end of the "
                "support, and no draws lie beyond it."
            )
        )
        assert curves.attrs["width_left_out"] == "k"
        assert curves.attrs["width_unknown"] == ""
        assert curves.attrs["ci_prob"] == 0.95
        of_w = curves_of(rivals, widths=self.WIDTHS, var_names="w")
        assert of_w["width_prob"].notnull().all()
        assert of_w.attrs["width_note"] == ""
        xr.testing.assert_equal(curves, of_w)

    def test_one_that_is_asked_for_is_named_and_not_left_out(self, rivals):
        for names in ("k", ["w", "k"]):
            curves = curves_of(rivals, widths=self.WIDTHS, var_names=names)
            assert curves["width_prob"].sel(width=slice(1.01, None)).isnull().all()
            assert curves.attrs["width_left_out"] == ""
            assert curves.attrs["width_unknown"] == "k"
            assert curves.attrs["width_note"].startswith(
                "The prior of k leaves most widths unknown"
            )

    def test_priors_that_are_too_many_together(self):
        """Each alone is known at half the width, all together are not."""
        rng = np.random.default_rng(2)
        with pm.Model() as model:
            for i in range(6):
                pm.Normal(f"x{i}", 0, 1)
        draws = {f"x{i}": rng.normal(1.2, 0.6, SHAPE) for i in range(6)}
        idata = az.from_dict({"posterior": draws})
        store_evidence(idata, evidence(-8), {})
        curves = prior_sensitivity({"a": idata}, models={"a": model}, widths=[0.5, 1])
        assert curves["width_prob"].sel(width=0.5).isnull().all()
        assert curves.attrs["width_unknown"] == "several parameters of 'a' together"
        assert "name fewer of them in var_names" in curves.attrs["width_note"]
