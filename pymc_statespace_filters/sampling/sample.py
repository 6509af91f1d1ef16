"""``sample_dram``: whole chains in machine code, with the DataTree of ``pm.sample``."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import fields, replace
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
from pymc.initial_point import make_initial_point_fns_per_chain
from pymc.model import Model, modelcontext
from pymc.stats.convergence import SamplerWarning, log_warnings, run_convergence_checks
from pytensor.graph.basic import Variable
from xarray import DataTree

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.machine_code import available_cores
from pymc_statespace_filters.sampling import statistics
from pymc_statespace_filters.sampling.chain_arrays import STAGE
from pymc_statespace_filters.sampling.checkpoint import open_checkpoint
from pymc_statespace_filters.sampling.fingerprint import data_fingerprint, model_fingerprint
from pymc_statespace_filters.sampling.health import Record, closing_warning
from pymc_statespace_filters.sampling.held_variables import check_no_generators
from pymc_statespace_filters.sampling.noise_check import at_the_highest_draw, is_worthwhile
from pymc_statespace_filters.sampling.results import ChainDraws, to_datatree
from pymc_statespace_filters.sampling.runs import ChainRun, Plan, run_chains
from pymc_statespace_filters.sampling.settings import DRAMSettings, is_count
from pymc_statespace_filters.sampling.target import Target

_SHOWN_DIGITS = 16  # of a fingerprint: 64 bits, in a file and in messages


def sample_dram(
    draws: int = 1000,
    tune: int = 1000,
    *,
    chains: int = 4,
    cores: int | None = None,
    model: Model | None = None,
    random_seed: int | np.random.Generator | None = None,
    initvals: Mapping[str, Any] | Sequence[Mapping[str, Any] | None] | None = None,
    progressbar: bool | str = True,
    discard_tuned_samples: bool = True,
    checkpoint: str | os.PathLike | None = None,
    **dram_settings: Any,
) -> DataTree:
    """Sample a model by delayed rejection adaptive Metropolis, each chain whole in machine code.

    The same transitions as ``pm.sample(step=psf.DRAM())``, without Python between one draw and the
    next: a draw costs what its likelihood costs. Chains run in threads.

    Parameters
    ----------
    draws, tune : int
        Iterations of each chain that are kept, and of warm-up before them, in which the proposals
        are learnt.
    chains : int
    cores : int, optional
        Threads. Default: as many as there are processors, at most ``chains``. The draws do not
        depend on it.
    model : pymc.Model, optional
        Default: the model of the ``with`` block. All its free variables must be continuous.
    random_seed : int or numpy.random.Generator, optional
    initvals : dict, or sequence of dict, optional
        Starting values, for all chains or for each, as in ``pm.sample``. Default: with
        ``tune > 0``, the best of a few draws from the prior.
    progressbar : bool or str
        As in ``pm.sample``.
    discard_tuned_samples : bool
        Whether to leave out the warm-up; else it is kept in groups ``warmup_posterior`` and
        ``warmup_sample_stats``.
    checkpoint : str or path, optional
        A folder, in which the chains are stored every few seconds. If the process ends, in whatever
        way, the same call goes on from there, and gives to the bit what it would have given.
    **dram_settings
        Settings of `DRAM`: ``stages``, ``stage_scale``, ``adaptation``, ``adapt_every``,
        ``proposal_cov``, ``refresh_noise``, ``screen``, ``screen_power``, ``correlation``.

    Returns
    -------
    xarray.DataTree
        As ``pm.sample`` returns it. After Ctrl-C, what was drawn until then. The attributes
        ``exact`` (whether the chains target the posterior itself, without the bias of a filter),
        ``refresh_noise`` and ``correlation`` say what the draws are; ``log_likelihood_variance``,
        of a run of 600 iterations or more with a noisy likelihood, is the variance of the estimated
        log-likelihood over 12 noise seeds at the draw of highest density.

    Raises
    ------
    ModelError
        If an argument is not as described, a free variable is discrete, the log-density draws
        random numbers of its own, or no starting point with finite log-density is found.
    DataMismatchError
        If the checkpoint is of a run with other arguments, another model or other data.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> with pm.Model():
    ...     mu = pm.Normal("mu", 0, 10)
    ...     sigma = pm.HalfNormal("sigma", 2)
    ...     y = pm.Normal("y", mu, sigma, observed=[1.2, 0.7, 2.9, 1.8])
    ...     idata = psf.sample_dram(500, tune=500, chains=2, random_seed=1, progressbar=False)
    >>> idata["posterior"]["mu"].shape
    (2, 500)
    """
    model = modelcontext(model)
    if not isinstance(model, Model):
        raise ModelError(f"model must be a pymc.Model, got {model!r}")
    for name, value, least in (("draws", draws, 0), ("tune", tune, 0), ("chains", chains, 1)):
        if not is_count(value) or value < least:
            raise ModelError(f"{name}={value!r}: expected an integer, at least {least}")
    cores = _checked_cores(cores, chains)
    proposal_cov = dram_settings.pop("proposal_cov", None)
    settings = DRAMSettings.of(dram_settings)
    entropy = _entropy(random_seed)
    check_no_generators(model)
    target = Target(model, None, settings, proposal_cov)
    target.prepare()
    seeds = np.random.SeedSequence(entropy).spawn(chains)
    plan = Plan(
        tune,
        draws,
        not discard_tuned_samples,
        _starts(target, model, initvals, seeds, disperse=tune > 0),
        seeds,
        is_worthwhile(target, tune + draws),
    )
    opened: Any = nullcontext()
    if checkpoint is not None:
        asked = {
            "random_seed": None if random_seed is None else entropy,
            "initvals": _plain(initvals),
            "proposal_cov": _plain(proposal_cov),
        }
        opened = open_checkpoint(checkpoint, asked | _all_that_matters(model, settings, plan))
    began = time.monotonic()
    with opened as store:
        runs = run_chains(target, plan, cores=cores, checkpoint=store, progressbar=progressbar)
    tree = to_datatree(
        model,
        target.held,
        [_chain_draws(target, run, tune) for run in runs],
        tune=tune,
        keep_warmup=not discard_tuned_samples,
        sampling_time=time.monotonic() - began,
    )
    tree.attrs |= {
        "exact": int(target.exact),
        "refresh_noise": int(settings.refresh_noise),
        "correlation": settings.correlation or 0.0,
    }
    _check(tree, model, target, plan, runs)
    return tree


def _all_that_matters(model: Model, settings: DRAMSettings, plan: Plan) -> dict[str, Any]:
    """What draws depend on, besides what the user gave as numbers of his own."""
    return {
        "draws": int(plan.draws),
        "tune": int(plan.tune),
        "chains": len(plan.seeds),
        "discard_tuned_samples": not plan.keeps_warmup,
        **{field.name: repr(getattr(settings, field.name)) for field in fields(settings)},
        "model": model_fingerprint(model)[:_SHOWN_DIGITS],
        "data": data_fingerprint(model)[:_SHOWN_DIGITS],
        "version": version("pymc-statespace-filters"),
    }


def _check(
    tree: DataTree, model: Model, target: Target, plan: Plan, runs: Sequence[ChainRun]
) -> None:
    """Say what is wrong with the chains, and note how noisy their likelihood is."""
    warnings = _chain_warnings(target, runs, plan.tune)
    with suppress(KeyboardInterrupt):  # the draws are there, whoever does not want to wait
        if plan.measures_noise and all(run.done == plan.n_iterations for run in runs):
            spread, warning = at_the_highest_draw(
                [run.running.draws for run in runs],
                plan.tune if plan.draws else 0,
                [run.seed_spread for run in runs],
                [run.key for run in runs],
            )
            tree.attrs["log_likelihood_variance"] = spread.variance
            warnings += filter(None, [warning])
        if "posterior" in tree:
            with np.errstate(invalid="ignore", divide="ignore"):  # chains that stand still
                warnings += run_convergence_checks(tree, model)
    log_warnings(warnings)


def _chain_draws(target: Target, run: ChainRun, tune: int) -> ChainDraws:
    """What a chain has drawn, with its statistics."""
    draws, done = run.running.draws, run.done
    stats = statistics.of_draws(target, draws, slice(0, done))
    moved = draws.counts[:done, STAGE] > 0
    stats["accept_rate"] = np.concatenate(
        [np.cumsum(phase) / np.arange(1, phase.size + 1) for phase in np.split(moved, [tune])]
    )
    frozen = run.running.proposal_cov
    covs = np.broadcast_to(frozen, (done, *frozen.shape))  # of the draws, where the warm-up goes
    if len(draws.covs):
        covs = np.concatenate([draws.covs[:done], covs[tune:]])
    return ChainDraws(draws.positions[:done], stats | {"proposal_cov": covs})


def _chain_warnings(target: Target, runs: Sequence[ChainRun], tune: int) -> list[SamplerWarning]:
    """What is wrong with the chains, one by one."""
    warnings = []
    for i, run in enumerate(runs):
        record = Record.of(run.running.draws, tune, run.done)
        if record.iterations:
            warning = closing_warning(record, target.growth(run.running.proposal_cov))
            if warning is not None:
                warnings.append(replace(warning, message=f"Chain {i}: {warning.message}"))
    return warnings


def _starts(
    target: Target,
    model: Model,
    initvals: Any,
    seeds: Sequence[np.random.SeedSequence],
    *,
    disperse: bool,
) -> list[Callable[[np.random.Generator], Sequence[np.ndarray]]]:
    """For each chain, a function from its generator to the candidates for its start."""
    _check_initvals(model, initvals, len(seeds))
    points = make_initial_point_fns_per_chain(
        model=model, overrides=initvals, jitter_rvs=set(), chains=len(seeds)
    )
    disperse = disperse and initvals is None

    def candidates(start: np.ndarray, rng: np.random.Generator) -> Sequence[np.ndarray]:
        return target.starts.candidates(start, rng) if disperse else [start]

    # Here and now: chains would call PyMC's functions from several threads at once.
    starts = [
        target.held.join(point(int(seed.generate_state(1)[0])))
        for point, seed in zip(points, seeds, strict=True)
    ]
    return [partial(candidates, start) for start in starts]


def _check_initvals(model: Model, initvals: Any, chains: int) -> None:
    one_for_all = initvals is None or isinstance(initvals, Mapping)
    if not one_for_all:
        if not isinstance(initvals, list | tuple):
            raise ModelError(f"initvals={initvals!r}: expected a mapping, or one for each chain")
        if len(initvals) != chains:
            raise ModelError(f"initvals are for {len(initvals)} chains, chains={chains}")
    known = {name for v, rv in model.values_to_rvs.items() for name in (v.name, rv.name)}
    for given in [initvals] if one_for_all else initvals:
        if unknown := [str(name) for name in given or () if str(name) not in known]:
            raise ModelError(
                f"initvals: {unknown[0]!r} is not a free variable of the model, which are "
                f"{', '.join(rv.name for rv in model.free_RVs)}"
            )


def _checked_cores(cores: object, chains: int) -> int:
    if cores is None:
        return min(chains, available_cores())
    if not is_count(cores) or cores < 1:
        raise ModelError(f"cores={cores!r}: expected an integer, at least 1, or None")
    return cores


def _entropy(random_seed: object) -> list[int]:
    """Turn what PyMC takes for a seed into the entropy of a run."""
    if random_seed is None:
        return np.random.SeedSequence().generate_state(4).tolist()
    if isinstance(random_seed, np.random.Generator):
        return random_seed.integers(2**32, size=4).tolist()
    if not is_count(random_seed) or random_seed < 0:
        raise ModelError(
            f"random_seed={random_seed!r}: expected None, a non-negative integer or a Generator"
        )
    return [int(random_seed)]


def _plain(value: Any) -> Any:
    """A value as JSON knows it, for comparison."""
    if isinstance(value, Mapping):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    return np.asarray(value).tolist() if not isinstance(value, Variable) else str(value)
