"""Over which ranks of MPI chains or rows are distributed, and how."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from ..errors import ModelError

_GATHER = ("root", "all")


@dataclass(frozen=True)
class Ranks:
    """What a user gives as ``comm=`` of a sampler, a mapping of these fields for example.

    Parameters
    ----------
    comm : mpi4py.MPI.Comm or "world"
        All its ranks make the same call. "world" is all ranks started by ``mpiexec``, or this
        process alone without ``mpiexec``.
    per_chain : int
        Number of ranks that evaluate the likelihoods of a chain together, each on its part of the
        particles; for likelihoods that take seconds. It divides the number of ranks.
    gather : {"root", "all"}
        Ranks that get the result.

    Raises
    ------
    ModelError
        If ``per_chain`` or ``gather`` is not as described.

    Examples
    --------
    >>> Ranks.of({"per_chain": 2})
    Ranks(comm='world', per_chain=2, gather='root')
    """

    comm: Any = "world"
    per_chain: int = 1
    gather: str = "root"

    def __post_init__(self) -> None:
        number = self.per_chain
        if not isinstance(number, int | np.integer) or isinstance(number, bool) or number < 1:
            raise ModelError(f"per_chain must be an integer of at least 1, got {number!r}")
        if not isinstance(self.gather, str) or self.gather not in _GATHER:
            raise ModelError(f"gather must be one of {_GATHER}, got {self.gather!r}")

    @classmethod
    def of(cls, comm: Any) -> Self:
        """The ranks that a user has given; None is this process alone."""
        if not isinstance(comm, Mapping):
            return cls(comm)
        known = [field.name for field in fields(cls)]
        if not set(comm) <= set(known):
            raise ModelError(f"comm must be a mapping of some of {', '.join(known)}, got {comm!r}")
        return cls(**comm)

    @property
    def settings(self) -> dict[str, Any]:
        """What all ranks must agree on."""
        return {"per_chain": int(self.per_chain), "gather": self.gather}
