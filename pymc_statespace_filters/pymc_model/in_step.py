"""A call that all ranks of MPI make in step, each of which evaluates a part of its points."""

import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from inspect import BoundArguments, signature
from typing import Any, cast

import numpy as np
import pymc as pm

from ..errors import ModelError
from ..parallel.agreement import check_same_call
from ..parallel.communicator import Communicator, communicator_of
from ..parallel.cpu_affinity import allowed_cores, cores_per_process, cores_set_to
from ..parallel.ranks import Ranks
from ..parallel.shared_rows import rows_shared_by
from .fingerprint import model_data_fingerprint, model_fingerprint
from .inspection import given_model


def shared_by_ranks[**P, R](function: Callable[P, R]) -> Callable[P, R]:
    """Let the ranks of a function's argument ``comm`` share the points that it evaluates.

    The function has an argument ``model``, or ``models``, one or a mapping, and of ``idata``,
    ``random_seed`` and ``progressbar`` those that it needs. All ranks make the call in step: those
    without draws get them from the first rank, which alone shows bars, warns and logs. The result
    is None, beside its type, on ranks that do not get it. It raises `ModelError` if ``comm`` is
    invalid; `DataMismatchError` if models, their data or seeds of the ranks differ; `ParallelError`
    if another rank has failed, or MPI cannot be used.
    """
    own = signature(function)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if kwargs.get("comm") is None:
            return function(*args, **kwargs)
        given = own.bind(*args, **kwargs)
        ranks = Ranks.of(kwargs["comm"])
        if ranks.per_chain != 1:
            raise ModelError(f"per_chain of comm must be 1 without chains, got {ranks.per_chain}")
        with communicator_of(ranks.comm) as comm:
            if comm.size == 1:
                return function(*args, **kwargs)
            _share_arguments(comm, ranks, given)
            is_first = comm.rank == 0
            with _quiet(not is_first), _own_cores(comm), rows_shared_by(comm):
                result = comm.run_collectively(lambda: function(*given.args, **given.kwargs))
            if ranks.gather == "all":
                return comm.broadcast(result)
            return result if is_first else cast(R, None)

    return call


def _share_arguments(comm: Communicator, ranks: Ranks, given: BoundArguments) -> None:
    """Check that all ranks have the same arguments, and complete those of this one."""
    given.apply_defaults()
    values = given.arguments
    if "models" in values:
        models = values["models"]
        built = list(models.values()) if isinstance(models, Mapping) else [models]
    else:
        built = [given_model(values["model"])]
        values["model"] = built[0]
    settings = ranks.settings | {"random_seed": _comparable(values.get("random_seed"))}
    check_same_call(comm, lambda: [settings, *(_identity(given_model(one)) for one in built)])
    # What has a checkpoint goes on with the numbers of a run that had no seed either.
    if values.get("random_seed", 0) is None and "checkpoint" not in values:
        values["random_seed"] = comm.broadcast(int(np.random.default_rng().integers(2**63)))
    if "idata" in values and not all(comm.allgather(values["idata"] is not None)):
        first = comm.broadcast(values["idata"])
        values["idata"] = first if values["idata"] is None else values["idata"]
    if comm.rank > 0:
        values["progressbar"] = False


def _comparable(random_seed: Any) -> Any:
    """A seed as a value that is equal on ranks with the same seed."""
    if isinstance(random_seed, np.random.Generator):
        return repr(random_seed.bit_generator.state)
    return random_seed


def _identity(model: pm.Model) -> Mapping[str, str]:
    """What is the same for equal models with equal data."""
    try:
        fingerprint = model_fingerprint(model)
    except ModelError:  # of a model that no text identifies
        fingerprint = ""
    return {"model": fingerprint, "data": model_data_fingerprint(model)}


@contextmanager
def _own_cores(comm: Communicator) -> Iterator[None]:
    """As many threads as this rank has of the cores of its computer."""
    local_rank, allowed = comm.node_local(allowed_cores())
    with cores_set_to(cores_per_process(local_rank, allowed)):
        yield


@contextmanager
def _quiet(is_quiet: bool) -> Iterator[None]:
    """Neither warnings nor messages, which the first rank gives."""
    if not is_quiet:
        yield
        return
    level = logging.root.manager.disable
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.disable(logging.CRITICAL)
        try:
            yield
        finally:
            logging.disable(level)
