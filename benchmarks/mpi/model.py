"""Model of the seconds of an evaluation on more ranks than this machine has cores.

T(R) = compute(R) + exchanges (overhead + stages(R) message) + bytes (1 - 1/R) / bandwidth

compute(R) is measured: the CPU time of the busiest of R ranks, which are threads of one process.
The number of exchanges and their bytes are measured too. An exchange is an allgather by recursive
doubling, with ceil(log2 R) stages of one message each (Thakur, Rabenseifner and Gropp 2005).
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from benchmarks.mpi.cases import RANKS, Case


@dataclass(frozen=True)
class Link:
    """A connection of ranks: seconds of the callback and of a message; bytes per second."""

    name: str
    overhead: float
    message: float
    bandwidth: float

    def seconds(self, n_ranks: int, n_exchanges: float, n_bytes: float) -> float:
        if n_ranks == 1:
            return 0.0
        latency = self.overhead + math.ceil(math.log2(n_ranks)) * self.message
        return n_exchanges * latency + n_bytes * (1 - 1 / n_ranks) / self.bandwidth


def links(exchange: dict) -> list[Link]:
    """Return shared memory as measured, then assumed networks, whose bytes are copied here too."""
    n_bytes, times = np.array(exchange["n_bytes"]), np.array(exchange["callback"])
    # Fit relative errors. Two ranks: half of an array travels.
    (latency, of_a_byte), _ = nnls(
        np.column_stack([np.ones(times.size), n_bytes / 2]) / times[:, None], np.ones(times.size)
    )
    message = exchange["bare"] - exchange["alone"]
    overhead, bandwidth = latency - message, 1 / of_a_byte
    return [
        Link("shared memory", overhead, message, bandwidth),
        Link("fast network", overhead, 2e-6, 1 / (of_a_byte + 1 / 4.6e9)),
        Link("TCP on Ethernet", overhead, 30e-6, 1 / (of_a_byte + 1 / 1.1e9)),
    ]


@dataclass(frozen=True)
class Spread:
    """A likelihood against ranks: measurements on threads, and the model based on them."""

    case: Case
    ranks: list[int]
    compute: list[float]
    n_exchanges: list[float]
    n_bytes: list[float]

    @classmethod
    def of_json(cls, row: dict) -> "Spread":
        return cls(**(row | {"case": Case(**row["case"])}))

    def seconds(self, n_ranks: int, link: Link) -> float:
        """Scaled to the whole record."""
        # The number of exchanges and their bytes hardly depend on the number of ranks.
        near = max(i for i, r in enumerate(self.ranks) if r <= n_ranks)
        exchanged = link.seconds(n_ranks, self.n_exchanges[near], self.n_bytes[near])
        if n_ranks in self.ranks:
            return self.case.scale * (self.compute[near] + exchanged)
        serial, divided = self.parts()
        return self.case.scale * (serial + divided / n_ranks + exchanged)

    def best(self, link: Link) -> tuple[int, float]:
        """Return the measured number of ranks with the shortest time, and its speed-up over one."""
        n = min(filter(self.case.fits, RANKS), key=lambda r: self.seconds(r, link))
        return n, self.seconds(1, link) / self.seconds(n, link)

    def parts(self) -> tuple[float, float]:
        """Return the serial and the divided seconds of a fit serial + divided / R."""
        times = np.array(self.compute)
        basis = np.column_stack([np.ones(times.size), 1 / np.array(self.ranks)])
        # Fit relative errors: the times span two decades.
        (serial, divided), _ = nnls(basis / times[:, None], np.ones(times.size))
        return float(serial), float(divided)


def makespan(seconds: list[float], n_ranks: int) -> float:
    """Return when the last job ends if the longest start first and a free rank takes the next."""
    free = [0.0] * n_ranks
    for job in sorted(seconds, reverse=True):
        i = free.index(min(free))
        free[i] += job
    return max(free)
