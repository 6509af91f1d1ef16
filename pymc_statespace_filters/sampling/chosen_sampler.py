"""`sample`: one call that chooses the sampler."""

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pymc.model import Model
from xarray import DataTree

from ..errors import ModelError
from ..parallel.cpu_affinity import available_cores
from ..parallel.signals import keeps_what_is_there
from ..pymc_model.density import check_free_variables
from ..pymc_model.inspection import given_model
from .checkpoint.checkpoint import checked_folder
from .choice import BOTH, DRAM, MOST_THIN, NUTS, Choice, what_nuts_lacks, why_dram, why_no_nuts
from .output.convergence import FEWEST
from .output.facts import of_model
from .race import race
from .run.continuation import appended, former_chains
from .run.driver import sample_models
from .run.request import RunArguments, SamplingRequest
from .run.stopping import AUTO, target_ess

_SAMPLERS = ("auto", NUTS, DRAM)
_NAMES = {DRAM: "DRAM", NUTS: "NUTS", BOTH: "DRAM, then NUTS"}
# CPU seconds of each processor, within which chains go on to reach ``until_ess``.
TIME_LIMIT = 300.0

_log = logging.getLogger("pymc.sampling.psf")


def sample(
    draws: int = 1000,
    tune: int = 1000,
    *,
    model: Model | None = None,
    until_ess: float | str | None = AUTO,
    max_draws: int | None = None,
    chains: int = 4,
    cores: int | None = None,
    sampler: str = "auto",
    kernel: Mapping[str, Any] | None = None,
    continue_from: DataTree | None = None,
    initvals: Mapping[str, Any] | Sequence[Mapping[str, Any] | None] | None = None,
    random_seed: int | np.random.Generator | None = None,
    progressbar: bool | str = True,
    check: bool = True,
    checkpoint: str | os.PathLike | None = None,
    comm: Any = None,
) -> DataTree | None:
    """Draw from the posterior of a model, by the sampler that suits it.

    The random walk of `sample_dram` runs first, from points found as by `find_starts`, and again
    from its own points where its draws are not worth enough. Where 256 ``draws`` iterations of each
    chain are too few, and every likelihood has a gradient, NUTS (of nutpie) starts at its points.
    Where NUTS takes more evaluations than the walk would, or diverges, the walk goes on from the
    points that are worth most. The report says what was tried, and what came of it.

    A draw is the last of k iterations. First k is 1; it is doubled, and every second draw dropped,
    until the draws are worth ``until_ess``. The result has the size of ``draws``, however slowly
    the chains mix, and the report says how many iterations stand behind a draw.

    Parameters
    ----------
    draws, tune : int
        Draws of each chain that are kept, and iterations of its warm-up, which are not. Default of
        ``draws``: 1000, or ``max_draws`` if that is less. NUTS needs a warm-up; in the race, where
        it has the scales of the walk's points, a third of ``tune``.
    model : pymc.Model, optional
        Default: the model of the ``with`` block. Its free variables must be continuous.
    until_ess : float or "auto", optional
        Effective draws of every parameter over all chains, of the bulk and of the tails, with R-hat
        of at most 1.01. If fewer than n = 800 draws are kept in all, the limit is 1 + 8 / n.
        Default: 400, or n / 2 if that is less. None keeps the first ``draws`` iterations.
    max_draws : int, optional
        Iterations of each chain at most, of every run of a race. Default: 1024 times ``draws`` with
        the random walk, 64 times with NUTS. The run also ends where the next doubling would
        take it beyond five minutes of the time of each of its processors, or where chains of NUTS
        diverge and the last doubling has made them worth little more; a warning says what would do.
        Apart from the limit of time, the result and the sampler depend on ``random_seed`` and the
        number of chains alone: the race counts evaluations.
    chains, cores : int
        Number of chains, and of those that run at a time. Default: as many as there are processors.
    sampler : {"auto", "nuts", "dram"}
        The sampler, if there is to be no race.
    kernel : mapping of str to object, optional
        Settings of the random walk, as in `sample_dram`; with them it is the sampler.
    continue_from : xarray.DataTree, optional
        Draws of an earlier call, or of `sample_dram`, whose chains go on: ``draws`` are appended,
        bit for bit those of one longer run, without a warm-up. Model, data, ``chains`` and
        ``kernel`` must be the same, and as many iterations stand behind a draw; ``tune`` and
        ``until_ess`` are not used. Draws of NUTS cannot go on.
    initvals : dict, or sequence of dict, optional
        Initial values of all chains or, with the random walk, of each.
    random_seed : int or numpy.random.Generator, optional
    progressbar : bool or str
        As in ``pm.sample``. If it is False, nothing but warnings is logged.
    check : bool
        Whether filters are compared with unbiased ones at the end, as in `sample_dram`.
    checkpoint, comm
        As in `sample_dram`, which then is the sampler.

    Returns
    -------
    xarray.DataTree
        As returned by ``pm.sample``, with the attributes of `sample_dram`, and ``sampler``,
        ``sampler_reason`` and ``iterations_per_draw``. None on ranks that do not get it.

    Raises
    ------
    ModelError
        If an argument is not as described, or asks for what the sampler cannot do.
    DataMismatchError, ParallelError, CheckpointError
        As `sample_dram`.

    Warns
    -----
    FilterWarning
        As `sample_dram`.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> with pm.Model():
    ...     mu = pm.Normal("mu", 0, 10)
    ...     sigma = pm.HalfNormal("sigma", 2)
    ...     y = pm.Normal("y", mu, sigma, observed=[1.2, 0.7, 2.9, 1.8])
    ...     idata = psf.sample(500, random_seed=1, progressbar=False)
    >>> idata["posterior"]["mu"].shape, idata.attrs["sampler"]
    ((4, 500), 'dram')
    """
    given = RunArguments(
        draws=draws, tune=tune, until_ess=until_ess, max_draws=max_draws, chains=chains,
        cores=cores, random_seed=random_seed, initvals=initvals, kernel=kernel,
        progressbar=progressbar, check=check,
    )  # fmt: skip
    return sample_named(
        "", given_model(model), given, sampler, continue_from=continue_from, checkpoint=checkpoint,
        comm=comm,
    )  # fmt: skip


@keeps_what_is_there
def sample_named(
    name: str,
    model: Model,
    given: RunArguments,
    sampler: str,
    *,
    continue_from: DataTree | None = None,
    checkpoint: str | os.PathLike | None = None,
    comm: Any = None,
) -> DataTree | None:
    """`sample` a model whose messages have its name, if it has one."""
    check_free_variables(model)
    only_dram = {
        "kernel": given.kernel,
        "continue_from": continue_from,
        "checkpoint": checkpoint,
        "comm": comm,
    }
    choice = _choice(model, sampler, only_dram, given)
    request = request_of(choice.sampler, given)
    if continue_from is not None:
        request = _continued(request, continue_from, model)
    level = logging.INFO if given.progressbar else logging.DEBUG
    _log.log(level, "%s%s: %s", of_model(name), _NAMES[choice.sampler], choice.reason)
    options = given.options(comm)
    tree: DataTree | None
    if choice.sampler == BOTH:
        goal = request.until_ess or target_ess(AUTO, given.draws, given.chains)
        tree, choice = race(model, request, goal, options, name)
    elif choice.sampler == NUTS:
        from .nuts.sample_nuts import sample_nuts  # nutpie takes longer to import than the rest

        tree = sample_nuts(model, request, options, name)
    else:
        folders = [] if checkpoint is None else [checked_folder(checkpoint)]
        trees = sample_models({name: model}, [request], options, folders)
        tree = None if trees is None else trees[name]
        if continue_from is not None and tree is not None:
            tree = appended(continue_from, tree)
            reason = continue_from.attrs.get("sampler_reason", choice.reason)
            choice = choice._replace(reason=reason)
    if tree is not None:
        tree.attrs |= {"sampler": choice.sampler, "sampler_reason": choice.reason}
    return tree


def _choice(
    model: Model, sampler: Any, only_dram: Mapping[str, Any], given: RunArguments
) -> Choice:
    """The sampler that the user has named, or that the model and the arguments ask for."""
    if sampler not in _SAMPLERS:
        raise ModelError(f"sampler must be one of {_SAMPLERS}, got {sampler!r}")
    asked = [name for name, value in only_dram.items() if value is not None]
    if sampler == NUTS:
        if asked:
            raise ModelError(f"{asked[0]} must be None with sampler='nuts': sampler='dram' has it")
        if reason := why_no_nuts(model):
            raise ModelError(f"sampler must be 'dram' for this model, got 'nuts': {reason}")
        if given.tune == 0:
            raise ModelError("tune must be at least 1 with sampler='nuts', got 0")
    if sampler != "auto":
        return Choice(sampler, f"sampler={sampler!r}")
    if reason := what_nuts_lacks(only_dram):
        return Choice(DRAM, reason)
    if given.tune == 0:
        return Choice(DRAM, "NUTS needs a warm-up, and tune is 0")
    if given.draws < FEWEST:
        return Choice(DRAM, "so few draws do not show what they are worth")
    reason = why_dram(model)
    if reason:
        return Choice(DRAM, reason)
    return Choice(BOTH, "NUTS runs only if DRAM takes too many iterations")


def request_of(sampler: str, given: RunArguments) -> SamplingRequest:
    """What `sample` asks of a sampler."""
    until_ess = target_ess(given.until_ess, given.draws, given.chains)
    if until_ess is None:
        is_default = given.until_ess == AUTO  # so few draws end where they are
        most = None if is_default else given.max_draws
        return replace(given, until_ess=None, max_draws=most).request()
    request = replace(given, until_ess=until_ess).request()
    most = given.max_draws or MOST_THIN[sampler] * given.draws
    seconds = TIME_LIMIT * min(given.chains, given.cores or available_cores())
    return request._replace(max_draws=most, doubles_thin=True, seconds=seconds)


def _continued(request: SamplingRequest, idata: DataTree, model: Model) -> SamplingRequest:
    """The request of more draws of the chains of ``idata``."""
    for name, value in {
        "initvals": request.initvals,
        "random_seed": request.entropy if request.is_seeded else None,
    }.items():
        if value is not None:
            raise ModelError(f"{name} must be None with continue_from, whose chains have theirs")
    former = former_chains(idata, model, request.settings, request.chains)
    return request._replace(
        tune=0, thin=former.thin, until_ess=None, max_draws=None, doubles_thin=False, former=former
    )
