"""`sample_dram`: whole chains in machine code, results as from ``pm.sample``."""

import os
from collections.abc import Mapping, Sequence
from typing import Any, overload

import numpy as np
from pymc.model import Model
from xarray import DataTree

from ..former_names import former_names
from ..pymc_model.inspection import given_model
from .checkpoint.checkpoint import checked_folder
from .run.driver import sample_models
from .run.request import RunArguments
from .run.warm_start import warm_started


@overload
def sample_dram(
    draws: int = ..., tune: int = ..., *, comm: None = ..., **settings: Any
) -> DataTree: ...


@overload
def sample_dram(
    draws: int = ..., tune: int = ..., *, comm: Any, **settings: Any
) -> DataTree | None: ...


@former_names  # type: ignore[misc]  # overloads name a few arguments
def sample_dram(
    draws: int = 1000,
    tune: int = 1000,
    *,
    until_ess: float | None = None,
    max_draws: int | None = None,
    thin: int = 1,
    chains: int = 4,
    cores: int | None = None,
    model: Model | None = None,
    random_seed: int | np.random.Generator | None = None,
    initvals: Mapping[str, Any] | Sequence[Mapping[str, Any] | None] | None = None,
    pilot: DataTree | None = None,
    kernel: Mapping[str, Any] | None = None,
    progressbar: bool | str = True,
    discard_tuned_samples: bool = True,
    compute_convergence_checks: bool = True,
    check: bool = True,
    checkpoint: str | os.PathLike | None = None,
    comm: Any = None,
) -> DataTree | None:
    """Sample a model by adaptive Metropolis-Hastings, with whole chains in machine code.

    Chains start in the posterior, which a population finds first, see `find_starts`. Some proposals
    are the random walk of `DRAM` with delayed rejection, the others are drawn from a mixture of
    Student-t distributions. It is fitted to the draws of all chains after each quarter of the
    warm-up, and its share of the proposals follows the jumps that it has made. Both are then
    frozen, so that the draws are exact, with an estimated likelihood too. There is no Python
    between the draws: one costs as much as its likelihood. Chains run in threads, and with MPI on
    several machines.

    If a model has a panel of several records (``StateSpace(panel=)``) and parameters that belong to
    single ones, the records are moved one by one: each makes a random walk in its own parameters,
    accepted by its own estimate of its likelihood, which it then keeps. Parameters of the
    population make random walks without a likelihood, shared ones are accepted by the likelihoods
    of all records. This too is exact. There is no delayed rejection and no mixture, each record
    starts at the likeliest of fifty draws of its prior, and ``sample_stats`` has the acceptance
    (``record_accepted``) and the noise seed of each record.

    Parameters
    ----------
    draws, tune : int
        Draws of each chain that are kept, and iterations of the warm-up before them, during which
        the proposals are adapted. Default of ``draws``: 1000, or ``max_draws`` if that is less.
    until_ess : float, optional
        Go on until the effective sample sizes of every parameter, over all chains, of the bulk and
        of the tails, are at least this and no R-hat is above 1.01, which takes four chains some 400
        to 1000 effective draws. Both are checked after ``draws`` draws, and then whenever there are
        half as many again. All chains end with the same number of draws, which depends on the draws
        alone. Default: stop after ``draws``.
    max_draws : int, optional
        With ``until_ess``, the most draws of each chain, after which a warning says what was
        reached. Default: 20 times ``draws``.
    thin : int
        Iterations of which one draw, the last, is kept. A draw costs as much as they all, and is
        stored once: it pays where chains mix slowly. The warm-up is kept whole.
    chains : int
        Independent chains, whose agreement R-hat measures.
    cores : int, optional
        Threads on each rank. Default: the number of available processors, at most the number of
        chains. The draws do not depend on it.
    model : pymc.Model, optional
        Default: the model of the ``with`` block. All its free variables must be continuous.
    random_seed : int or numpy.random.Generator, optional
        The draws follow from it and the number of chains alone. Default: other draws at every call.
    initvals : dict, or sequence of dict, optional
        Initial values, for all chains or for each, as in ``pm.sample``. Default: with
        ``tune > 0``, points of a population that is led from the prior to the posterior; the best
        of a few draws from the prior if a prior is improper, or with ``correlation``. With a
        particle, ensemble or grid filter the population is smaller if ``chains * tune`` is below
        4000, and there is none below 800.
    pilot : xarray.DataTree, optional
        Draws from a posterior close to the model's, such as that of the same parameters with a
        cheaper filter. Chains start at the last draws of its chains. Their proposal covariance is
        the one that its chains used last, if they were sampled and adapted by DRAM, else that of
        its draws; it is adapted only if the ``adapt_every`` or ``adaptation`` of ``kernel`` is not
        the default. Independence
        proposals come from a mixture fitted to some 500 of its draws, from the first iteration. A
        mode that the pilot has missed is missed again. If the pilot lacks some variables of the
        model, as that of a smaller model does, the search for starts begins at its draws, completed
        by draws of the prior, and ``tune`` must be positive. Other variables of the pilot are
        ignored. With ``checkpoint`` the pilot must be the same in each call; with ``comm`` all
        ranks pass it, which ``{"gather": "all"}`` gives them.
    kernel : mapping of str to object, optional
        Settings of the random walk: the keywords of `DRAM` from ``stages`` to ``correlation``, as
        in ``{"stages": 1, "screen": psf.EKF()}``. Where records are moved one by one, ``stages``
        must be 1 or the default, ``screen`` and ``correlation`` None, and of ``proposal_cov`` each
        block takes its own part.
    progressbar : bool or str
        As in ``pm.sample``. Beside what that shows, the largest R-hat and the smallest bulk
        effective sample size so far, computed every two seconds, or as often as takes 1 % of the
        time; with ``comm``, of the chains that run on rank 0 and those that have ended. Unless it
        is False, a report on the run is logged at its end at level INFO, by the logger
        "pymc.stats.convergence"; otherwise at level DEBUG.
    discard_tuned_samples : bool
        Whether to leave out the warm-up; otherwise it is in the groups ``warmup_posterior`` and
        ``warmup_sample_stats``.
    compute_convergence_checks : bool
        As in ``pm.sample``: whether R-hat and effective sample sizes are checked at the end, which
        takes long for many draws. Warnings about single chains are given in any case.
    check : bool
        Whether filters that are not exact for their systems are compared with unbiased ones at the
        end, as by `check_filter`, in a second or a tenth of the time of the run; not after fewer
        than 600 iterations, or without ``compute_convergence_checks``.
    checkpoint : str or path, optional
        A folder in which the chains are stored every few seconds. If the process ends for any
        reason, the same call resumes the run and returns bitwise the same draws as an uninterrupted
        one. With ``comm``, the first rank alone reads and writes it.
    comm : mpi4py.MPI.Comm, "world" or mapping, optional
        Ranks over which the chains are distributed; all of them make this call. "world" is all
        ranks started by ``mpiexec``, or this process alone without ``mpiexec``. A mapping says
        more: ``"comm"``, "world" by default; ``"per_chain"``, the number of ranks that evaluate the
        likelihoods of a chain together, each on its part of the particles, which divides the number
        of ranks and is for likelihoods that take seconds, 1 by default; and ``"gather"``, the ranks
        that get the result, ``"root"`` by default or ``"all"``. The draws do not depend on the
        number of ranks.

    Returns
    -------
    xarray.DataTree
        As returned by ``pm.sample``; None on ranks that do not get it. After Ctrl-C, the draws made
        until then: of the chains that together have most, cut to one length; a warning names those
        left out. The attributes ``exact`` (1 if the chains target the posterior itself, 0 if one
        with the bias of a filter), ``refresh_noise`` (0 or 1) and ``correlation`` describe the
        target, and ``filter``, a JSON text, names the filter of every StateSpace variable:
        ``'{"d": "BootstrapPF(200)"}'``.
        ``log_likelihood_variance``, for runs of at least 600 iterations with a noisy likelihood, is
        the variance of the estimated log-likelihood over 12 noise seeds at the draw of highest
        density; of the record whose variance is largest, if records are moved one by one.
        ``filter_check``, a JSON text, has the outcome of that check for every StateSpace variable.

    Raises
    ------
    ModelError
        If an argument is not as described, a free variable is discrete, the log-density draws
        random numbers, or no starting point with finite log-density is found.
    DataMismatchError
        If the checkpoint belongs to a run with other arguments, another model or other data, if
        ranks differ in these, or if the pilot has no parameter of the model, or one of another
        shape or outside its support.
    ParallelError
        If another rank has failed; the message names the rank, the chain and the error.
    CheckpointError
        If a file of the checkpoint cannot be written or read.

    Warns
    -----
    FilterWarning
        If a filter is found to be off, with another one that works. The report says where it is
        not, and where that could not be decided.

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
    model = given_model(model)
    given = RunArguments(
        draws=draws, tune=tune, until_ess=until_ess, max_draws=max_draws, thin=thin,
        chains=chains, cores=cores, random_seed=random_seed, initvals=initvals, kernel=kernel,
        progressbar=progressbar, discard_tuned_samples=discard_tuned_samples,
        compute_convergence_checks=compute_convergence_checks, check=check,
    )  # fmt: skip
    request = given.request()
    if pilot is not None:
        request = warm_started(request, model, pilot)
    options = given.options(comm)
    folders = [] if checkpoint is None else [checked_folder(checkpoint)]
    trees = sample_models({"": model}, [request], options, folders)
    return None if trees is None else trees[""]
