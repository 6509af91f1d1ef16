"""EnKF against the same equations in NumPy, and against the exact likelihood."""

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from pymc_statespace_filters.filters import BootstrapPF, EnKF, PFEnKF
from pymc_statespace_filters.filters.outcomes import NONE, SINGULAR
from tests.filters.ensemble_contract import (
    LINE,
    OSCILLATOR,
    EnsembleFilterContract,
    forecasts,
    kalman,
    log_gaussian,
    run,
)
from tests.references.records import DOUBLE_WELL, double_well
from tests.systems import DOUBLE_WELL_SYSTEM, double_well_parameters, linear_system, log_likelihoods


class TestEnsembleLikelihood(EnsembleFilterContract):
    @pytest.fixture
    def filter_(self):
        return EnKF(200)


class TestGaussianLikelihood(EnsembleFilterContract):
    known_start_tolerance = 0.3  # the mean and variance of 200 simulated observations

    @pytest.fixture
    def filter_(self):
        return EnKF(200, likelihood="gaussian")


def numpy_enkf(system, steps, observed, n_members, seed, likelihood, free=slice(None)):
    """Eqs. 4.15-4.26, observed components only, in NumPy."""
    H, R = system.C, system.R
    X, terms = None, []
    for (start, advance, noise), d in zip(
        forecasts(system, n_members, steps, seed), observed, strict=True
    ):
        X = advance(start if X is None else X)
        seen = ~np.isnan(d)
        if not seen.any():
            terms.append(0.0)
            continue
        D = (H @ X + noise)[seen]
        covariance = np.cov(np.concatenate([X, D]))
        n = len(X)
        P_xd, P_dd = covariance[:n, n:], covariance[n:, n:]
        if likelihood == "gaussian":
            terms.append(multivariate_normal(D.mean(axis=1), P_dd).logpdf(d[seen]))
        else:
            log_p = log_gaussian((d[:, None] - H @ X)[seen], np.diag(R)[seen])
            terms.append(logsumexp(log_p) - np.log(n_members))
        nudge = P_xd @ np.linalg.solve(P_dd, d[seen][:, None] - D)
        X[free] += nudge[free]
    return np.array(terms)


@pytest.mark.parametrize("likelihood", ["ensemble", "gaussian"])
def test_is_its_equations_written_in_numpy(likelihood):
    filter_ = EnKF(200, likelihood=likelihood)
    for seed in range(3):
        expected = numpy_enkf(*OSCILLATOR, 200, seed, likelihood)
        terms, health = run(filter_, *OSCILLATOR, seed=seed)
        assert terms == pytest.approx(expected, rel=1e-10)
        assert health[1:].tolist() == [0, -1]
        # The mean of p(d | x_i) rests on fewer members than are alive, the Gaussian fit on all.
        assert (health[0] == 200) if likelihood == "gaussian" else (1 < health[0] < 200)


@pytest.mark.parametrize("likelihood", ["ensemble", "gaussian"])
def test_approaches_kalman(likelihood):
    exact = kalman(*LINE).sum()
    filter_ = EnKF(4000, likelihood=likelihood)
    errors = np.array([run(filter_, *LINE, seed=s)[0].sum() - exact for s in range(60)])
    # The bias is O(1/N), some 0.01; the mean of 60 errors has this standard error; 4 of them
    assert abs(errors.mean()) < 0.02 + 4 * errors.std() / np.sqrt(60)
    assert errors.std() < 0.2


def test_bias_where_equations_bend_is_that_of_the_algorithm():
    """Of filters written in NumPy for this record, with its standard error; 4 of these and ours."""
    record, bias, bias_se = double_well(), -6.02, 0.09
    exact = DOUBLE_WELL.point_mass_filter().run(*record).terms.sum()
    arguments = EnKF(1000), double_well_parameters(DOUBLE_WELL), np.arange(100)
    errors = log_likelihoods(DOUBLE_WELL_SYSTEM, *arguments, **record._asdict()) - exact
    assert abs(errors.mean() - bias) < 4 * np.hypot(errors.std() / 10, bias_se)


def test_carried_states_are_not_updated():
    system, steps, observed = OSCILLATOR
    carried = linear_system(system, carried=("x0",))
    expected = numpy_enkf(*OSCILLATOR, 200, 0, "ensemble", free=[1])
    terms, _ = run(EnKF(200), carried, steps, observed)
    assert terms == pytest.approx(expected, rel=1e-10)


def test_settings_are_frozen_comparable_and_normalised():
    assert EnKF(np.int64(10)) == EnKF(10)
    assert hash(EnKF(np.int64(10))) == hash(EnKF(10))
    assert type(EnKF(np.int64(10)).n_members) is int
    assert EnKF(10) != EnKF(10, likelihood="gaussian")
    with pytest.raises(AttributeError):
        EnKF(10).n_members = 3
    with pytest.raises(TypeError):
        EnKF(10, "gaussian")
    assert EnKF.noisy
    assert not EnKF.unbiased
    assert not PFEnKF.unbiased
    assert BootstrapPF.unbiased


@pytest.mark.parametrize("n_members", [2, 3])
def test_tiny_ensembles_give_numbers_or_a_counted_failure(n_members):
    terms, health = run(EnKF(n_members), *OSCILLATOR)
    assert not np.isnan(terms).any()
    assert health[1] in (NONE, SINGULAR)
    if n_members == 2:  # two members span one direction of two observables
        assert health[1:].tolist() == [SINGULAR, 0]
