"""`run_models`: the posteriors of several models in one call, by chains or by particles."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import fields
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
from pymc.model import Model
from xarray import DataTree

from .errors import ModelError
from .facts import tell
from .former_names import former_names
from .parallel.signals import keeps_what_is_there, unless_interrupted
from .parameter_particles import sample_smc
from .pymc_model.density import check_free_variables
from .sampling.checkpoint.checkpoint import checked_folder, folder_name
from .sampling.choice import DRAM, what_nuts_lacks
from .sampling.chosen_sampler import request_of, sample, sample_named
from .sampling.output.facts import WithoutDraws
from .sampling.run.driver import sample_models
from .sampling.run.request import RunArguments
from .sampling.run.stopping import AUTO
from .sampling.run.warm_start import warm_started_models

_OF_SAMPLE = {"model", "sampler", "continue_from", "checkpoint", "comm"}
_SAMPLERS = {
    "auto": ("sample", signature(sample).parameters.keys() - _OF_SAMPLE),
    "nuts": ("sample", signature(sample).parameters.keys() - _OF_SAMPLE),
    "dram": ("sample_dram", {field.name for field in fields(RunArguments)}),
    "smc": (
        "sample_smc",
        signature(sample_smc).parameters.keys() - {"model", "checkpoint", "comm"},
    ),
}


@overload
def run_models(
    models: Mapping[str, Model], *, comm: None = ..., **settings: Any
) -> dict[str, DataTree]: ...


@overload
def run_models(
    models: Mapping[str, Model], *, comm: Any, **settings: Any
) -> dict[str, DataTree] | None: ...


@former_names
@keeps_what_is_there
def run_models(
    models: Mapping[str, Model],
    *,
    sampler: Literal["auto", "nuts", "dram", "smc"] = "auto",
    pilot: DataTree | Mapping[str, DataTree] | None = None,
    checkpoint: Any = None,
    comm: Any = None,
    **settings: Any,
) -> dict[str, DataTree] | None:
    """Sample several models in one run, each as by `sample`, `sample_dram` or `sample_smc`.

    Runs of `sample` and `sample_smc`, each of which uses all threads, follow one another; those of
    `sample_smc` store the evidences for `compare_evidence`. The chains of `sample_dram` of all
    models share the threads, and with MPI the ranks: an idle thread takes the next chain, most
    expensive model first.

    Parameters
    ----------
    models : mapping of str to pymc.Model
    sampler : {"auto", "nuts", "dram", "smc"}
        "auto" and "nuts" are those of `sample`, "dram" is `sample_dram`, and "smc" `sample_smc`.
        With ``comm``, ``checkpoint`` or ``kernel`` "auto" is the random walk, as in `sample`, whose
        chains share threads and ranks.
    pilot : xarray.DataTree, or mapping of str to xarray.DataTree, optional
        As in `sample_dram`, of the models with these names. A single one is the pilot of every
        model that has a free variable in common with it. Only with "dram".
    checkpoint : str or path, optional
        A folder with a subfolder for each model. If the process ends for any reason, the same call
        resumes the run.
    comm
        As in `sample_dram`.
    **settings
        The other arguments of the sampler, for every model; of `sample` ``draws``, ``tune``,
        ``until_ess``, ``max_draws``, ``chains``, ``cores``, ``kernel``, ``initvals``,
        ``random_seed``, ``progressbar`` and ``check``, of `sample_dram` also ``thin``,
        ``discard_tuned_samples`` and ``compute_convergence_checks``. A model's draws are those of
        the sampler with the same seed and do not depend on the other models; with ``until_ess``
        each stops on its own.

    Returns
    -------
    dict of str to xarray.DataTree
        As returned by the sampler; None on ranks that do not get them. After Ctrl-C, or an error of
        a model whose run follows those of others, those of the models that have draws; a warning
        names the others, with the error.

    Raises
    ------
    ModelError, DataMismatchError, ParallelError, CheckpointError
        As the sampler, if there are no draws of any model.

    Warns
    -----
    FilterWarning, EvidenceWarning
        As the sampler.

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
    if sampler not in _SAMPLERS:
        raise ModelError(f"sampler must be one of {tuple(_SAMPLERS)}, got {sampler!r}")
    name, known = _SAMPLERS[sampler]
    if unknown := settings.keys() - known:
        raise TypeError(
            f"run_models() got an unexpected keyword argument {min(unknown)!r}: its settings are "
            f"those of {name}, without model"
        )
    _check_models(models)
    folders = []
    if checkpoint is not None:
        folder = checked_folder(checkpoint)
        folders = [Path(folder, folder_name(name)) for name in models]
    if sampler != "dram" and pilot is not None:
        raise ModelError(
            f"pilot must be None with sampler={sampler!r}: sampler='dram' starts from one"
        )
    of_walk = {"kernel": settings.get("kernel"), "checkpoint": checkpoint, "comm": comm}
    if sampler == "auto" and (reason := what_nuts_lacks(of_walk)):
        given = RunArguments(**{"until_ess": AUTO, **settings})
        requests = [request_of(DRAM, given)] * len(models)
        trees = sample_models(models, requests, given.options(comm), folders)
        for tree in (trees or {}).values():
            tree.attrs |= {"sampler": DRAM, "sampler_reason": reason}
        return trees
    if sampler != "dram":
        stored_in = dict(zip(models, folders, strict=False))
        run = _by_particles if sampler == "smc" else partial(_by_chains, sampler)
        return _one_by_one(models, run, settings, stored_in, comm)
    given = RunArguments(**settings)
    requests = warm_started_models(given.request(), models, pilot)
    return sample_models(models, requests, given.options(comm), folders)


def _check_models(models: Mapping[str, Model]) -> None:
    """Raise unless these are models with names, and all can be sampled."""
    if not isinstance(models, Mapping) or not models:
        raise ModelError(
            f"models must be a non-empty mapping of names to pymc.Model, got {models!r}"
        )
    for name, model in models.items():
        if not isinstance(name, str) or not name:
            raise ModelError(f"names of models must be non-empty strings, got {name!r}")
        if not isinstance(model, Model):
            raise ModelError(f"models[{name!r}] must be a pymc.Model, got {model!r}")
    for name, model in models.items():
        with _named(name):
            check_free_variables(model)


@contextmanager
def _named(name: str) -> Iterator[None]:
    """Say of an error in which model it is."""
    try:
        yield
    except Exception as error:
        error.add_note(f"in model {name!r}")
        raise


def _by_particles(name: str, model: Model, **settings: Any) -> DataTree | None:
    return sample_smc(model=model, **settings)


def _by_chains(
    sampler: str, name: str, model: Model, comm: Any, checkpoint: Any, **settings: Any
) -> DataTree | None:
    given = RunArguments(**{"until_ess": AUTO, **settings})
    return sample_named(name, model, given, sampler, comm=comm, checkpoint=checkpoint)


def _one_by_one(
    models: Mapping[str, Model],
    run: Callable[..., DataTree | None],
    settings: Mapping[str, Any],
    folders: Mapping[str, Path],
    comm: Any,
) -> dict[str, DataTree] | None:
    """Every model, with the same seed; None on ranks that do not get them."""
    seed, found, failed = settings.get("random_seed"), {}, dict[str, Exception]()

    def add(name: str, model: Model) -> None:
        # Each gets the numbers that a generator would give the first.
        own = deepcopy(seed) if isinstance(seed, np.random.Generator) else seed
        changed = {"random_seed": own, "checkpoint": folders.get(name), "comm": comm}
        with _named(name):
            tree = run(name=name, model=model, **{**settings, **changed})
        if tree is not None:
            found[name] = tree

    for name, model in models.items():
        try:
            unless_interrupted(partial(add, name, model), None)
        except Exception as error:
            if comm is not None:  # other ranks may not know of it
                raise
            failed[name] = error
    if failed and not found:
        raise next(iter(failed.values()))
    if found:
        for name in models:
            if name not in found:
                tell(WithoutDraws(name, failed.get(name)))
    return found or None
