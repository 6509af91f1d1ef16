"""A call that all ranks of MPI make in step, each of which evaluates a part of its points."""

import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import pymc as pm

from ..errors import ModelError
from ..parallel.agreement import check_same_call
from ..parallel.communicator import Communicator, communicator_of
from ..parallel.cpu_affinity import allowed_cores, cores_per_process, cores_set_to
from ..parallel.ranks import Ranks
from ..parallel.shared_rows import rows_shared_by
from .fingerprint import model_data_fingerprint, model_fingerprint

_SEED_ADVICE = (
    ", and the same integer as random_seed: a Generator is the same on two ranks only if both were "
    "made of the same seed and have drawn as much"
)


class Given(NamedTuple):
    """What one rank of a call works with."""

    idata: Any  # that of the first rank, where this one has none
    random_seed: Any  # the same on all ranks
    is_first: bool  # whether this rank shows bars


def in_step[R](
    call: Callable[[Given], R],
    comm: Any,
    models: Sequence[pm.Model],
    *,
    idata: Any = None,
    random_seed: Any = None,
) -> R | None:
    """Make a call on all ranks of ``comm``; None on those that do not get its result.

    The points at which its functions are evaluated are divided among the ranks. Only the first one
    warns and logs.

    Raises
    ------
    ModelError
        If ``comm`` is invalid.
    DataMismatchError
        If models, their data or seeds of the ranks differ.
    ParallelError
        If another rank has failed, or MPI cannot be used.
    """
    ranks = Ranks.of(comm)
    if ranks.per_chain != 1:
        raise ModelError(f"per_chain of Ranks must be 1 without chains, got {ranks.per_chain}")
    with communicator_of(ranks.comm) as communicator:
        if communicator.size == 1:
            return call(Given(idata, random_seed, True))
        is_first = communicator.rank == 0
        given = _given(communicator, ranks, models, idata, random_seed)
        with _quiet(not is_first), _own_cores(communicator), rows_shared_by(communicator):
            result: R | None = communicator.run_collectively(lambda: call(given))
        if ranks.gather == "all":
            return communicator.broadcast(result)
        return result if is_first else None


def _given(
    comm: Communicator, ranks: Ranks, models: Sequence[pm.Model], idata: Any, random_seed: Any
) -> Given:
    """The arguments of this rank, which are checked to be those of all."""
    check_same_call(
        comm,
        lambda: [
            ranks.settings | {"random_seed": _comparable(random_seed)},
            *map(_identity, models),
        ],
        {"random_seed": _SEED_ADVICE},
    )
    if random_seed is None:
        random_seed = comm.broadcast(int(np.random.default_rng().integers(2**63)))
    if not all(comm.allgather(idata is not None)):
        first = comm.broadcast(idata)
        idata = first if idata is None else idata
    return Given(idata, random_seed, comm.rank == 0)


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
