"""How much a check may compute: the work that is planned, and the time after which it ends."""

import time
from collections.abc import Callable

# Nanoseconds of a particle for a step, for each of its states and as much again, as measured.
_PLAIN_NS, _GUIDED_NS = 5.0, 25.0
# The number of particles of the plain filter, at least and at most.
_LEAST, _MOST = 200, 20_000
# Of the time, for the estimates of plain particles, and at most for those of other witnesses; the
# rest is for the filter that is checked.
_SHARE, _SHARE_OF_OTHERS = 0.3, 0.5


class Budget:
    """CPU seconds of this process, counted from `begin`: compilation comes before.

    ``on_progress`` is called with the number of new points.
    """

    def __init__(self, seconds: float) -> None:
        self.on_progress: Callable[[int], None] = lambda count: None
        self._seconds, self._began = seconds, time.process_time()

    def begin(self) -> None:
        """Count the time from now on."""
        self._began = time.process_time()

    @property
    def is_spent(self) -> bool:
        """Whether the time is up."""
        return time.process_time() - self._began > self._seconds

    def is_enough_for(self, seconds: float) -> bool:
        """Whether a witness may take so many seconds in all."""
        return seconds <= _SHARE_OF_OTHERS * self._seconds

    def n_particles(self, n_estimates: int, n_steps: int, n_states: int) -> int:
        """Particles with which so many estimates of a record fit the budget, of one digit."""
        work = n_estimates * max(n_steps, 1) * (1 + n_states) * _PLAIN_NS * 1e-9
        number = min(max(_SHARE * self._seconds / work, _LEAST), _MOST)
        digit = 10 ** (len(str(int(number))) - 1)
        return int(number // digit * digit)

    def affords(self, n_particles: int, n_estimates: int, n_steps: int, n_states: int) -> bool:
        """Whether there is time for so many estimates with guided particles."""
        work = n_particles * n_estimates * n_steps * (1 + n_states) * _GUIDED_NS
        return self.is_enough_for(work * 1e-9)
