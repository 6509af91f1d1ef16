"""``sample_dram`` and ``run_models``: whole chains in machine code, with ``pm.sample``'s result."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np
from pymc.model import Model, modelcontext
from xarray import DataTree

from pymc_statespace_filters.errors import ModelError
from pymc_statespace_filters.sampling.checkpoint.checkpoint import folder_name
from pymc_statespace_filters.sampling.run.driver import How, sample_models
from pymc_statespace_filters.sampling.run.model_task import Asked
from pymc_statespace_filters.sampling.run.warm_start import with_head_start
from pymc_statespace_filters.sampling.target.settings import DRAMSettings
from pymc_statespace_filters.system.checks import is_integer


@overload
def sample_dram(
    draws: int = ..., tune: int = ..., *, comm: None = ..., **settings: Any
) -> DataTree: ...


@overload
def sample_dram(
    draws: int = ..., tune: int = ..., *, comm: Any, **settings: Any
) -> DataTree | None: ...


def sample_dram(
    draws: int = 1000,
    tune: int = 1000,
    *,
    chains: int = 4,
    cores: int | None = None,
    model: Model | None = None,
    random_seed: int | np.random.Generator | None = None,
    initvals: Mapping[str, Any] | Sequence[Mapping[str, Any] | None] | None = None,
    pilot: DataTree | None = None,
    progressbar: bool | str = True,
    discard_tuned_samples: bool = True,
    compute_convergence_checks: bool = True,
    checkpoint: str | os.PathLike | None = None,
    comm: Any = None,
    ranks_per_chain: int = 1,
    gather: str = "root",
    **dram_settings: Any,
) -> DataTree | None:
    """Sample a model by delayed rejection adaptive Metropolis, each chain whole in machine code.

    The same transitions as ``pm.sample(step=psf.DRAM())``, without Python between one draw and the
    next: a draw costs what its likelihood costs. Chains run in threads, and on several machines
    with MPI.

    Parameters
    ----------
    draws, tune : int
        Iterations of each chain that are kept, and of warm-up before them, in which the proposals
        are learnt.
    chains : int
    cores : int, optional
        Threads, on each rank. Default: as many as there are processors, at most one for each chain.
        The draws do not depend on it.
    model : pymc.Model, optional
        Default: the model of the ``with`` block. All its free variables must be continuous.
    random_seed : int or numpy.random.Generator, optional
    initvals : dict, or sequence of dict, optional
        Starting values, for all chains or for each, as in ``pm.sample``. Default: with
        ``tune > 0``, the best of a few draws from the prior.
    pilot : xarray.DataTree, optional
        Draws of a posterior that lies close: that of the same parameters with a cheaper filter.
        Chains begin where its chains ended. They propose as these did in the end, if they were of
        DRAM and had learnt it, else by the covariance of the draws; the warm-up learns no more
        unless ``adapt_every`` or ``adaptation`` is given. A mode that the pilot has not found is
        not found so. With ``checkpoint`` the pilot must be the same each time; with
        ``comm`` all ranks give it (``gather="all"``).
    progressbar : bool or str
        As in ``pm.sample``.
    discard_tuned_samples : bool
        Whether to leave out the warm-up; else it is kept in groups ``warmup_posterior`` and
        ``warmup_sample_stats``.
    compute_convergence_checks : bool
        As in ``pm.sample``: whether R-hat and effective sample sizes are judged at the end, which
        takes long for many draws. What the chains themselves have met is said regardless.
    checkpoint : str or path, optional
        A folder, in which the chains are stored every few seconds. If the process ends, in whatever
        way, the same call goes on from there, and gives to the bit what it would have given. With
        ``comm``, all ranks must see it.
    comm : mpi4py.MPI.Comm or "world", optional
        Ranks over which the chains are spread; all of them make this call. "world" are all that
        ``mpiexec`` started, and this process alone if there was no ``mpiexec``. The draws do not
        depend on the number of ranks.
    ranks_per_chain : int
        So many ranks evaluate the likelihoods of a chain together, each on its own part of the
        particles: for likelihoods of seconds.
    gather : {"root", "all"}
        Which ranks get the result.
    **dram_settings
        Settings of `DRAM`: ``stages``, ``stage_scale``, ``adaptation``, ``adapt_every``,
        ``proposal_cov``, ``refresh_noise``, ``screen``, ``screen_power``, ``correlation``.

    Returns
    -------
    xarray.DataTree
        As ``pm.sample`` returns it; None on ranks that do not get it. After Ctrl-C, what was drawn
        until then. The attributes ``exact`` (whether the chains target the posterior itself,
        without the bias of a filter), ``refresh_noise`` and ``correlation`` say what the draws are;
        ``log_likelihood_variance``, of a run of 600 iterations or more with a noisy likelihood, is
        the variance of the estimated log-likelihood over 12 noise seeds at the draw of highest
        density.

    Raises
    ------
    ModelError
        If an argument is not as described, a free variable is discrete, the log-density draws
        random numbers of its own, or no starting point with finite log-density is found.
    DataMismatchError
        If the checkpoint is of a run with other arguments, another model or other data, if ranks
        differ in these, or if the pilot does not have the parameters of the model.
    ParallelError
        If another rank has failed; the message names the rank, the chain and the error.

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
    asked = _asked(
        draws, tune, chains, random_seed, initvals, not discard_tuned_samples, dram_settings
    )
    if pilot is not None:
        adapts = not dram_settings.keys().isdisjoint({"adapt_every", "adaptation"})
        asked = with_head_start(asked, model, pilot, adapts=adapts)
    how = How(cores, progressbar, compute_convergence_checks, comm, ranks_per_chain, gather)
    trees = sample_models({"": model}, asked, how, [] if checkpoint is None else [checkpoint])
    return None if trees is None else trees[""]


@overload
def run_models(
    models: Mapping[str, Model], *, comm: None = ..., **settings: Any
) -> dict[str, DataTree]: ...


@overload
def run_models(
    models: Mapping[str, Model], *, comm: Any, **settings: Any
) -> dict[str, DataTree] | None: ...


def run_models(
    models: Mapping[str, Model],
    *,
    draws: int = 1000,
    tune: int = 1000,
    chains: int = 4,
    cores: int | None = None,
    random_seed: int | np.random.Generator | None = None,
    initvals: Mapping[str, Any] | None = None,
    progressbar: bool | str = True,
    discard_tuned_samples: bool = True,
    compute_convergence_checks: bool = True,
    checkpoint: str | os.PathLike | None = None,
    comm: Any = None,
    ranks_per_chain: int = 1,
    gather: str = "root",
    **dram_settings: Any,
) -> dict[str, DataTree] | None:
    """Sample several models at once, as `sample_dram` samples one.

    All chains of all models share the threads, and with MPI the ranks: a free one takes the next
    chain, of the dearest model first.

    Parameters
    ----------
    models : mapping of str to pymc.Model
    draws, tune, chains, cores, random_seed, initvals
        As in `sample_dram`, for every model. A model's draws are those of `sample_dram` with the
        same seed, whatever the other models.
    progressbar, discard_tuned_samples, compute_convergence_checks
        As in `sample_dram`.
    checkpoint : str or path, optional
        A folder, in which each model has one of its own. If the process ends, in whatever way, the
        same call goes on from there.
    comm, ranks_per_chain, gather
        As in `sample_dram`.
    **dram_settings
        Settings of `DRAM`.

    Returns
    -------
    dict of str to xarray.DataTree
        As `sample_dram` returns them; None on ranks that do not get them.

    Raises
    ------
    ModelError, DataMismatchError, ParallelError
        As `sample_dram`.

    Examples
    --------
    >>> import pymc as pm
    >>> import pymc_statespace_filters as psf
    >>> rivals = {}
    >>> for name, sd in (("narrow", 1.0), ("wide", 5.0)):
    ...     with pm.Model() as rivals[name]:
    ...         mu = pm.Normal("mu", 0, sd)
    ...         y = pm.Normal("y", mu, 1.0, observed=[1.2, 0.7, 2.9, 1.8])
    >>> trees = psf.run_models(rivals, draws=200, tune=200, random_seed=1, progressbar=False)
    >>> {name: tree["posterior"]["mu"].shape for name, tree in trees.items()}
    {'narrow': (4, 200), 'wide': (4, 200)}
    """
    if not isinstance(models, Mapping) or not models:
        raise ModelError(f"models={models!r}: expected a mapping from names to pymc.Model")
    for name, model in models.items():
        if not isinstance(name, str) or not name:
            raise ModelError(f"models: {name!r} is no name: expected a text")
        if not isinstance(model, Model):
            raise ModelError(f"models[{name!r}] must be a pymc.Model, got {model!r}")
    asked = _asked(
        draws, tune, chains, random_seed, initvals, not discard_tuned_samples, dram_settings
    )
    how = How(cores, progressbar, compute_convergence_checks, comm, ranks_per_chain, gather)
    folders = [] if checkpoint is None else [Path(checkpoint, folder_name(n)) for n in models]
    return sample_models(models, asked, how, folders)


def _asked(
    draws: int,
    tune: int,
    chains: int,
    random_seed: Any,
    initvals: Any,
    keeps_warmup: bool,
    dram_settings: dict[str, Any],
) -> Asked:
    """Check what is asked for, apart from the model."""
    for name, value, least in (("draws", draws, 0), ("tune", tune, 0), ("chains", chains, 1)):
        if not is_integer(value) or value < least:
            raise ModelError(f"{name}={value!r}: expected an integer, at least {least}")
    if draws + tune * keeps_warmup == 0:
        raise ModelError(
            f"draws={draws}, tune={tune}, discard_tuned_samples={not keeps_warmup}: nothing would "
            f"be kept; for the warm-up alone say discard_tuned_samples=False"
        )
    proposal_cov = dram_settings.pop("proposal_cov", None)
    return Asked(
        draws,
        tune,
        chains,
        _entropy(random_seed),
        random_seed is not None,
        initvals,
        keeps_warmup,
        proposal_cov,
        DRAMSettings.of(dram_settings),
    )


def _entropy(random_seed: object) -> list[int]:
    """Turn what PyMC takes for a seed into the entropy of a run."""
    if random_seed is None:
        return np.random.SeedSequence().generate_state(4).tolist()
    if isinstance(random_seed, np.random.Generator):
        return random_seed.integers(2**32, size=4).tolist()
    if not is_integer(random_seed) or random_seed < 0:
        raise ModelError(
            f"random_seed={random_seed!r}: expected None, a non-negative integer or a Generator"
        )
    return [int(random_seed)]
