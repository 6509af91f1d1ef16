"""Whether all ranks make the same call."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ..errors import DataMismatchError
from .communicator import Communicator

_ADVICE = {
    "random_seed": ", and the same integer as random_seed: a Generator is the same on two ranks "
    "only if both were made of the same seed and have drawn as much",
    "pilot": ', and the same pilot, which comm={"gather": "all"} gives to all ranks',
}


def check_same_call(
    comm: Communicator, settings: Callable[[], Sequence[Mapping[str, Any]]]
) -> None:
    """Raise, on all ranks, unless all have the same settings.

    The `DataMismatchError` names what differs.
    """
    first, *others = comm.allgather(comm.run_collectively(settings))
    for rank, theirs in enumerate(others, start=1):
        pairs = zip(first, theirs, strict=False)  # with other numbers of models the first differ
        differing = [name for a, b in pairs for name in a if a[name] != b[name]]
        if differing:
            raise DataMismatchError(
                f"rank {rank} of {comm.size} and rank 0 differ in "
                f"{', '.join(dict.fromkeys(differing))}; all ranks must make the same call, with "
                f"the same data{''.join(_ADVICE[name] for name in _ADVICE if name in differing)}"
            )
