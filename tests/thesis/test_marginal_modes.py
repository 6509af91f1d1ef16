"""Modes of marginal densities that are known, and the table in which they come."""

import math
from importlib import import_module

import arviz as az
import numpy as np
import pandas as pd
import pytest
from scipy.stats import gamma, norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.evidence import Evidence

# Quantiles stand for independent draws.
LEVELS = np.random.default_rng(1).permutation((np.arange(4000) + 0.5) / 4000).reshape(4, 1000)


def marginal_modes(*arguments, **keywords):
    return import_module("marginal_modes").marginal_modes(*arguments, **keywords)


def idata(**posterior):
    return az.from_dict({"posterior": posterior})


@pytest.mark.parametrize(
    ("law", "mode"),
    [
        (norm(3, 2), 3.0),
        (norm(-1e6, 1e-3), -1e6),
        (gamma(5, scale=2), 8.0),  # mean 10, median 9.3
        (gamma(1), 0.0),  # at the end of its support
    ],
)
def test_of_known_laws(law, mode):
    found = marginal_modes(idata(x=law.ppf(LEVELS))).loc["posterior", "x"]
    assert abs(found - mode) < 0.1 * law.std()


def test_the_higher_of_two_peaks_even_if_the_lower_is_wider():
    x = np.where(
        LEVELS < 0.4, norm(-3, 0.2).ppf(LEVELS / 0.4), norm(3, 1).ppf(LEVELS / 0.6 - 2 / 3)
    )
    assert marginal_modes(idata(x=x)).loc["posterior", "x"] == pytest.approx(-3, abs=0.1)


def test_chains_that_stand_still():
    """Metropolis repeats itself: 60 times two chains, root mean square 0.15 of a deviation.

    It is 0.22 with the bandwidth for as many draws as there are, and a right implementation is
    above 0.19 once in some 1000 seeds.
    """
    rng = np.random.default_rng(1)
    steps, levels = 3 * rng.standard_normal((4000, 120)), np.log(rng.random((4000, 120)))
    x = np.empty((4000, 120))
    now = np.zeros(120)
    for i in range(4000):
        move = now + steps[i]
        now = np.where(levels[i] < (now**2 - move**2) / 2, move, now)
        x[i] = now
    modes = marginal_modes(idata(x=x.T.reshape(2, 60, 4000).swapaxes(1, 2)))
    assert 0.05 < np.sqrt((modes.loc["posterior"] ** 2).mean()) < 0.19


def test_short_chains():
    assert 1 <= marginal_modes(idata(x=np.array([[1.0, 2.0, 2.1]]))).loc["posterior", "x"] <= 2.1


def test_one_row_a_model_one_column_a_parameter():
    a = norm(4, 0.1).ppf(LEVELS)
    b = norm(-4, 0.1).ppf(LEVELS)
    table = marginal_modes({"linear": idata(alpha=a), "cubic": idata(beta=b, alpha=a + 1)})
    assert list(table.index) == ["linear", "cubic"]
    assert table.index.name == "model"
    assert list(table.columns) == ["alpha", "beta"]
    expected = pd.DataFrame({"alpha": [4, 5], "beta": [np.nan, -4]}, index=table.index)
    np.testing.assert_allclose(table, expected, atol=0.01)


def test_vectors_are_labelled_as_arviz_labels_them():
    draws = norm(0, 1).ppf(LEVELS)[..., None] + [10.0, 20.0]
    named = az.from_dict(
        {"posterior": {"k": draws, "theta": draws}},
        coords={"school": ["north", "south"]},
        dims={"theta": ["school"]},
    )
    table = marginal_modes(named)
    assert list(table.columns) == ["k[0]", "k[1]", "theta[north]", "theta[south]"]
    assert list(table.columns) == list(az.summary(named).index)
    np.testing.assert_allclose(table.loc["posterior"], [10, 20, 10, 20], atol=0.1)


def test_var_names():
    both = {"m1": idata(a=LEVELS, b=LEVELS), "m2": idata(a=LEVELS, c=LEVELS)}
    assert list(marginal_modes(both, var_names="b").columns) == ["b"]
    assert set(marginal_modes(both, var_names=["c", "a"]).columns) == {"a", "c"}
    with pytest.raises(
        ModelError, match=r"var_names must be among \['a', 'b', 'c'\], .*got \['d'\]"
    ):
        marginal_modes(both, var_names=["a", "d"])


def test_a_constant_is_its_own_mode():
    assert marginal_modes(idata(x=np.full((2, 50), 0.3))).loc["posterior", "x"] == 0.3


def test_draws_that_are_not_finite_have_no_mode():
    draws = np.where(LEVELS < 0.1, np.nan, LEVELS)
    found = marginal_modes(idata(x=draws, y=np.full((2, 50), np.inf), z=LEVELS)).loc["posterior"]
    assert found.isna().to_dict() == {"x": True, "y": True, "z": False}


# The correction for the number of parameters, as a prior over models.


def evidence(log_evidence, k, observations=21):
    return Evidence(log_evidence, 0.05, "bridge", k, observations, -5.0, "same")


def dimension_prior(*arguments):
    return import_module("dimension").dimension_prior(*arguments)


def test_the_factor_has_the_number_of_observations_of_the_record():
    """J = 21: the factor between models of 3 and 4 parameters is 21^1.5 = 96.23, not 101^1.5."""
    rivals = {"m2": evidence(-8, k=3), "m3": evidence(-6, k=4)}
    table = psf.compare_evidence(rivals, model_prior=dimension_prior(rivals, 3.0))
    odds = table.loc["m3", "prob"] / table.loc["m2", "prob"]
    assert odds == pytest.approx(math.exp(2) / 96.2341, rel=1e-5)
    assert list(table.index) == ["m2", "m3"]


def test_the_weights_of_long_records_do_not_underflow():
    rivals = {"a": evidence(-8, 100, 10**6), "b": evidence(-8, 101, 10**6)}
    weights = dimension_prior(rivals, 3.0)
    assert weights == {"a": 1.0, "b": pytest.approx(1e-9)}
