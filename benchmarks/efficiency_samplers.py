"""Samplers behind one function: chains, CPU seconds without compilation, evaluations counted."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
import pymc as pm

import pymc_statespace_filters as psf
from pymc_statespace_filters.compiler.native.rows import Rows
from pymc_statespace_filters.sampling.run import model_task, population_search
from pymc_statespace_filters.sampling.target.settings import RandomWalkSettings
from pymc_statespace_filters.sampling.target.target import Target

CHAINS, WALKERS = 4, 32
N_COMPARED = 10  # draws of the prior, at the best of which a peer without starts of its own starts


class Sample(NamedTuple):
    """Kept draws (chain, draw, k) of a run, and its cost: CPU seconds, calls of the likelihood."""

    draws: np.ndarray
    seconds: float
    kept_seconds: float
    evaluations: int
    kept_evaluations: int
    start_seconds: float = 0.0
    start_evaluations: int = 0


Sampler = Callable[[int, int, int], Sample]  # of seed, draws, tune


def elements(model: pm.Model, posterior) -> np.ndarray:
    """The draws (chain, draw, k) of all elements of the free variables."""
    values = [posterior[rv.name].values for rv in model.free_RVs]
    return np.concatenate([v.reshape(*v.shape[:2], -1) for v in values], axis=2)


class Clock:
    """CPU seconds of the parts of ``sample_dram``, and evaluations of its search for starts."""

    def __init__(self) -> None:
        self.compilation = self.starts = 0.0
        self.start_evaluations = 0
        self.tuned: float | None = None  # when all chains had ended their warm-up together

    @contextmanager
    def running(self) -> Iterator[None]:
        """Count in this block; earlier versions do not use the gradient."""
        task = model_task.ModelTask
        prepare, extend, call = task.prepare, task.extend, Rows.__call__
        search, gradient = population_search.find_population, getattr(Target, "gradient_rows", None)

        def compiled(function, *args, **kwargs):
            began = time.process_time()
            result = function(*args, **kwargs)
            self.compilation += time.process_time() - began
            return result

        def with_gradient(this, **kwargs):
            return compiled(gradient, this, **kwargs)

        def found(*args, **kwargs):
            began, before = time.process_time(), self.compilation
            with patch.object(Rows, "__call__", rows):
                population = search(*args, **kwargs)
            self.starts += time.process_time() - began - (self.compilation - before)
            return population

        def rows(mapped, *columns):
            self.start_evaluations += len(columns[0])
            return call(mapped, *columns)

        def extended(this):
            is_tuned, goes_on = this.n_iterations == this.request.tune, extend(this)
            if is_tuned:
                self.tuned = time.process_time()
            return goes_on

        with (
            patch.object(task, "prepare", lambda this: compiled(prepare, this)),
            patch.object(Target, "gradient_rows", with_gradient, create=True),
            patch.object(task, "extend", extended),
            patch.object(population_search, "find_population", found),
        ):
            yield


def dram(model: pm.Model) -> Sampler:
    psf.sample_dram(2, 2, chains=1, initvals={}, model=model, progressbar=False)

    def sample(seed: int, draws: int, tune: int) -> Sample:
        clock, began = Clock(), time.process_time()
        with clock.running():
            idata = psf.sample_dram(
                draws, tune, model=model, random_seed=seed, cores=1, progressbar=False,
                discard_tuned_samples=False, compute_convergence_checks=False,
            )  # fmt: skip
        ended = time.process_time()
        seconds = ended - began - clock.compilation
        groups = "sample_stats", "warmup_sample_stats"
        kept, warmup = (int(idata[group]["n_evaluations"].sum()) for group in groups)
        in_kept = seconds * kept / (kept + warmup) if clock.tuned is None else ended - clock.tuned
        return Sample(
            elements(model, idata["posterior"]), seconds, in_kept,
            kept + warmup + clock.start_evaluations, kept, clock.starts, clock.start_evaluations,
        )  # fmt: skip

    return sample


def de_metropolis(model: pm.Model) -> Sampler:
    def timed(seed: int, draws: int, tune: int):
        began = time.process_time()
        with model:
            idata = pm.sample(
                draws, tune=tune, step=pm.DEMetropolisZ(), chains=CHAINS, cores=1, quiet=True,
                random_seed=seed, progressbar=False, compute_convergence_checks=False,
            )  # fmt: skip
        return elements(model, idata["posterior"]), time.process_time() - began

    timed(0, 1, 1)
    preparation = timed(0, 1, 1)[1]

    def sample(seed: int, draws: int, tune: int) -> Sample:
        chains, seconds = timed(seed, draws, tune)
        # Every iteration evaluates the proposal and, again, the current point.
        counts = 2 * CHAINS * (draws + tune), 2 * CHAINS * draws
        seconds -= preparation
        return Sample(chains, seconds, seconds * draws / (draws + tune), *counts)

    return sample


def by_nutpie(model: pm.Model) -> Sampler:
    import nutpie

    compiled = nutpie.compile_pymc_model(model)

    def sample(seed: int, draws: int, tune: int) -> Sample:
        began = time.process_time()
        idata = nutpie.sample(
            compiled, draws=draws, tune=tune, chains=CHAINS, cores=1, seed=seed,
            progress_bar=False, save_warmup=True,
        )  # fmt: skip
        seconds = time.process_time() - began
        groups = "sample_stats", "warmup_sample_stats"
        kept, warmup = (int(idata[group]["n_steps"].sum()) for group in groups)
        in_kept = seconds * kept / (kept + warmup)
        return Sample(elements(model, idata["posterior"]), seconds, in_kept, kept + warmup, kept)

    sample(0, 2, 2)
    return sample


class Density:
    """The compiled log-density as a Python function that counts its calls; draws of the prior."""

    def __init__(self, model: pm.Model) -> None:
        self._target = Target(model, None, RandomWalkSettings())
        self._target.prepare()
        self._bound, self.calls = self._target.density.bind(), 0

    def __call__(self, x: np.ndarray) -> float:
        self.calls += 1
        value = self._bound(x, [], []).log_density
        return value if value < np.inf else -np.inf

    def starts(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """As many draws of the prior with finite density."""
        drawn = rng.permutation(self._target.prior_draws.draws)
        return np.array([x for x in drawn if self(x) > -np.inf][:n])


def by_emcee(model: pm.Model) -> Sampler:
    import emcee

    density = Density(model)

    def sample(seed: int, draws: int, tune: int) -> Sample:
        rng, density.calls, began = np.random.default_rng(seed), 0, time.process_time()
        np.random.seed(seed)  # noqa: NPY002 - it draws from the global generator
        start = density.starts(WALKERS, rng)
        sampler = emcee.EnsembleSampler(WALKERS, start.shape[1], density)
        state = sampler.run_mcmc(start, max(1, CHAINS * tune // WALKERS))
        tuning, tuned = density.calls, time.process_time()
        sampler.reset()
        sampler.run_mcmc(state, max(1, CHAINS * draws // WALKERS))
        ended = time.process_time()
        chains = sampler.get_chain().swapaxes(0, 1)
        kept = density.calls - tuning
        return Sample(chains, ended - began, ended - tuned, density.calls, kept)

    return sample


def by_pymcmcstat(model: pm.Model) -> Sampler:
    from benchmarks.peers.pymcmcstat_dram import chain

    density = Density(model)

    def sample(seed: int, draws: int, tune: int) -> Sample:
        rng, density.calls, began = np.random.default_rng(seed), 0, time.process_time()
        chains = []
        for i in range(CHAINS):
            start = max(density.starts(N_COMPARED, rng), key=density)
            names = [f"x{i}" for i in range(start.size)]
            run = chain(CHAINS * seed + i, draws + tune, names, start, lambda q: -2.0 * density(q))
            chains.append(run[0][tune:])
        kept = density.calls * draws // (draws + tune)
        seconds = time.process_time() - began
        in_kept = seconds * kept / density.calls
        return Sample(np.array(chains), seconds, in_kept, density.calls, kept)

    return sample
