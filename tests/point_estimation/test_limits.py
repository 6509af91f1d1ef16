"""Parameters without a standard error: at a bound, on a staircase, hidden by noise."""

import numpy as np
import pymc as pm
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.point_estimation.estimate import Peak
from pymc_statespace_filters.point_estimation.maximum_likelihood import errors_of
from pymc_statespace_filters.point_estimation.noisy import maximize_estimated
from pymc_statespace_filters.sampling.starts.annealing import Population

YEARS = np.arange(40)


def test_the_year_of_a_switch_has_an_interval_and_the_others_their_errors():
    """A mean before and one after: the year is known, and the errors are those of two means."""
    data = np.where(YEARS < 17, 0.0, 2.0) + 0.5 * np.random.default_rng(1).standard_normal(40)
    with pm.Model():
        year = pm.Uniform("year", 0, 40)
        low, high = pm.Normal("low", 0, 5), pm.Normal("high", 0, 5)
        pm.Normal("d", pm.math.switch(YEARS < year, low, high), 0.5, observed=data)
        found = psf.maximum_likelihood(random_seed=1)
    split = int(np.ceil(found.estimate["year"]))
    exact = [
        -0.5 * (np.var(data[:s]) * s + np.var(data[s:]) * (40 - s)) / 0.25 for s in range(1, 40)
    ]
    assert split == 1 + int(np.argmax(exact))
    assert found.estimate["year"] == pytest.approx(split - 0.5, abs=0.05)
    assert found.estimate["low"] == pytest.approx(data[:split].mean(), abs=1e-5)
    assert found.standard_errors["low"] == pytest.approx(0.5 / np.sqrt(split), rel=1e-3)
    assert np.isnan(found.standard_errors["year"])
    assert "staircase" in found.reasons["year"]
    low_end, high_end = (
        float(found.reasons["year"].split(word)[1].split()[0].rstrip(","))
        for word in ("from", " to ")
    )
    assert low_end <= found.estimate["year"] <= high_end
    assert high_end - low_end < 4.0


def test_a_curvature_at_a_bound_is_no_standard_error():
    """On a log scale the likelihood may curve at 4e-9 of a spread of 0.1: the bound is zero."""
    peak = Peak(
        np.array([np.log(4e-9), 0.5]), -10.0, 0.0, np.diag([10.0, 0.1]), (), -np.eye(2),
        np.zeros((2, 2)), (),
    )  # fmt: skip
    population = np.random.default_rng(1).normal([-2.5, 0.5], [0.5, 0.1], (200, 2))
    errors = errors_of(
        lambda x: {"scale": np.exp(x[0]), "mean": x[1]}, peak, population, ["scale", "mean"]
    )
    assert list(errors.reasons) == ["scale"]
    assert "at a bound of its support" in errors.reasons["scale"]
    assert np.isnan(errors.covariance[0]).all()
    assert errors.covariance[1, 1] == pytest.approx(0.01)


def test_a_maximum_that_the_noise_hides_is_not_reported_as_found():
    """The second parameter has a curvature of 0.05 under noise of 1.5 nats, the first one of 100.

    What is reported lies within its errors of the maximum at 0.3.
    """
    curvature, reported = np.array([100.0, 0.05]), []
    for seed in range(8):
        rng = np.random.default_rng(seed)

        def estimated(x, rng=rng):
            exact = -0.5 * (curvature * (x - 0.3) ** 2).sum(axis=1)
            return exact + 1.5 * rng.standard_normal(len(x)) - 1.125

        x = 0.3 + rng.standard_normal((256, 2)) / np.sqrt(curvature + 1)
        peak = maximize_estimated(estimated, Population(x, np.zeros(256), estimated(x)), rng)
        errors = errors_of(lambda x: {"x": x}, peak, x, ["a", "b"])
        assert bool(peak.lost) == any("the maximum was not found" in note for note in peak.notes)
        reported += [((peak.point - 0.3) / errors.simulation)[np.isfinite(errors.simulation)]]
    scores = np.concatenate(reported)
    assert len(scores) >= 6
    assert (np.abs(scores) > 3.0).sum() <= 1  # the errors are those of a quadratic
