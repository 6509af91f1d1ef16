"""Simulation-based calibration: parameters from the prior, a record from them, a chain on it.

The rank of the true value among independent draws of a right sampler is uniform. A replication
exchanges the data of one compiled model, and goes the way of ``sample_dram`` from there.

References
----------
S. Talts, M. Betancourt, D. Simpson, A. Vehtari and A. Gelman (2018). Validating Bayesian inference
algorithms with simulation-based calibration. arXiv:1804.06788.
M. Modrák and others (2025). Simulation-based calibration checking for Bayesian computation: the
choice of test quantities shapes sensitivity. Bayesian Analysis 20, 461-488.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from threading import Event, Lock
from typing import Any, NamedTuple

import arviz as az
import numpy as np
import pymc as pm
import pytensor

import pymc_statespace_filters as psf
from pymc_statespace_filters.sampling.output.deterministics import Deterministics
from pymc_statespace_filters.sampling.run.chain_task import ChainTask
from pymc_statespace_filters.sampling.run.model_task import ModelTask
from pymc_statespace_filters.sampling.run.request import sampling_request
from pymc_statespace_filters.sampling.target.log_density import screening_density
from pymc_statespace_filters.sampling.target.settings import DRAMSettings
from pymc_statespace_filters.sampling.target.target import Target
from tests.sampling.autoregression import autoregression
from tests.sampling.rank_uniformity import chi_square_p, ecdf_p

STEPS = np.arange(1, 31)
LINEAR = autoregression(observation_noise=[[0.5]])
# The last is exact, and finds a posterior that is too wide or too narrow all around, which hardly
# shows in the parameters.
QUANTITIES = ("phi", "spread", "log-likelihood")

TUNE = 1000
N_KEPT = 63
N_RANKS = N_KEPT + 1
N_BINS = 16
# A chain is made longer, from the first of these to the next, until its effective size is at least
# the number of draws that are kept.
LENGTHS = (2000, 8000, 32_000)
THREADS = 2
N_REPLICATIONS = 200


def from_the_prior(rng):
    return {"phi": rng.uniform(-0.9, 0.9), "spread": 0.7 * np.exp(0.3 * rng.standard_normal())}


def record_of(phi, spread, rng):
    """The system's equations once more, so that the package's simulator has no part in it."""
    x, record = rng.standard_normal(), np.empty((STEPS.size, 1))
    for row in record:
        x = phi * x + spread * rng.standard_normal()
        row[0] = x + np.sqrt(0.5) * rng.standard_normal()
    return record


@dataclass(frozen=True)
class Setting:
    """What is calibrated.

    Attributes
    ----------
    filter : Filter
    dram : dict
        Settings of DRAM.
    truths : callable
        From a generator to the true parameters: of the model's prior, unless it is to be wrong.
    run : type
        The way a chain is made: ChainTask, unless it is to be wrong.
    graph : callable, optional
        From the model to the log-density that is sampled, if that is to be wrong.
    """

    filter: Any
    dram: dict = field(default_factory=dict)
    truths: Callable[[np.random.Generator], dict] = from_the_prior
    run: type[ChainTask] = ChainTask
    graph: Callable[[pm.Model], Any] | None = None


class Calibration(NamedTuple):
    """Outcome for a setting.

    Attributes
    ----------
    ranks : ndarray of int, shape (replications, 3)
        Of the true values of QUANTITIES among N_KEPT draws.
    lags : ndarray, shape (replications, 3)
        Correlation of neighbours among these draws.
    lengths : ndarray, shape (replications,)
        Iterations after warm-up that the chains took.
    seconds : float
        On THREADS threads, without compiling.
    """

    ranks: np.ndarray
    lags: np.ndarray
    lengths: np.ndarray
    seconds: float


class Replications:
    """A model compiled once, for records exchanged one after the other."""

    def __init__(self, setting):
        self._setting = setting
        self.record = pytensor.shared(np.zeros((STEPS.size, 1)), name="record")
        with pm.Model() as self.model:
            pm.Uniform("phi", -0.9, 0.9)
            pm.LogNormal("spread", np.log(0.7), 0.3)
            psf.StateSpace("d", LINEAR, setting.filter, steps=STEPS, observed=self.record)
        settings = DRAMSettings.from_arguments(setting.dram)
        graph = setting.graph and setting.graph(self.model)
        self._target = Target(self.model, None, settings, graph=graph)
        self._deterministics = Deterministics(self.model, self._target.raveled)
        # Machine code runs in threads; what PyTensor has compiled is called by one at a time.
        self._lock = Lock()

    def truth_and_record(self, index):
        rng = np.random.default_rng([2018, index])
        truth = self._setting.truths(rng)
        return truth, record_of(**truth, rng=rng)

    def chain(self, index, n_draws):
        """Draws by name, each (n_draws,): those of ``sample_dram(random_seed=index, chains=1)``."""
        request = sampling_request(
            n_draws, TUNE, 1, index, None, False, None, None, self._setting.dram
        )
        task = ModelTask(self.model, request, target=self._target)
        with self._lock:
            self.record.set_value(self.truth_and_record(index)[1])
            task.prepare()
            task.population = task.find_population(progressbar=False)
            chain = task.chain_task(0)
        chain.__class__ = self._setting.run
        chain.run(Event())
        task.add_result(0, *chain.result())
        while task.extend():
            chain.extend(task.n_iterations, task.mixture)
            chain.run(Event())
            task.add_result(0, *chain.result())
        with self._lock:
            return self._deterministics(chain.chain.draws.positions[TUNE:])

    def replicate(self, index):
        """Ranks of the truth, correlations of neighbours, and the length of the chain."""
        for n_draws in LENGTHS:
            draws = self.chain(index, n_draws)
            if min(az.ess(draws[name][None]) for name in ("phi", "spread")) >= N_KEPT:
                break
        truth, record = self.truth_and_record(index)
        kept = np.arange(1, N_RANKS) * n_draws // N_KEPT - 1
        drawn = quantities({name: draws[name][kept] for name in truth}, record)
        ranks = np.sum(drawn < quantities(truth, record), axis=1)
        centred = drawn - drawn.mean(axis=1, keepdims=True)
        lags = np.mean(centred[:, 1:] * centred[:, :-1], axis=1) / np.mean(centred**2, axis=1)
        return ranks, lags, n_draws


def quantities(params, record):
    """Stack QUANTITIES for some parameters, (3, n)."""
    terms = psf.log_likelihood(LINEAR, psf.EKF(), params, record, steps=STEPS)
    return np.array([params["phi"], params["spread"], terms.sum(axis=-1)]).reshape(3, -1)


def calibrate(setting, n_replications=N_REPLICATIONS):
    """Replicate 0, 1, ... in threads; the same whatever their order."""
    replications = Replications(setting)
    replications.replicate(0)  # compiles
    began = time.perf_counter()
    with ThreadPoolExecutor(THREADS) as pool:
        outcomes = list(pool.map(replications.replicate, range(n_replications)))
    seconds = time.perf_counter() - began
    ranks, lags, lengths = (np.array(column) for column in zip(*outcomes, strict=True))
    return Calibration(ranks, lags, lengths, seconds)


def p_values(ranks):
    """For each quantity, (3, 2): by chi-square over bins, by the band of the ECDF."""
    return np.array([[chi_square_p(r, N_RANKS, N_BINS), ecdf_p(r, N_RANKS)] for r in ranks.T])


class Redrawing(ChainTask):
    """The common mistake: the likelihood of the current point is estimated anew for every move."""

    def _advance(self):
        if self.n_done < self._tune:
            return super()._advance()
        chain, done = self.chain, self.n_done
        chain.start([chain.state.position.copy()], (), self._rng)
        return chain.advance(False, done, done, 1)


def from_another_prior(rng):
    truth = from_the_prior(rng)
    return truth | {"spread": 1.2 * truth["spread"]}


def screen_alone(model):
    return screening_density(model, psf.EKF(), 0.5)


# Two stages after warm-up too, so that delayed rejection has its part in what is calibrated.
EXACT, FEW, TWO = psf.EKF(), psf.BootstrapPF(30), {"stages": 2}
SETTINGS = {
    "exact likelihood (EKF)": Setting(EXACT, TWO),
    "pseudo-marginal": Setting(FEW, TWO),
    "screened by EKF": Setting(FEW, TWO | {"screen": EXACT, "screen_power": 0.5}),
    "screened by EnKF(20)": Setting(FEW, TWO | {"screen": psf.EnKF(20), "screen_power": 1.0}),
}
# What the same comparisons must find.
CONTROLS = {
    "another prior": Setting(EXACT, TWO, truths=from_another_prior),
    "the screen alone": Setting(EXACT, TWO, graph=screen_alone),
    "estimates redrawn": Setting(FEW, run=Redrawing),
}
