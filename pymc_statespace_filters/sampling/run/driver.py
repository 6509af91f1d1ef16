"""A whole run, from what was asked for to its trees: what all ranks do in step."""

import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any, NamedTuple

from pymc.model import Model
from xarray import DataTree

from pymc_statespace_filters.errors import DataMismatchError, ModelError
from pymc_statespace_filters.parallel.communicator import Communicator, communicator_of
from pymc_statespace_filters.parallel.cpu_affinity import core_numbers, share_of_cores
from pymc_statespace_filters.sampling.checkpoint.checkpoint import join_checkpoint, open_checkpoint
from pymc_statespace_filters.sampling.run.model_task import Asked, ModelRun
from pymc_statespace_filters.sampling.run.scheduler import run_chains
from pymc_statespace_filters.sampling.target.leader_follower import follow, leading
from pymc_statespace_filters.system.checks import is_integer

_GATHERS = ("root", "all")
_SEED_CURE = (
    ", and with the same integer as random_seed: a Generator is the same on two ranks only if it "
    "was made of the same seed on both and has drawn as much"
)
_PILOT_CURE = ', and with the same pilot, which gather="all" gives to all ranks'


class How(NamedTuple):
    """How a run is made, on which its draws do not depend: arguments of ``sample_dram``."""

    cores: int | None
    progressbar: bool | str
    compute_convergence_checks: bool
    comm: Any
    ranks_per_chain: int
    gather: str


def sample_models(
    models: Mapping[str, Model],
    asked: Asked,
    how: How,
    checkpoints: Sequence[str | os.PathLike],
) -> dict[str, DataTree] | None:
    """Sample models on all ranks of a communicator.

    Parameters
    ----------
    models : mapping of str to pymc.Model
    asked : Asked
    how : How
    checkpoints : sequence of str or path
        A folder for each model, or none.

    Returns
    -------
    dict of str to xarray.DataTree
        None on ranks that do not get it.

    Raises
    ------
    ModelError, DataMismatchError, ParallelError
        As in ``sample_dram``.
    """
    _check(how)
    with communicator_of(how.comm, in_lockstep=how.ranks_per_chain > 1) as ranks:
        if ranks.size > 1:
            _check_agreement(ranks, models, asked, how, bool(checkpoints))
        asked = asked._replace(entropy=ranks.broadcast(asked.entropy))
        group, leaders = ranks.groups(_group_size(how.ranks_per_chain, ranks.size))
        trees = None
        with group:
            if leaders is None:
                follow(group)
            else:
                with leading(group), leaders:
                    runs = [ModelRun(model, asked, name, group) for name, model in models.items()]
                    trees = _lead(runs, leaders, how, checkpoints)
        if how.gather == "all":
            trees = ranks.broadcast(trees)
    return trees


def _lead(
    runs: Sequence[ModelRun],
    ranks: Communicator,
    how: How,
    checkpoints: Sequence[str | os.PathLike],
) -> dict[str, DataTree] | None:
    """Run all chains; ``ranks`` are those that run some."""
    place, cores = ranks.node_local(core_numbers())
    # Each model is compiled by one rank of a computer, the others find the code on disk; rank 0
    # needs all models, the others those of their chains.
    for mine in (runs[place :: len(cores)], runs if ranks.rank == 0 else ()):
        ranks.run_collectively(partial(_prepare, mine))
    n_threads = 1  # where others evaluate with us, for one chain at a time
    if not runs[0].is_shared:
        n_threads = how.cores or share_of_cores(place, cores)
    n_chains = sum(run.n_chains for run in runs)
    with ExitStack() as stack:
        if checkpoints:
            _open_checkpoints(runs, checkpoints, ranks, stack)
        outcomes = run_chains(
            runs,
            ranks,
            n_threads=min(n_threads, -(-n_chains // ranks.size)),
            progressbar=how.progressbar,
        )

    def trees() -> dict[str, DataTree] | None:
        if ranks.rank > 0:
            return None
        checks = how.compute_convergence_checks
        return {run.name: run.tree(*o, checks) for run, o in zip(runs, outcomes, strict=True)}

    return ranks.run_collectively(trees) if how.gather == "all" else trees()


def _prepare(runs: Sequence[ModelRun]) -> None:
    for run in runs:
        run.prepare()


def _check(how: How) -> None:
    if how.gather not in _GATHERS:
        raise ModelError(f"gather={how.gather!r}: expected one of {_GATHERS}")
    if how.cores is not None and (not is_integer(how.cores) or how.cores < 1):
        raise ModelError(f"cores={how.cores!r}: expected an integer, at least 1, or None")
    if not is_integer(how.ranks_per_chain) or how.ranks_per_chain < 1:
        raise ModelError(
            f"ranks_per_chain={how.ranks_per_chain!r}: expected an integer, at least 1"
        )
    if how.ranks_per_chain > 1 and how.comm is None:
        raise ModelError(
            f"ranks_per_chain={how.ranks_per_chain} without comm: say comm='world' for the ranks "
            f"that mpiexec started"
        )


def _group_size(ranks_per_chain: int, n_ranks: int) -> int:
    """As many ranks as were asked for; fewer if there are no more, as on a laptop."""
    size = min(ranks_per_chain, n_ranks)
    if n_ranks % size:
        raise ModelError(f"ranks_per_chain={size}: {n_ranks} ranks are not whole groups of {size}")
    return size


def _check_agreement(
    ranks: Communicator, models: Mapping[str, Model], asked: Asked, how: How, stores: bool
) -> None:
    """Raise, on all ranks, unless all were asked for the same."""
    of_all: list[dict[str, Any]] = [
        {"models": list(models)},
        {"ranks_per_chain": how.ranks_per_chain, "gather": how.gather, "checkpoint": stores},
    ]

    def in_words() -> list[dict]:
        return [*of_all, *(asked.in_words(model, strictly=False) for model in models.values())]

    first, *others = ranks.allgather(ranks.run_collectively(in_words))
    for rank, theirs in enumerate(others, start=1):
        pairs = zip(first, theirs, strict=False)  # of other numbers the first differ already
        differing = [key for a, b in pairs for key in a if a[key] != b[key]]
        if differing:
            cures = {"random_seed": _SEED_CURE, "proposal_cov": _PILOT_CURE}
            raise DataMismatchError(
                f"rank {rank} of {ranks.size} was asked for something else than rank 0: "
                f"{', '.join(dict.fromkeys(differing))}; all ranks must make the same call, with "
                f"the same data{''.join(cures[name] for name in cures if name in differing)}"
            )


def _open_checkpoints(
    runs: Sequence[ModelRun],
    folders: Sequence[str | os.PathLike],
    ranks: Communicator,
    stack: ExitStack,
) -> None:
    """Rank 0 opens the folders, the others join."""

    def begin() -> list:
        tickets: list = []
        if ranks.rank == 0:
            for run, folder in zip(runs, folders, strict=True):
                in_words = run.asked.in_words(run.model)
                run.checkpoint = stack.enter_context(open_checkpoint(folder, in_words))
                tickets.append(run.checkpoint.ticket)
        return tickets

    def join(tickets: list) -> None:
        if ranks.rank > 0:
            for run, ticket in zip(runs, tickets, strict=True):
                run.checkpoint = stack.enter_context(join_checkpoint(ticket))

    ranks.run_collectively(partial(join, ranks.broadcast(ranks.run_collectively(begin))))
