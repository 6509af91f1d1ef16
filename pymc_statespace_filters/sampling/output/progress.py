"""DRAM's columns in PyMC's progress bar, and that bar for chains that report now and then."""

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

from pymc.progress_bar import MCMCProgressBarManager
from pymc.progress_bar.rich_progress import RichProgressBackend
from rich.progress import ProgressColumn, TextColumn
from rich.table import Column
from rich.theme import Theme

# Below this share of accepted proposals a bar turns red.
ALARMING_ACCEPTANCE = 0.01


def columns(n_chains: int = 1) -> tuple[list[ProgressColumn], dict[str, list]]:
    """Columns and their first values, one per chain."""
    shown = [
        ("accept_rate", "Acceptance", "0.2f"),
        ("stage", "Stage", "d"),
        ("scaling", "Scale", "0.2g"),
        ("failed", "Failed", "d"),
    ]
    texts: list[ProgressColumn] = [
        TextColumn(f"{{task.fields[{key}]:{form}}}", table_column=Column(title, ratio=1))
        for key, title, form in shown
    ]
    return texts, {
        "accept_rate": [0.0] * n_chains,
        "stage": [0] * n_chains,
        "scaling": [0.0] * n_chains,
        "failed": [0] * n_chains,
    }


def update_functions() -> tuple[Callable[[Mapping[str, Any]], dict[str, Any]], ...]:
    """One function, from a draw's statistics to the columns."""
    return (_update,)


def _update(stats: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "accept_rate": stats["accept_rate"],
        "stage": stats["stage"],
        "scaling": stats["scaling"],
        "failed": stats["n_failed"],
        "failing": stats["accept_rate"] < ALARMING_ACCEPTANCE,
    }


class watch(MCMCProgressBarManager):
    """PyMC's progress bar of several chains, advanced by many iterations at once.

    A context manager: on the way out, by whichever way, the terminal is left as it was found. To be
    used from one thread, the one that shows output.

    Parameters
    ----------
    n_chains, draws, tune : int
    progressbar : bool or str
        As in ``pm.sample``: True, False, "combined", "split", "combined+stats", "split+stats".
    theme : rich.theme.Theme or str, optional
        Colours, or a style sheet for marimo.

    Raises
    ------
    ValueError
        If ``progressbar`` is something else, in the words of ``pm.sample``.

    Examples
    --------
    >>> from pymc_statespace_filters.sampling.output.progress import watch
    >>> with watch(n_chains=1, draws=1000, tune=500, progressbar=False) as bars:
    ...     bars.begin(0)
    ...     stats = {"accept_rate": 0.3, "stage": 1, "scaling": 0.5, "n_failed": 0}
    ...     bars.update(0, 1500, stats)
    """

    def __init__(
        self,
        n_chains: int,
        draws: int,
        tune: int,
        progressbar: bool | str = True,
        theme: Theme | str | None = None,
    ):
        super().__init__(
            # PyMC asks a step method for no more than its columns.
            step_method=SimpleNamespace(
                _progressbar_config=columns, _make_progressbar_update_functions=update_functions
            ),
            chains=n_chains,
            draws=draws,
            tune=tune,
            progressbar=progressbar,
            progressbar_theme=theme,
        )
        self._done = [0] * n_chains
        self._seconds = [0.0] * n_chains

    def begin(self, chain: int) -> None:
        """Start a chain's clock, by which its speed is measured, when the chain starts.

        Otherwise the clock starts at the first update, and what was done by then took no time.
        """
        self._advance(chain, 0, failing=False, stats={})

    def update(self, chain: int, done: int, stats: Mapping[str, Any], seconds: float = 0.0) -> None:
        """Show how far a chain has come.

        Parameters
        ----------
        chain : int
        done : int
            Its iterations so far, warm-up included. If they are no more than at the last update,
            nothing is drawn: so a chain that waits for its turn may be updated like the others.
        stats : mapping of str to number
            What a draw has in ``sample_stats``: "accept_rate", "stage", "scaling", "n_failed".
        seconds : float, optional
            How long the chain has run, once it has ended: PyMC's bar has no speed for what took
            less than a quarter of a second.
        """
        advance = done - self._done[chain]
        if not self._show_progress or advance <= 0:
            return
        self._done[chain], self._seconds[chain] = done, seconds
        failing, shown = self._extract_stats([stats])
        count = sum(self._done) if self.combined_progress else done
        shown["draw"] = count if count <= self._tune_total else count - self._tune_total
        self._advance(chain, advance, failing, shown)
        if count == self.total_draws:
            self._advance(chain, 0, failing, shown | self._speed(chain), is_last=True)

    def _speed(self, chain: int) -> dict[str, Any]:
        """What a terminal shows as the speed of a chain that has ended."""
        seconds = self._seconds[chain]
        in_terminal = isinstance(self._backend, RichProgressBackend)
        if self.combined_progress or not in_terminal or seconds <= 0.0:
            return {}
        return {"sampling_speed": self._done[chain] / seconds, "speed_unit": "draws/s"}

    def _advance(
        self,
        chain: int,
        advance: int,
        failing: bool,
        stats: dict[str, Any],
        is_last: bool = False,
    ) -> None:
        self._backend.update(
            task_id=0 if self.combined_progress else chain,
            advance=advance,
            failing=failing,
            stats=stats,
            is_last=is_last,
            total=self.total_draws,
        )
