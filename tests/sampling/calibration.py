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
from pymc_statespace_filters.sampling.run.request import RunArguments
from pymc_statespace_filters.sampling.target.log_density import screening_density
from pymc_statespace_filters.sampling.target.record_target import target_of
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from pymc_statespace_filters.sampling.target.target import Target
from tests.sampling.rank_uniformity import chi_square_p, ecdf_p
from tests.systems import autoregression

LINEAR = autoregression(observation_noise=0.5)

TUNE = 1000
N_KEPT = 63
N_RANKS = N_KEPT + 1
N_BINS = 16
# A chain is made longer, from the first of these to the next, until its effective size is at least
# the number of draws that are kept.
LENGTHS = (2000, 8000, 32_000)
THREADS = 2
N_REPLICATIONS = 200


def path_of(phi, spread, n_steps, rng):
    """The system's equations once more, so that the package's simulator has no part in it."""
    x, record = rng.standard_normal(), np.empty((n_steps, 1))
    for row in record:
        x = phi * x + spread * rng.standard_normal()
        row[0] = x + np.sqrt(0.5) * rng.standard_normal()
    return record


def log_likelihood_of(phi, spread, record):
    """Exact, of a record at n draws, (n,)."""
    params, steps = {"phi": phi, "spread": spread}, np.arange(1, len(record) + 1)
    return psf.log_likelihood(LINEAR, psf.EKF(), params, record, steps=steps).sum(axis=-1)


class OneRecord:
    """Two parameters and a record of 30 steps."""

    # The log-likelihood is exact, and finds a posterior that is too wide or too narrow all around,
    # which hardly shows in the parameters.
    quantities = ("phi", "spread", "log-likelihood")
    n_rows = 30
    rows: dict[str, Any] = {"steps": np.arange(1, 31)}  # noqa: RUF012

    def truth(self, rng):
        return {"phi": rng.uniform(-0.9, 0.9), "spread": 0.7 * np.exp(0.3 * rng.standard_normal())}

    def record(self, truth, rng):
        return path_of(**truth, n_steps=self.n_rows, rng=rng)

    def prior(self):
        pm.Uniform("phi", -0.9, 0.9)
        pm.LogNormal("spread", np.log(0.7), 0.3)

    def parameters(self, draws):
        return [draws["phi"], draws["spread"]]

    def log_likelihood(self, draws, record):
        return log_likelihood_of(draws["phi"], draws["spread"], record)


class Panel:
    """Four records of unequal lengths, each with its own phi, from a population; one spread."""

    quantities = ("typical", "spread", "phi of the first", "phi of the last", "log-likelihood")
    lengths = (12, 5, 9, 14)
    n_rows = sum(lengths)
    rows: dict[str, Any] = {  # noqa: RUF012
        "panel": np.repeat(np.arange(4), lengths),
        "steps": np.concatenate([np.arange(1, n + 1) for n in lengths]),
    }

    def truth(self, rng):
        typical = rng.normal(0.3, 0.3)
        spread = 0.7 * np.exp(0.3 * rng.standard_normal())
        return {"typical": typical, "phi": rng.normal(typical, 0.3, 4), "spread": spread}

    def record(self, truth, rng):
        each = zip(truth["phi"], self.lengths, strict=True)
        return np.concatenate([path_of(phi, truth["spread"], n, rng) for phi, n in each])

    def prior(self):
        typical = pm.Normal("typical", 0.3, 0.3)
        pm.Normal("phi", typical, 0.3, shape=4)
        pm.LogNormal("spread", np.log(0.7), 0.3)

    def parameters(self, draws):
        return [draws["typical"], draws["spread"], draws["phi"][..., 0], draws["phi"][..., -1]]

    def log_likelihood(self, draws, record):
        records = np.split(record, np.cumsum(self.lengths)[:-1])
        each = zip(draws["phi"].T, records, strict=True)
        return sum(log_likelihood_of(phi, draws["spread"], one) for phi, one in each)


ONE, PANEL = OneRecord(), Panel()


@dataclass(frozen=True)
class Setting:
    """What is calibrated.

    Attributes
    ----------
    filter : Filter
    dram : dict
        Settings of DRAM.
    problem : OneRecord or Panel
        Prior, system's records, and the quantities whose ranks are taken.
    run : type, optional
        The way a chain is made, if that is to be wrong.
    graph : callable, optional
        From the model to the log-density that is sampled, if that is to be wrong.
    """

    filter: Any
    dram: dict = field(default_factory=dict)
    problem: OneRecord | Panel = ONE
    run: type[ChainTask] | None = None
    graph: Callable[[pm.Model], Any] | None = None


class Calibration(NamedTuple):
    """Outcome for a setting.

    Attributes
    ----------
    ranks : ndarray of int, shape (replications, quantities)
        Of the true values among N_KEPT draws.
    lags : ndarray, shape (replications, quantities)
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
        self._problem = problem = setting.problem
        self.record = pytensor.shared(np.zeros((problem.n_rows, 1)), name="record")
        with pm.Model() as self.model:
            problem.prior()
            psf.StateSpace("d", LINEAR, setting.filter, observed=self.record, **problem.rows)
        self.kernel = settings = RandomWalkSettings(**setting.dram)
        if setting.graph:
            self._target = Target(self.model, None, settings, graph=setting.graph(self.model))
        else:
            self._target = target_of(
                self.model, settings, None, None, has_pilot=False, centres=True
            )
        self._deterministics = Deterministics(self.model, self._target.raveled)
        # Machine code runs in threads; what PyTensor has compiled is called by one at a time.
        self._lock = Lock()

    def truth_and_record(self, index):
        rng = np.random.default_rng([2018, index])
        truth = self._problem.truth(rng)
        return truth, self._problem.record(truth, rng)

    def chain(self, index, n_draws):
        """Draws (n_draws, ...) by name: those of ``sample_dram(random_seed=index, chains=1)``."""
        request = RunArguments(
            draws=n_draws, tune=TUNE, chains=1, random_seed=index, kernel=self.kernel
        ).request()
        task = ModelTask(self.model, request, target=self._target)
        with self._lock:
            self.record.set_value(self.truth_and_record(index)[1])
            task.prepare()
            task.searched = task.find_population(progressbar=False)
            chain = task.chain_task(0)
        if self._setting.run:
            chain.__class__ = self._setting.run
        chain.run(Event())
        task.add_result(0, *chain.result())
        while task.extend():
            chain.extend(task.n_iterations, task.thin, task.mixture)
            chain.run(Event())
            task.add_result(0, *chain.result())
        with self._lock:
            return self._deterministics(chain.chain.draws.positions[TUNE:])

    def replicate(self, index):
        """Ranks of the truth, correlations of neighbours, and the length of the chain."""
        truth, record = self.truth_and_record(index)
        for n_draws in LENGTHS:
            draws = self.chain(index, n_draws)
            elements = [draws[name].reshape(1, n_draws, -1) for name in truth]
            if min(az.ess(one) for of in elements for one in np.moveaxis(of, 2, 0)) >= N_KEPT:
                break
        kept = np.arange(1, N_RANKS) * n_draws // N_KEPT - 1
        drawn = self.quantities({name: draws[name][kept] for name in truth}, record)
        at_truth = {name: np.asarray(value)[None] for name, value in truth.items()}
        ranks = np.sum(drawn < self.quantities(at_truth, record), axis=1)
        centred = drawn - drawn.mean(axis=1, keepdims=True)
        lags = np.mean(centred[:, 1:] * centred[:, :-1], axis=1) / np.mean(centred**2, axis=1)
        return ranks, lags, n_draws

    def quantities(self, draws, record):
        """Stack the quantities of the problem at n draws, (quantities, n)."""
        return np.stack(
            [*self._problem.parameters(draws), self._problem.log_likelihood(draws, record)]
        )


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
    """For each quantity, (quantities, 2): by chi-square over bins, by the band of the ECDF."""
    return np.array([[chi_square_p(r, N_RANKS, N_BINS), ecdf_p(r, N_RANKS)] for r in ranks.T])


class Redrawing(ChainTask):
    """The common mistake: the likelihood of the current point is estimated anew for every move."""

    def _advance(self):
        if self.n_done < self.tune:
            return super()._advance()
        chain, done = self.chain, self.n_done
        chain.start([chain.state.position.copy()], (), self.rng)
        return chain.advance(False, done, done, 1)


class AnotherPrior(OneRecord):
    """The true spread is not from the model's prior."""

    def truth(self, rng):
        truth = super().truth(rng)
        return truth | {"spread": 1.2 * truth["spread"]}


class AnotherPopulation(Panel):
    """The true phi of all records are higher than the model's population has them."""

    def truth(self, rng):
        truth = super().truth(rng)
        return truth | {"phi": truth["phi"] + 0.2}


def screen_alone(model):
    return screening_density(model, psf.EKF(), 0.5)


# Two stages after warm-up too, so that delayed rejection has its part in what is calibrated.
EXACT, FEW, TWO = psf.EKF(), psf.BootstrapPF(30), {"stages": 2}
SETTINGS = {
    "exact likelihood (EKF)": Setting(EXACT, TWO),
    "pseudo-marginal": Setting(FEW, TWO),
    "screened by EKF": Setting(FEW, TWO | {"screen": EXACT, "screen_power": 0.5}),
    "screened by EnKF(20)": Setting(FEW, TWO | {"screen": psf.EnKF(20), "screen_power": 1.0}),
    "panel, record by record": Setting(FEW, problem=PANEL),
}
# What the same comparisons must find.
CONTROLS = {
    "another prior": Setting(EXACT, TWO, problem=AnotherPrior()),
    "the screen alone": Setting(EXACT, TWO, graph=screen_alone),
    # The error is that of a variance that depends on the parameters: with 30 particles it is small.
    "estimates redrawn": Setting(psf.BootstrapPF(10), run=Redrawing),
    "panel of another population": Setting(FEW, problem=AnotherPopulation()),
}
