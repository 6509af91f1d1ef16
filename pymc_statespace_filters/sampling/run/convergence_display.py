"""R-hat and effective sample size in the progress bar, while chains run."""

import time
from collections.abc import Mapping, Sequence

from ...progress import ChainProgress
from .chain_task import ChainTask
from .model_task import ModelTask

# Seconds between two computations, and the part of the time that they may take.
_SECONDS, _SHARE = 2.0, 0.01


class ConvergenceDisplay:
    """Computes the diagnostics of each model that runs, and shows them below the bars.

    They are those of the chains whose draws are on this rank: of those that run here, and of those
    that have ended anywhere. Without a bar nothing is computed.

    Parameters
    ----------
    bars : ChainProgress
    chains : int
        Number of chains of a model; they are numbered through all models.
    """

    def __init__(self, bars: ChainProgress, chains: int):
        self._bars, self._n_per_model = bars, chains
        self._next = time.monotonic() + _SECONDS

    def refresh(self, tasks: Sequence[ModelTask], running: Mapping[int, ChainTask]) -> None:
        """Show the diagnostics of the models of running chains, if it is time to."""
        began = time.monotonic()
        if not self._bars.shows_convergence or began < self._next:
            return
        by_model: dict[int, dict[int, ChainTask]] = {}
        for number, task in running.items():
            model, chain = divmod(number, self._n_per_model)
            by_model.setdefault(model, {})[chain] = task
        for model, chains in by_model.items():
            self.show(model, tasks[model], chains)
        now = time.monotonic()
        self._next = now + max(_SECONDS, (now - began) / _SHARE)

    def show(self, model: int, task: ModelTask, running: Mapping[int, ChainTask]) -> None:
        """Show the diagnostics of a model, of its results and of chains that run here."""
        if not self._bars.shows_convergence:
            return
        found = task.convergence_so_far(running)
        if found is not None:
            self._bars.show_convergence(model, float(found.rhat.max()), float(found.ess.min()))
