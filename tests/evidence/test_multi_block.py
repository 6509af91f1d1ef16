"""The ordinate in blocks on posteriors known in closed form, and the ways of being subtly wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import comb

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.evidence.estimators import block_ordinates as multi_block
from pymc_statespace_filters.evidence.estimators.block_ordinates import estimate_in_blocks
from pymc_statespace_filters.evidence.estimators.chib_jeliazkov import ChibJeliazkov
from pymc_statespace_filters.evidence.estimators.random_walk_proposal import Proposal, plan_proposal
from pymc_statespace_filters.evidence.posterior import Posterior
from tests.evidence.analytic import autoregressive, gaussian, pilot
from tests.evidence.estimator_contract import EstimatorContract
from tests.evidence.targets import Banana, TwoModes

LOG_EVIDENCE = -3.7  # of `gaussian`


class TestChibJeliazkovInBlocks(EstimatorContract):
    estimator, of_few = ChibJeliazkov(4000, 2), ChibJeliazkov(1000, 2)
    most = 0.2


def estimate(posterior, n_blocks, rng, *, n_proposals=4000):
    return ChibJeliazkov(n_proposals, n_blocks).estimate(posterior, rng=rng)


def agrees(found, truth, *, se):
    """Within four standard errors, which fails once in 16 000; seeds are fixed."""
    assert found.se < se
    assert abs(found.log_evidence - truth) < 4 * found.se
    return True


@pytest.mark.parametrize("n_blocks", [2, 6])
def test_evidence_of_a_banana_in_twelve_dimensions(n_blocks):
    rng = np.random.default_rng(21)
    posterior = Banana(12).posterior((4, 2500), rng, correlation=0.5)
    assert agrees(estimate(posterior, n_blocks, rng), Banana(12).log_evidence, se=0.2)


def test_evidence_of_two_modes():
    rng = np.random.default_rng(22)
    posterior = TwoModes(3).posterior((4, 2500), rng)
    assert agrees(estimate(posterior, 3, rng), TwoModes(3).log_evidence, se=0.2)


@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_the_error_is_that_of_terms_known_in_closed_form(correlation):
    """Two blocks of a standard normal posterior: every term is exp(-y^2 / 2) of a normal y.

    If two such y have the correlation r, their terms have the relative covariance
    2 / sqrt(4 - r^2) - 1, a power series in r^2. Draws have r = rho^lag; walkers, which here accept
    all moves, the product of the cosines of their angles.
    """
    m = np.arange(1, 40)
    central = comb(2 * m, m)

    def variance(mean_power):
        """Of the mean of n terms, times n; given the mean of r^(2 m) one step apart."""
        return (central / 16.0**m * (1 + mean_power) / (1 - mean_power)).sum()

    draws, walkers = variance(correlation ** (2 * m)), variance(central / 4.0**m)
    independent = variance(0.0)
    n_draws, squares = 4096, []
    for run in range(20):
        rng = np.random.default_rng([39, run])
        y = autoregressive((4, n_draws // 4, 2), correlation, rng)
        posterior = Posterior(
            y, -0.5 * (y**2).sum(axis=-1), lambda x, rng: -0.5 * (x**2).sum(axis=-1)
        )
        proposal = Proposal(np.zeros(2), 0.0, np.eye(2))
        found = estimate_in_blocks(proposal, posterior, n_blocks=2, n_proposals=n_draws, rng=rng)
        squares.append(found.se**2)
    # Numerator; numerator and denominator of the reduced run; denominator of the last.
    exact = draws + (walkers + independent) + independent
    # The mean of twenty has an error of three per cent.
    assert np.mean(squares) * n_draws == pytest.approx(exact, rel=0.1)


class TestNoisyLikelihood:
    """Log-noise of standard deviation 1.2, as in a particle filter tuned as it should be."""

    def posterior(self, rng):
        return gaussian(4, (4, 5000), rng, noise_sd=1.2)

    @pytest.mark.parametrize("shift", [-1.0, 1.0])
    def test_the_constant_at_the_centre_does_not_matter(self, shift):
        rng = np.random.default_rng(25)
        posterior = self.posterior(rng)
        proposal = plan_proposal(
            posterior, pilot(posterior), n_proposals=1000, most=1000, rng=rng
        ).proposal
        shifted = replace(proposal, log_density=proposal.log_density + shift)
        found = estimate_in_blocks(shifted, posterior, n_blocks=2, n_proposals=4000, rng=rng)
        assert agrees(found, LOG_EVIDENCE, se=0.08)

    def test_walkers_keep_their_estimates(self):
        """Estimates that a chain accepted are larger than fresh ones, by the variance of both."""
        rng = np.random.default_rng(26)
        starts = np.zeros((64, 2))

        def target(y):
            return -0.5 * (y**2).sum(axis=1) + rng.normal(-0.72, 1.2, len(y))

        run = multi_block._walk(
            target, starts, target(starts), np.zeros(2), slice(0, 2), 20_000, rng
        )
        noise = run.log_density + 0.5 * (run.y**2).sum(axis=-1)
        assert abs(noise.mean() - 0.72) < 0.06
        assert abs(noise.std() - 1.2) < 0.06


class TestWalkers:
    def test_draw_from_the_conditional_posterior(self):
        """N(0, 1) bent by its square, and a fixed coordinate: means of the free ones are known."""
        rng = np.random.default_rng(27)

        def target(y):
            bent = y[:, 2] - 0.5 * (y[:, 1] ** 2 - 1) - y[:, 0]
            return -0.5 * (y[:, 1] ** 2 + bent**2)

        starts = np.full((64, 3), 0.5)
        run = multi_block._walk(
            target, starts, target(starts), np.zeros(3), slice(1, 3), 64_000, rng
        )
        assert (run.y[..., 0] == 0.5).all()
        # 64 independent chains: their spread gives the error of the mean.
        for values, truth in (
            (run.y[..., 1], 0.0),
            (run.y[..., 1] ** 2, 1.0),
            (run.y[..., 2], 0.5),
            ((run.y[..., 2] - 0.5) ** 2, 1.5),
        ):
            means = values.mean(axis=1)
            assert abs(means.mean() - truth) < 4 * means.std() / 8 < 0.2

    def test_forget_where_they_started(self):
        """All moves under N(0, 1) are accepted, and thirty of them leave nothing of a start."""
        rng = np.random.default_rng(37)

        def target(y):
            return -0.5 * (y**2).sum(axis=1)

        starts = np.full((64, 1), 20.0)
        run = multi_block._walk(target, starts, target(starts), np.zeros(1), slice(0, 1), 640, rng)
        assert run.n_moves == multi_block.N_WARMUP + 10
        assert abs(run.y.mean()) < 0.3  # its error is 0.08

    def test_start_with_the_estimates_of_their_places(self, monkeypatch):
        rng = np.random.default_rng(38)
        posterior = gaussian(4, (4, 500), rng)
        walk, started = multi_block._walk, []

        def checked(target, y, log_density, *rest):
            np.testing.assert_allclose(log_density, target(y), rtol=1e-12)
            started.append(len(y))
            return walk(target, y, log_density, *rest)

        monkeypatch.setattr(multi_block, "_walk", checked)
        estimate(posterior, 3, rng, n_proposals=500)
        assert started == [multi_block.N_WALKERS] * 4

    def test_never_stand_where_there_is_no_density(self):
        rng = np.random.default_rng(28)
        starts = np.full((64, 1), 0.5)

        def target(y):
            return np.where(y[:, 0] > 0, 0.0, -np.inf)

        run = multi_block._walk(target, starts, target(starts), np.zeros(1), slice(0, 1), 640, rng)
        assert (run.y > 0).all()
        assert 0.1 < run.n_moves / (multi_block.N_WARMUP + 10) < 0.9


class TestNumberOfBlocks:
    def chosen(self, k, n_draws, correlation):
        rng = np.random.default_rng(31)
        posterior = gaussian(k, (4, n_draws), rng, correlation=correlation)
        return ChibJeliazkov().estimate(posterior, rng=rng).settings["n_blocks"]

    def test_one_below_ten_parameters(self):
        assert self.chosen(9, 100, 0.9) == 1

    def test_one_where_its_error_is_small(self):
        assert self.chosen(12, 5000, 0.0) == 1

    def test_several_where_its_error_would_be_large(self):
        assert self.chosen(20, 500, 0.8) == 2
        assert self.chosen(31, 500, 0.8) == 4

    def test_must_not_exceed_the_parameters(self):
        rng = np.random.default_rng(32)
        with pytest.raises(ModelError, match="at most the number of parameters, 2, got 3"):
            ChibJeliazkov(n_blocks=3).estimate(gaussian(2, (4, 100), rng), rng=rng)

    def test_the_evaluations_are_foreseen(self):
        rng = np.random.default_rng(33)
        posterior = gaussian(4, (4, 2000), rng)
        counts = []

        def evaluate(x, rng):
            counts.append(len(x))
            return posterior.evaluate(x, rng)

        estimator = ChibJeliazkov(4000, 3)
        estimator.estimate(replace(posterior, evaluate=evaluate), rng=rng)
        assert abs(sum(counts) / estimator.n_evaluations(posterior) - 1) < 0.4


def test_walkers_that_hardly_move_are_a_doubt():
    rng = np.random.default_rng(35)
    found = estimate(gaussian(4, (4, 2000), rng, noise_sd=4.0), 2, rng, n_proposals=1000)
    assert found.settings["n_moves"] < 10
    assert any("moved" in doubt and "raise n_proposals" in doubt for doubt in found.doubts)


def test_no_density_at_the_centre_of_a_block():
    rng = np.random.default_rng(36)
    posterior = gaussian(2, (4, 500), rng)
    proposal = plan_proposal(
        posterior, pilot(posterior), n_proposals=500, most=500, rng=rng
    ).proposal
    nowhere = replace(posterior, evaluate=lambda x, rng: np.full(len(x), -np.inf))
    with pytest.raises(DataMismatchError, match="n_blocks=1"):
        estimate_in_blocks(proposal, nowhere, n_blocks=2, n_proposals=500, rng=rng)
