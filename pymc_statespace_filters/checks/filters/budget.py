"""How much a check may compute: CPU seconds, and the particles whose estimates fit into them."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# Nanoseconds of a particle for a step, for each of its states and as much again, as measured.
_PLAIN_NS = 5.0
# The number of particles of the plain filter, at least and at most.
_LEAST, _MOST = 200, 20_000
_SHARE = 0.3  # of the time, for the first estimates of plain particles


class Budget:
    """CPU seconds of this process, from now on.

    ``on_progress`` is called with the number of new points. Without ``counts_compilation`` the
    clock stands still while filters are compiled.
    """

    def __init__(self, seconds: float, *, counts_compilation: bool = False) -> None:
        self.on_progress: Callable[[int], None] = lambda count: None
        self.counts_compilation = counts_compilation
        self._seconds, self._began = seconds, time.process_time()

    def part(self, n: int) -> "Budget":
        """One of n equal parts, from now on."""
        return Budget(self._seconds / n, counts_compilation=self.counts_compilation)

    @contextmanager
    def compiling(self) -> Iterator[None]:
        """Compile meanwhile."""
        began = time.process_time()
        yield
        if not self.counts_compilation:
            self._began += time.process_time() - began

    def allows(self, seconds: float) -> bool:
        """Whether so many are left."""
        return time.process_time() - self._began + seconds <= self._seconds

    @property
    def is_spent(self) -> bool:
        """Whether the time is up."""
        return not self.allows(0.0)

    def n_particles(self, n_estimates: int, n_steps: int, n_states: int) -> int:
        """Particles with which so many estimates of a record fit the budget, of one digit."""
        work = n_estimates * max(n_steps, 1) * (1 + n_states) * _PLAIN_NS * 1e-9
        number = min(max(_SHARE * self._seconds / work, _LEAST), _MOST)
        digit = 10 ** (len(str(int(number))) - 1)
        return int(number // digit * digit)
