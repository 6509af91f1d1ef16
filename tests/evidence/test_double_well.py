"""A double well: the evidence from pseudo-marginal chains against quadrature over a grid filter."""

import pytest

import pymc_statespace_filters as psf
from tests.evidence import double_well

ESTIMATORS = ["chib_jeliazkov", "bridge", "importance"]
# What `suggest_particles` suggests: a log-likelihood of variance two, between 1 and 3.3.
N_PARTICLES = 50


def estimates(n_draws, estimators):
    model = double_well.model(psf.BootstrapPF(N_PARTICLES))
    idata = psf.sample_dram(
        n_draws, tune=1000, chains=4, model=model, random_seed=2, progressbar=False
    )
    return psf.estimate_evidence(
        idata, model, estimators=estimators, target_se=0.1, random_seed=3, progressbar=False
    )


def agree_with_the_truth(found, largest_error):
    """Errors are normal: four of them are too few once in 16 000 times."""
    for evidence in found.values():
        error = abs(evidence.log_evidence - double_well.LOG_EVIDENCE)
        assert error < 4 * evidence.se
        assert error < largest_error
    assert found.agreement


def test_the_quadrature_has_converged():
    """Of 19 points a side; with 25 the error is a millionth."""
    assert double_well.log_evidence(19) == pytest.approx(double_well.LOG_EVIDENCE, abs=1e-4)


@pytest.mark.slow
def test_the_truth_again():
    assert double_well.log_evidence(49) == pytest.approx(double_well.LOG_EVIDENCE, abs=1e-6)


@pytest.mark.filterwarnings("ignore:log-evidence .* the chains disagree")
def test_short_pseudo_marginal_chains():
    agree_with_the_truth(estimates(1500, ESTIMATORS[:2]), 0.15)


@pytest.mark.slow
def test_pseudo_marginal_chains_are_within_a_tenth_of_a_nat():
    agree_with_the_truth(estimates(20_000, ESTIMATORS), 0.1)


@pytest.mark.slow
def test_the_number_of_particles_is_the_one_suggested():
    model = double_well.model(psf.BootstrapPF(N_PARTICLES))
    assert psf.suggest_particles(model, random_seed=1).loc["d", "n_particles"] == N_PARTICLES
