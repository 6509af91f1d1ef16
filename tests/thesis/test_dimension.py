"""The correction for the number of parameters, as a prior over models."""

import math
from importlib import import_module

import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.evidence import Evidence


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
