"""Are the errors of the estimators what they say? Replications where the truth is known."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2, norm

import pymc_statespace_filters as psf
from pymc_statespace_filters.evidence.estimation import ESTIMATORS
from pymc_statespace_filters.evidence.estimators.chib_jeliazkov import ChibJeliazkov
from pymc_statespace_filters.evidence.posterior_of_draws import build_posterior
from pymc_statespace_filters.pymc_model.density import ModelDensity
from tests.evidence import double_well
from tests.evidence.hard_targets import (
    Bent,
    Correlated,
    Funnel,
    Skewed,
    UnequalWidths,
)
from tests.evidence.state_space import state_space
from tests.evidence.targets import (
    Banana,
    Regression,
    TwoModes,
    bounded,
    gamma_distributed,
    half_normally_distributed,
)

CORRELATION = 0.8  # of neighbouring draws: nine of them are worth one
SQUARES = (0.7, 1.4)  # where the mean squared z is to lie
BIAS = 0.25  # how far the mean z may be from zero


class Drawn:
    """Draws made of normals, 4 chains."""

    def __init__(self, target, n_draws, noise_sd=0.0):
        self._target, self._n_draws, self._noise_sd = target, n_draws, noise_sd
        self.log_evidence = target.log_evidence

    def posterior(self, run):
        return self._target.posterior(
            (4, self._n_draws),
            np.random.default_rng([2013, run]),
            correlation=CORRELATION,
            noise_sd=self._noise_sd,
        )


class Sampled:
    """Draws of a PyMC model by ``sample_dram``, 4 chains, as a user has them."""

    def __init__(self, model, log_evidence, n_draws):
        self._model, self._n_draws = model, n_draws
        self.log_evidence = log_evidence
        self._density = ModelDensity(model)
        self._posteriors = {}

    def posterior(self, run):
        if run not in self._posteriors:
            idata = psf.sample_dram(
                self._n_draws,
                tune=1000,
                chains=4,
                model=self._model,
                random_seed=run,
                progressbar=False,
            )
            self._posteriors[run] = build_posterior(idata, self._density)[0]
        return self._posteriors[run]


@dataclass(frozen=True)
class Case:
    """A target, how it is drawn, and how often.

    Attributes
    ----------
    make : callable
        The target with its draws, made when it is first asked for.
    n_parameters : int
    n_runs : int
    """

    make: Callable[[], Any]
    n_parameters: int
    n_runs: int = 200

    @property
    def source(self):
        return _made(self.make)


@cache
def _made(make):
    return make()


def regression(k):
    return Regression(k, 2 * k + 10, np.random.default_rng([2013, k]))


def sampled_regression(k):
    target = regression(k)
    return Sampled(target.model(), target.log_evidence, 10_000)


def pseudo_marginal():
    """The target of the row above, now sampled with a particle filter."""
    target = state_space()
    return Sampled(target.model(psf.BootstrapPF(50)), target.log_evidence, 5000)


def pseudo_marginal_double_well():
    return Sampled(double_well.model(psf.BootstrapPF(50)), double_well.LOG_EVIDENCE, 5000)


def _hard(make, k):
    return Case(lambda: Drawn(make(k), 2500), k, 20)


CASES = {
    "regression, 2": Case(lambda: Drawn(regression(2), 1000), 2),
    "regression, 4": Case(lambda: Drawn(regression(4), 1000), 4),
    "regression, 12": Case(lambda: Drawn(regression(12), 2500), 12),
    "regression, 20": Case(lambda: Drawn(regression(20), 2500), 20),
    "two modes": Case(lambda: Drawn(TwoModes(2), 1000), 2),
    "half-normal, log": Case(lambda: Drawn(half_normally_distributed(), 1000), 1),
    "Gamma, log": Case(lambda: Drawn(gamma_distributed(), 1000), 1),
    "uniform, at its bound": Case(lambda: Drawn(bounded(), 1000), 1),
    "banana": Case(lambda: Drawn(Banana(12), 2500), 12),
    **{
        f"{name}, {k}": _hard(make, k)
        for name, make in {
            "two widths, equal masses": lambda k: UnequalWidths(k, 0.5),
            "two widths, narrow 2/3": lambda k: UnequalWidths(k, 2 / 3),
            "skewed tails": Skewed,
            "funnel": Funnel,
            "sharp banana": Bent,
            "correlated": Correlated,
        }.items()
        for k in (8, 11)
    },
    "noisy regression, 4": Case(lambda: Drawn(regression(4), 1000, noise_sd=1.0), 4),
    "state space, EKF": Case(lambda: Drawn(state_space(), 1000), 2, 20),
    "state space, BootstrapPF": Case(pseudo_marginal, 2, 20),
    "double well, BootstrapPF": Case(pseudo_marginal_double_well, 2, 20),
}


IN_BLOCKS = "chib_jeliazkov, 2 blocks"
# What `estimate_evidence` does with no argument: evaluations until the standard error is small.
TARGET_SE = 0.05
STOPPED = {
    f"{name}, se {TARGET_SE}": replace(ESTIMATORS[name], target_se=TARGET_SE)
    for name in ("chib_jeliazkov", "bridge", "importance")
}
CALIBRATED = {**ESTIMATORS, IN_BLOCKS: ChibJeliazkov(n_blocks=2), **STOPPED}

# How small an error 4 x 10 000 draws give.
LONG_CHAINS = {
    "regression, 4, autoregressive": Case(lambda: Drawn(regression(4), 10_000), 4, 20),
    "regression, 4, sample_dram": Case(lambda: sampled_regression(4), 4, 20),
    "regression, 12, autoregressive": Case(lambda: Drawn(regression(12), 10_000), 12, 20),
    "regression, 12, sample_dram": Case(lambda: sampled_regression(12), 12, 20),
}


class Calibration(NamedTuple):
    """What replications of an estimator gave.

    Attributes
    ----------
    n_runs : int
    bias : float
        Mean error.
    reported : float
        Root mean square of the standard errors that were reported.
    actual : float
        Standard deviation of the estimates.
    mean_z, mean_square : float
        Of errors divided by their reported standard errors.
    doubted : float
        Share of the replications in which the estimator itself raised a doubt.
    n_evaluations : float
        Of the log-density, on average.
    """

    n_runs: int
    bias: float
    reported: float
    actual: float
    mean_z: float
    mean_square: float
    doubted: float
    n_evaluations: float

    @property
    def is_right(self):
        """Whether the mean squared z and the mean z lie where they are to lie.

        Right errors of 200 replications are outside once in a thousand times; of 20 often, so that
        the limits are then so wide that right errors are outside as rarely.
        """
        return _are_of_normals(self.n_runs, self.mean_z, self.mean_square)


def _are_of_normals(n, mean, mean_square):
    """Whether n scores may be standard normal: those that are fail once in a thousand times."""
    low, high, furthest = *SQUARES, BIAS
    if n < 200:
        low, high = chi2.ppf([0.0001, 0.9999], n) / n
        furthest = norm.isf(0.0002) / n**0.5
    return low <= mean_square <= high and abs(mean) <= furthest


def check_scores(z):
    """Fail unless errors, divided by their standard errors, may be standard normal."""
    mean, mean_square = np.mean(z), np.mean(np.square(z))
    assert _are_of_normals(len(z), mean, mean_square), (mean, mean_square)


# Of 50 scores the mean is to be within 0.5 of zero and the mean square within [0.42, 1.92]: errors
# that are reported half or twice as large as they are, are found but for twice in a thousand times.
EACH_NUMBER_OF_RUNS = pytest.mark.parametrize(
    "n_runs", [50, pytest.param(200, marks=pytest.mark.slow)]
)


def calibrate(estimator, source, n_runs):
    """Replicate 0, 1, ..., each with draws, and a stream for the estimator, of its own."""
    errors, reported, doubted, n_evaluations = [], [], [], []
    for run in range(n_runs):
        posterior, count = _counted(source.posterior(run))
        found = estimator.estimate(posterior, rng=np.random.default_rng([3, run]))
        errors.append(found.log_evidence - source.log_evidence)
        reported.append(found.se)
        doubted.append(bool(found.doubts))
        n_evaluations.append(count())
    z = np.divide(errors, reported)
    return Calibration(
        n_runs,
        bias=np.mean(errors),
        reported=np.mean(np.square(reported)) ** 0.5,
        actual=np.std(errors),
        mean_z=np.mean(z),
        mean_square=np.mean(z**2),
        doubted=np.mean(doubted),
        n_evaluations=np.mean(n_evaluations),
    )


def _counted(posterior):
    """The posterior, and a function that tells how many points were evaluated."""
    n_points = [0]

    def evaluate(x, rng):
        n_points[0] += len(x)
        return posterior.evaluate(x, rng)

    return replace(posterior, evaluate=evaluate), lambda: n_points[0]


def applies(estimator, case):
    """Whether an estimator is asked for the evidence of a target."""
    if estimator == IN_BLOCKS:  # is for many parameters
        return case.n_parameters >= 12 and case in CASES.values()
    if estimator in STOPPED:
        return case in CASES.values()
    return True
