"""How evaluations of a filter have ended: failures, and terms that few particles decided."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..facts import Fact, tell
from ..filters.outcomes import COLLAPSED
from ..system.model import StateSpaceModel

type Arguments = tuple[Any, ...]


@dataclass(frozen=True)
class Health(Fact):
    """The health (n, 3) of evaluations, of which some have failed or collapsed.

    ``arguments_of(i)`` are the inputs (theta, steps, observed, inputs, t0, seed) of evaluation i,
    so that it can be repeated. ``labels`` are those of the records of a panel; the evaluations of
    one come before those of the next, and are as many.
    """

    system: StateSpaceModel
    filter: Any
    health: np.ndarray
    arguments_of: Callable[[int], Arguments]
    labels: Sequence[Any] | None = None

    @property
    def failed(self) -> np.ndarray:
        """Whether each evaluation has no finite likelihood, (n,)."""
        return np.asarray(self.health[:, 1] != 0)

    @property
    def smallest(self) -> np.ndarray:
        """The smallest effective number of particles of each evaluation that has not failed."""
        return np.where(self.failed, np.inf, self.health[:, 0])

    def tell(self) -> None:
        """Warn once of each failure, and once of collapse, if there are any."""
        if self.failed.any() or (self.smallest < COLLAPSED).any():
            tell(self)
