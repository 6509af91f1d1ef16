"""All chains of one model: how they begin, and what they become in the end."""

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
from pymc.model import Model
from pymc.stats.convergence import SamplerWarning, log_warnings, run_convergence_checks
from pytensor.graph.basic import Variable
from xarray import DataTree

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.parallel.communicator import Communicator
from pymc_statespace_filters.sampling.checkpoint.checkpoint import Checkpoint
from pymc_statespace_filters.sampling.checkpoint.fingerprint import (
    model_data_fingerprint,
    model_fingerprint,
)
from pymc_statespace_filters.sampling.kernel.state import STAGE
from pymc_statespace_filters.sampling.kernel.transition import evaluate
from pymc_statespace_filters.sampling.output import sample_stats as statistics
from pymc_statespace_filters.sampling.output.datatree import ChainDraws, to_datatree
from pymc_statespace_filters.sampling.output.noise_check import at_the_highest_draw, is_worthwhile
from pymc_statespace_filters.sampling.output.warnings import Record, closing_warning
from pymc_statespace_filters.sampling.run.chain import RunningChain
from pymc_statespace_filters.sampling.run.chain_task import ChainResult, ChainRun, Plan
from pymc_statespace_filters.sampling.target.initvals import chain_starts
from pymc_statespace_filters.sampling.target.settings import DRAMSettings
from pymc_statespace_filters.sampling.target.target import Target
from pymc_statespace_filters.sampling.target.variables import check_no_generators

_SHOWN_DIGITS = 16  # of a fingerprint: 64 bits, in a file and in messages


class Asked(NamedTuple):
    """What the user asked for, the same for all models of a run.

    Attributes
    ----------
    draws, tune, chains : int
    entropy : list of int
        Of all randomness.
    is_seeded : bool
        Whether the user gave a seed.
    initvals : mapping, sequence of mappings, or None
    keeps_warmup : bool
    proposal_cov : array_like or None
    settings : DRAMSettings
    """

    draws: int
    tune: int
    chains: int
    entropy: list[int]
    is_seeded: bool
    initvals: Any
    keeps_warmup: bool
    proposal_cov: Any
    settings: DRAMSettings

    def in_words(self, model: Model, *, strictly: bool = True) -> dict[str, Any]:
        """All that a model's draws depend on, as JSON knows it.

        Raises
        ------
        ModelError
            If a part of the model cannot be recognised in another process; without ``strictly``
            the equations are then left out.
        """
        try:
            fingerprint = model_fingerprint(model)
        except ModelError:
            if strictly:
                raise
            fingerprint = ""
        return {
            "random_seed": self.entropy if self.is_seeded else None,
            "initvals": _plain(self.initvals),
            "proposal_cov": _plain(self.proposal_cov),
            "draws": int(self.draws),
            "tune": int(self.tune),
            "chains": int(self.chains),
            "discard_tuned_samples": not self.keeps_warmup,
            **{f.name: repr(getattr(self.settings, f.name)) for f in fields(self.settings)},
            "model": fingerprint[:_SHOWN_DIGITS],
            "data": model_data_fingerprint(model)[:_SHOWN_DIGITS],
            "version": version("pymc-statespace-filters"),
        }


class ModelRun:
    """The chains of a model.

    Parameters
    ----------
    model : pymc.Model
    asked : Asked
    name : str
        For messages; empty if there is one model alone.
    group : Ranks, optional
        Ranks that evaluate the likelihoods together, of which this is the first.

    Attributes
    ----------
    checkpoint : Checkpoint or None
        Where chains are stored, if they are.

    Raises
    ------
    ModelError
        If the log-density draws random numbers of its own.
    """

    def __init__(
        self, model: Model, asked: Asked, name: str = "", group: Communicator | None = None
    ):
        check_no_generators(model)
        self.model, self.asked, self.name = model, asked, name
        self._group = group
        self.checkpoint: Checkpoint | None = None
        self._target: Target | None = None

    @property
    def is_shared(self) -> bool:
        """Whether other ranks evaluate likelihoods together with this one."""
        return self._group is not None and self._group.size > 1

    @property
    def n_chains(self) -> int:
        """How many chains there are."""
        return self.asked.chains

    def prepare(self) -> Target:
        """Compile the model, and find out where chains may start; done once."""
        if self._target is None:
            asked = self.asked
            self._target = Target(
                self.model, None, asked.settings, asked.proposal_cov, group=self._group
            )
            self._target.prepare()
            seeds = np.random.SeedSequence(asked.entropy).spawn(asked.chains)
            self.plan = Plan(
                asked.tune,
                asked.draws,
                asked.keeps_warmup,
                chain_starts(
                    self.model, self._target, asked.initvals, seeds, disperse=asked.tune > 0
                ),
                seeds,
                is_worthwhile(self._target, asked.tune + asked.draws),
            )
        return self._target

    def chain(self, index: int) -> ChainRun:
        """Make a chain ready to run, from its start or from its checkpoint."""
        target = self.prepare()
        name = f"chain {index} of model {self.name!r}" if self.name else f"chain {index}"
        return ChainRun(target, self.plan, index, self.checkpoint, name)

    def cost(self) -> float:
        """Seconds that a chain will take, roughly: as many evaluations as iterations."""
        bound = self.prepare().density.bind()
        seconds = []
        for _ in range(3):
            began = time.perf_counter()
            evaluate(bound.density)  # reads arrays that live as long as `bound`
            seconds.append(time.perf_counter() - began)
        return min(seconds) * self.plan.n_iterations

    def tree(
        self, results: list[ChainResult], sampling_time: float, checks_convergence: bool
    ) -> DataTree:
        """What ``pm.sample`` returns of the chains; says what is wrong with them.

        The results are taken out of the list one by one, so that draws are in memory twice, but
        never three times.
        """
        target, asked = self.prepare(), self.asked
        warnings, attrs = self._look_at(target, results)
        chains = []
        while results:
            chains.append(_chain_draws(target, results.pop(0), asked.tune))
        tree = to_datatree(
            self.model,
            target.held,
            chains,
            tune=asked.tune,
            keep_warmup=asked.keeps_warmup,
            sampling_time=sampling_time,
        )
        tree.attrs |= {
            "exact": int(target.exact),
            "refresh_noise": int(asked.settings.refresh_noise),
            "correlation": asked.settings.correlation or 0.0,
            **attrs,
        }
        if checks_convergence and "posterior" in tree:
            with (
                suppress(KeyboardInterrupt),  # the draws are there, who does not want to wait
                np.errstate(invalid="ignore", divide="ignore"),  # chains that stand still
            ):
                warnings += run_convergence_checks(tree, self.model)
        if self.name:
            warnings = [replace(w, message=f"Model {self.name!r}: {w.message}") for w in warnings]
        log_warnings(warnings)
        return tree

    def _look_at(
        self, target: Target, results: Sequence[ChainResult]
    ) -> tuple[list[SamplerWarning], dict[str, float]]:
        """What is wrong with the chains one by one, and how noisy their likelihood is."""
        plan = self.plan
        warnings = _chain_warnings(target, results, plan.tune)
        attrs = {}
        if plan.measures_noise and all(r.done == plan.n_iterations for r in results):
            with suppress(KeyboardInterrupt):
                spread, warning = at_the_highest_draw(
                    [result.draws for result in results],
                    plan.tune if plan.draws else 0,
                    RunningChain(target, 0, 0).seed_spread,
                    [result.key for result in results],
                )
                attrs["log_likelihood_variance"] = spread.variance
                warnings += filter(None, [warning])
        return warnings, attrs


def _chain_draws(target: Target, result: ChainResult, tune: int) -> ChainDraws:
    """What a chain has drawn, with its statistics: copies, which need the draws no more."""
    draws, done = result.draws, result.done
    stats = {
        name: values.copy()
        for name, values in statistics.of_draws(target, draws, slice(0, done)).items()
    }
    moved = draws.counts[:done, STAGE] > 0
    stats["accept_rate"] = np.concatenate(
        [np.cumsum(phase) / np.arange(1, phase.size + 1) for phase in np.split(moved, [tune])]
    )
    frozen = result.proposal_cov
    covs = np.broadcast_to(frozen, (done, *frozen.shape))  # of the draws, where the warm-up goes
    if len(draws.covs):
        covs = np.concatenate([draws.covs[:done], covs[tune:]])
    return ChainDraws(draws.positions[:done].copy(), stats | {"proposal_cov": covs})


def _chain_warnings(
    target: Target, results: Sequence[ChainResult], tune: int
) -> list[SamplerWarning]:
    """What is wrong with the chains, one by one."""
    warnings = []
    for i, result in enumerate(results):
        record = Record.of(result.draws, tune, result.done)
        if record.iterations:
            warning = closing_warning(record, target.growth(result.proposal_cov))
            if warning is not None:
                warnings.append(replace(warning, message=f"Chain {i}: {warning.message}"))
    return warnings


def _plain(value: Any) -> Any:
    """A value as JSON knows it, for comparison."""
    if isinstance(value, Mapping):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    return np.asarray(value).tolist() if not isinstance(value, Variable) else str(value)
