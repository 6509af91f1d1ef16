"""A whole run, from the request to the DataTrees: the steps that all ranks take together.

The types involved in a run, from the request to the DataTree:

`SamplingRequest`
    the user's arguments on which the draws depend; `ExecutionOptions` has the others
`ModelTask`
    the request applied to one model: target, starts, results, DataTree
`ChainTask`
    one chain of it, run in a thread and stored in a checkpoint
`Chain`
    the chain itself: `ChainState`, the arrays that its machine code changes, and `Draws`, the
    arrays in which it records every iteration; the two are also the result of a chain
"""

import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial

from pymc.model import Model
from xarray import DataTree

from ...compiler.native.compilation import COMPILATION
from ...errors import ModelError
from ...facts import tell
from ...parallel.agreement import check_same_call
from ...parallel.communicator import Communicator, communicator_of
from ...parallel.cpu_affinity import allowed_cores, cores_per_process
from ...parallel.signals import keeps_what_is_there
from ..checkpoint.checkpoint import open_checkpoint
from ..output.facts import WithoutDraws
from ..target.leader_follower import follow, release_followers
from ..target.record_target import RecordTarget
from ..target.target import Target
from .model_task import ModelTask
from .request import ExecutionOptions, SamplingRequest
from .scheduler import run_chains


@keeps_what_is_there
def sample_models(
    models: Mapping[str, Model],
    requests: Sequence[SamplingRequest],
    options: ExecutionOptions,
    checkpoints: Sequence[str | os.PathLike],
    target: Target | RecordTarget | None = None,
) -> dict[str, DataTree] | None:
    """Sample models on all ranks of a communicator; None on ranks that do not get the result.

    ``requests`` has one for each model, of as many draws and chains; ``checkpoints`` has a folder
    for each model, or none. A single model may have its ``target`` already. Errors are those of
    ``sample_dram``.
    """
    options.check()
    ranks = options.ranks
    with communicator_of(ranks.comm, in_lockstep=ranks.per_chain > 1) as comm:
        if comm.size > 1:
            _check_agreement(comm, models, requests, options, bool(checkpoints))
        entropy = comm.broadcast(requests[0].entropy)
        group, leaders = comm.groups(_group_size(ranks.per_chain, comm.size))
        trees = None
        with group:
            if leaders is None:
                follow(group)
            else:
                with release_followers(group), leaders:
                    tasks = [
                        ModelTask(model, request._replace(entropy=entropy), name, group, target)
                        for (name, model), request in zip(models.items(), requests, strict=True)
                    ]
                    trees = _run(tasks, leaders, options, checkpoints)
        if ranks.gather == "all":
            trees = comm.broadcast(trees)
    return trees


def _run(
    tasks: Sequence[ModelTask],
    comm: Communicator,
    options: ExecutionOptions,
    checkpoints: Sequence[str | os.PathLike],
) -> dict[str, DataTree] | None:
    """Run all chains on the ranks of ``comm``, one rank of each group; DataTrees on rank 0."""
    local_rank, cores = comm.node_local(allowed_cores())
    # Each model is compiled by one rank of a computer, the others find the code on disk; rank 0
    # needs all models, the others those of their chains.
    for local in (tasks[local_rank :: len(cores)], tasks if comm.rank == 0 else ()):
        with COMPILATION:
            comm.run_collectively(partial(_prepare, local))
    n_threads = 1  # followers evaluate for one chain at a time
    if not tasks[0].is_distributed:
        n_threads = options.cores or cores_per_process(local_rank, cores)
    n_chains = sum(task.request.chains for task in tasks)
    with ExitStack() as stack:
        with COMPILATION:
            if checkpoints:
                _open_checkpoints(tasks, checkpoints, comm, stack)
            _find_populations(tasks, comm, progressbar=bool(options.progressbar))
        run_chains(
            tasks,
            comm,
            n_threads=min(n_threads, -(-n_chains // comm.size)),
            progressbar=options.progressbar,
        )

    def trees() -> dict[str, DataTree] | None:
        if comm.rank > 0:
            return None
        # After an interruption a model may have no draws: the others have theirs.
        kept = [task for task in tasks if task.has_draws]
        if not kept and not all(task.is_complete for task in tasks):
            raise KeyboardInterrupt("the run was interrupted before there was a draw to return")
        kept = kept or list(tasks)
        for task in tasks:
            if task not in kept:
                tell(WithoutDraws(task.name))
        with COMPILATION:
            return {task.name: task.to_datatree(options) for task in kept}

    return comm.run_collectively(trees) if options.ranks.gather == "all" else trees()


def _prepare(tasks: Sequence[ModelTask]) -> None:
    for task in tasks:
        task.prepare()


def _find_populations(tasks: Sequence[ModelTask], comm: Communicator, *, progressbar: bool) -> None:
    """Find points of each posterior on rank 0, for the chains of all ranks."""

    def find() -> list:
        if comm.rank > 0:
            return []
        return [task.find_population(progressbar=progressbar) for task in tasks]

    found = comm.broadcast(comm.run_collectively(find))
    for task, population in zip(tasks, found, strict=True):
        task.searched = population


def _group_size(per_chain: int, n_ranks: int) -> int:
    """Number of ranks in a group: ``per_chain``, or all of them if there are fewer."""
    size = min(per_chain, n_ranks)
    if n_ranks % size:
        raise ModelError(
            f"per_chain of comm must divide the number of ranks, got per_chain={size} with "
            f"{n_ranks} ranks"
        )
    return size


def _check_agreement(
    comm: Communicator,
    models: Mapping[str, Model],
    requests: Sequence[SamplingRequest],
    options: ExecutionOptions,
    has_checkpoint: bool,
) -> None:
    """Raise, on all ranks, unless all made the same call with the same data."""

    def settings() -> list[dict]:
        return [
            {"models": list(models)},
            {**options.ranks.settings, "checkpoint": has_checkpoint},
            *(
                request.cache_key(model, require_fingerprint=False)
                for model, request in zip(models.values(), requests, strict=True)
            ),
        ]

    check_same_call(comm, settings)


def _open_checkpoints(
    tasks: Sequence[ModelTask],
    folders: Sequence[str | os.PathLike],
    comm: Communicator,
    stack: ExitStack,
) -> None:
    """Open the folders on rank 0, which stores what the others send."""

    def opened() -> list:
        if comm.rank > 0:
            return []
        for task, folder in zip(tasks, folders, strict=True):
            key = task.request.cache_key(task.model)
            task.checkpoint = stack.enter_context(open_checkpoint(folder, key))
        return [task.stored_length() for task in tasks]

    lengths = comm.broadcast(comm.run_collectively(opened))
    for task, length in zip(tasks, lengths, strict=True):
        task.set_length(length)
