"""Estimators that stop at a stated standard error, and evaluations that several of them share."""

from dataclasses import replace

import numpy as np
import pytest

import pymc_statespace_filters as psf
from pymc_statespace_filters.errors import EvidenceWarning
from pymc_statespace_filters.evidence.estimators.bridge import Bridge
from pymc_statespace_filters.evidence.estimators.chib_jeliazkov import ChibJeliazkov
from pymc_statespace_filters.evidence.estimators.importance import Importance
from pymc_statespace_filters.evidence.estimators.stopping import FEWEST, MOST, shortfall
from pymc_statespace_filters.evidence.estimators.whitening import BLOCK, normal_proposals
from tests.evidence.analytic import gaussian
from tests.evidence.calibration import EACH_NUMBER_OF_RUNS, check_scores
from tests.evidence.targets import Regression
from tests.evidence.test_models import REGRESSION, exact_draws

LOG_EVIDENCE = -3.7  # of `gaussian`
WITH_TARGET = {
    "chib_jeliazkov": ChibJeliazkov,
    "bridge": Bridge,
    "importance": Importance,
}
EACH = pytest.mark.parametrize("make", WITH_TARGET.values(), ids=WITH_TARGET)


def counted(posterior):
    """The posterior, and the batches that are evaluated."""
    batches = []

    def evaluate(x, rng):
        batches.append(x)
        return posterior.evaluate(x, rng)

    return replace(posterior, evaluate=evaluate, shared_seed=posterior.shared_seed), batches


@EACH
def test_no_more_evaluations_than_the_error_needs(make):
    rng = np.random.default_rng(100)
    posterior = gaussian(2, (4, 1000), rng, noise_sd=1.0)
    numbers, target = [], 0.1
    for _ in range(2):
        watched, batches = counted(posterior)
        found = make(target_se=target).estimate(watched, rng=rng)
        assert found.se <= target
        assert not found.shortfall
        assert abs(found.log_evidence - LOG_EVIDENCE) < 4 * found.se
        numbers.append(sum(map(len, batches)))
        target = found.se / 1.5
    assert numbers[0] <= 3 * FEWEST  # with a plan
    assert numbers[1] > 1.4 * numbers[0]


# The number of evaluations is decided by the error in most of the replications.
@EACH_NUMBER_OF_RUNS
@pytest.mark.parametrize(
    ("make", "noise_sd", "target_se"),
    [
        pytest.param(ChibJeliazkov, 1.0, 0.025, marks=pytest.mark.slow),
        (Importance, 1.0, 0.03),
        pytest.param(Bridge, 1.0, 0.0135, marks=pytest.mark.slow),
        pytest.param(Importance, 1.4, 0.05, marks=pytest.mark.slow),
    ],
)
def test_stopping_at_an_estimated_error_leaves_it_right(make, noise_sd, target_se, n_runs):
    scores, numbers = [], []
    for run in range(n_runs):
        rng = np.random.default_rng([102, run])
        posterior = gaussian(2, (4, 1000), rng, noise_sd=noise_sd)
        found = make(target_se=target_se).estimate(posterior, rng=rng)
        scores.append((found.log_evidence - LOG_EVIDENCE) / found.se)
        numbers.append(found.settings["n_proposals"])
    assert np.mean(np.array(numbers) > FEWEST) > 0.5
    check_scores(scores)


class TestShortfall:
    def test_by_hand(self):
        # The draws' error alone is to be 0.05 / sqrt(1.25), the evaluations' half as large.
        text = shortfall(0.05, 0.08, 0.04, 1000, "a remedy")
        assert text == "0.08 nats come from the draws: about 3200 instead of 1000 would do"
        text = shortfall(0.05, 0.03, 0.06, 1000, "a remedy")
        assert text == "0.06 nats come from the evaluations: a remedy"
        # So many draws would do if the evaluations' error were half as large.
        text = shortfall(0.05, 0.041, 0.04, 1000, "a remedy")
        assert text == "0.04 nats come from the evaluations: a remedy"
        assert shortfall(0.05, 0.03, 0.03, 1000, "a remedy") == ""
        assert shortfall(None, 0.3, 0.3, 1000, "a remedy") == ""

    def test_of_the_draws_says_how_many_would_do(self):
        def estimate(n_draws):
            rng = np.random.default_rng([103, n_draws])
            posterior = Regression(4, 18, rng).posterior((4, n_draws), rng, correlation=0.97)
            watched, batches = counted(posterior)
            found = ChibJeliazkov(target_se=0.05).estimate(watched, rng=rng)
            return found, sum(map(len, batches))

        found, n_evaluations = estimate(200)
        assert found.se > 0.05
        assert n_evaluations < MOST  # more of them cannot help
        needed = int(found.shortfall.split("about ")[1].split(" instead of 800 would do")[0])
        assert 800 < needed < 40_000
        assert estimate(needed // 4)[0].se < 0.08  # errors of few effective draws are rough

    def test_of_the_evaluations_names_a_remedy(self):
        rng = np.random.default_rng(104)
        posterior = gaussian(2, (4, 500), rng, noise_sd=1.5)
        found = Importance(target_se=0.01).estimate(posterior, rng=rng)
        assert found.settings["n_proposals"] == MOST
        assert "come from the evaluations: draw more" in found.shortfall

    def test_is_a_warning(self):
        idata = exact_draws((2, 100))
        with pytest.warns(EvidenceWarning, match=r"is above target_se=0.01 \(.* do\)"):
            psf.estimate_evidence(
                idata,
                REGRESSION.model(),
                estimators="chib_jeliazkov",
                target_se=0.01,
                random_seed=1,
            )


class TestShared:
    def posterior(self, n_draws=500):
        made = gaussian(2, (4, n_draws), np.random.default_rng(105), noise_sd=1.0)
        return replace(made, shared_seed=(1, 2))

    def test_points_do_not_depend_on_who_asks_for_how_many(self):
        rng = np.random.default_rng(106)
        at_once, in_turn = (normal_proposals(self.posterior(), rng)[1] for _ in range(2))
        in_turn.first(10)
        in_turn.first(2 * BLOCK)
        for one, other in zip(at_once.first(3 * BLOCK), in_turn.first(3 * BLOCK), strict=True):
            np.testing.assert_array_equal(one, other)

    def test_halves_have_points_of_their_own(self):
        first, second = normal_proposals(self.posterior(), np.random.default_rng(107))
        z = [q.moments.whitened(q.first(BLOCK)[0]) for q in (first, second)]
        assert abs(np.corrcoef(z[0].ravel(), z[1].ravel())[0, 1]) < 4 / (2 * BLOCK) ** 0.5

    def test_a_point_is_evaluated_once(self):
        posterior, batches = counted(self.posterior())
        estimators = Bridge(target_se=0.05), ChibJeliazkov(target_se=0.05)
        n_alone = 0
        for estimator in estimators:
            together = estimator.estimate(posterior, rng=np.random.default_rng(108))
            by_itself, own = counted(self.posterior())
            assert together == estimator.estimate(by_itself, rng=np.random.default_rng(108))
            n_alone += sum(map(len, own))
        # Both start from the first block of each half.
        assert sum(map(len, batches)) == n_alone - 2 * BLOCK

    def test_a_copy_of_the_posterior_has_its_own(self):
        posterior = self.posterior()
        normal_proposals(posterior, np.random.default_rng(109))
        assert posterior.shared
        assert not replace(posterior, draws=posterior.draws + 1).shared


def test_an_estimator_keeps_its_own_target():
    idata, model = exact_draws((4, 1000)), REGRESSION.model()
    with pytest.warns(EvidenceWarning, match="above target_se=0.001"):
        psf.estimate_evidence(idata, model, estimators=ChibJeliazkov(target_se=1e-3), random_seed=1)
    estimate = {"estimators": [Importance(target_se=0.01)], "target_se": 0.5, "random_seed": 1}
    assert psf.estimate_evidence(idata, model, **estimate)["importance"].se <= 0.01
