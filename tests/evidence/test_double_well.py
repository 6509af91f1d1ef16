"""A double well: the evidence from pseudo-marginal chains against quadrature over a grid filter."""

import pytest

import pymc_statespace_filters as psf
from tests.evidence import double_well

ESTIMATORS = ["chib_jeliazkov", "bridge", "importance"]
# What `suggest_particles` suggests: a log-likelihood of variance two, between 1 and 3.3.
N_PARTICLES = 50


def test_the_quadrature_has_converged():
    """Of 19 points a side; with 25 the error is a millionth."""
    assert double_well.log_evidence(19) == pytest.approx(double_well.LOG_EVIDENCE, abs=1e-4)


@pytest.mark.slow
def test_the_truth_again():
    assert double_well.log_evidence(49) == pytest.approx(double_well.LOG_EVIDENCE, abs=1e-6)


@pytest.mark.slow
def test_pseudo_marginal_chains_are_within_a_tenth_of_a_nat():
    """Errors are normal: four of them are too few once in 16 000 times."""
    model, quiet = double_well.model(psf.BootstrapPF(N_PARTICLES)), {"progressbar": False}
    idata = psf.sample_dram(20_000, tune=1000, chains=4, model=model, random_seed=2, **quiet)
    found = psf.estimate_evidence(
        idata, model, estimators=ESTIMATORS, target_se=0.1, random_seed=3, **quiet
    )
    for evidence in found.values():
        error = abs(evidence.log_evidence - double_well.LOG_EVIDENCE)
        assert error < 4 * evidence.se
        assert error < 0.1
    assert found.agreement


@pytest.mark.slow
def test_the_number_of_particles_is_the_one_suggested():
    model = double_well.model(psf.BootstrapPF(N_PARTICLES))
    assert psf.suggest_particles(model, random_seed=1).loc["d", "n_particles"] == N_PARTICLES
