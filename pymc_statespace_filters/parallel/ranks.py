"""Over which ranks of MPI chains or rows are distributed, and how."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from ..errors import ModelError

_GATHER = ("root", "all")


@dataclass(frozen=True)
class Ranks:
    """Ranks over which chains are distributed: ``comm=`` of the samplers.

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
    >>> import pymc_statespace_filters as psf
    >>> psf.Ranks(per_chain=2)
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
        return comm if isinstance(comm, cls) else cls(comm)

    @property
    def settings(self) -> dict[str, Any]:
        """What all ranks must agree on."""
        return {"per_chain": int(self.per_chain), "gather": self.gather}
