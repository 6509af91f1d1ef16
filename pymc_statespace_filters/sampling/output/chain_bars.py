"""Progress bars of chains, drawn by PyMC."""

from collections.abc import Iterator, Mapping
from typing import Any

from pymc.progress_bar import ProgressBarManager
from pymc.progress_bar.rich_progress import RichProgressBackend
from rich.console import RenderableType
from rich.progress import ProgressColumn, TextColumn
from rich.table import Column

# Below this fraction of accepted proposals a bar turns red, and the end of a chain has a warning.
MIN_ACCEPT_RATE = 0.01


def step_columns(n_chains: int) -> tuple[list[ProgressColumn], dict[str, list]]:
    """DRAM's column in the bar of ``pm.sample``, and its first values, one per chain.

    With a second one, PyMC would cut the times off in a terminal of 80 columns.
    """
    return [_column("accept_rate", "Accept", "0.2f")], {"accept_rate": [0.0] * n_chains}


def stat_values(stats: Mapping[str, Any]) -> dict[str, Any]:
    """What columns show of a draw's statistics, and whether the bar turns red."""
    shown = {"failed": stats["n_failed"]}
    if "accept_rate" in stats:
        rate = stats["accept_rate"]
        shown |= {"accept_rate": rate, "failing": rate < MIN_ACCEPT_RATE}
    return shown


def _column(key: str, title: str, form: str) -> ProgressColumn:
    return TextColumn(f"{{task.fields[{key}]:{form}}}", table_column=Column(title, no_wrap=True))


class ChainProgress(ProgressBarManager):
    """Progress bars of several chains, each advanced by many iterations at once.

    A context manager that leaves the terminal as it was, however the block ends. To be used from
    one thread. ``progressbar`` is as in ``pm.sample``, whose `ValueError` it raises if it is
    something else: True, False, "combined", "split", "combined+stats" or "split+stats". A fraction
    of accepted proposals is known if it ``has_rate``.

    Examples
    --------
    >>> from pymc_statespace_filters.sampling.output.chain_bars import ChainProgress
    >>> with ChainProgress(n_chains=1, draws=1000, tune=500, progressbar=False) as bars:
    ...     bars.update(0, 1500, {"accept_rate": 0.3, "n_failed": 0})
    """

    step_name = "Draw"

    def __init__(
        self,
        n_chains: int,
        draws: int,
        tune: int,
        progressbar: Any = True,
        *,
        has_rate: bool = True,
    ):
        super().__init__(n_chains, progressbar)
        chains_per_bar = n_chains if self.combined_progress else 1
        self._tune = chains_per_bar * tune
        self._totals = [draws + tune] * n_chains
        self._done = [0] * n_chains
        self._convergence: dict[int, tuple[float, float]] = {}
        columns, stats = step_columns(n_chains) if has_rate else ([], {})
        columns.append(_column("failed", "Fails", "d"))
        stats |= {"failed": [0] * n_chains, "draw": [0] * n_chains}
        stats["marker_pos"] = [self._tune] * n_chains
        self._backend = self._create_backend(self._total_of(0), columns, stats)
        if isinstance(self._backend, RichProgressBackend):
            # PyMC gives each column a fraction of the terminal's width, and cuts its text to it:
            # let the bar alone take what the texts leave.
            for column in self._backend._progress.columns[1:]:
                column.get_table_column().ratio = None
            self._add_last_line(self._backend._progress)

    @property
    def shows_convergence(self) -> bool:
        """Whether `show_convergence` has an effect."""
        return self._show_progress and self.full_stats

    def update(self, chain: int, done: int, stats: Mapping[str, Any], seconds: float = 0.0) -> None:
        """Show how many iterations a chain has made; its clock starts with the first of them.

        Warm-up is included, and nothing is drawn if there are no new ones. ``stats`` has "n_failed"
        of its last draw and, if it is known, "accept_rate", as in ``sample_stats``; ``seconds`` is
        how long it has run, once it has ended: PyMC's bar has no speed for what took less than a
        quarter of a second.
        """
        done = min(done, self._totals[chain])  # of a checkpoint there may be more
        advance = done - self._done[chain]
        if not self._show_progress or advance <= 0:
            return
        self._done[chain] = done
        count = sum(self._done) if self.combined_progress else done
        shown = stat_values(stats) | {"draw": count if count <= self._tune else count - self._tune}
        self._advance(chain, advance, shown)
        if count == self._total_of(chain):
            if seconds > 0.0 and not self.combined_progress:
                shown |= {"sampling_speed": done / seconds, "speed_unit": "draws/s"}
            self._advance(chain, 0, shown, is_last=True)

    def extend(self, chain: int, total: int) -> None:
        """Raise the number of iterations of a chain that goes on after its end."""
        self._totals[chain] = max(total, self._totals[chain])
        self._advance(chain, 0, {"failing": False})

    def show_convergence(self, model: int, rhat: float, ess: float) -> None:
        """Show a model's largest R-hat and smallest effective sample size: the worst of all models.

        They belong to no single chain, so they are in a line below the bars.
        """
        if self.shows_convergence:
            self._convergence[model] = rhat, ess

    def _add_last_line(self, progress: Any) -> None:
        """Have rich draw a line below its table."""
        tables = progress.get_renderables

        def renderables() -> Iterator[RenderableType]:
            yield from tables()
            if self._convergence:
                rhats, sizes = zip(*self._convergence.values(), strict=True)
                text = f"largest R-hat {max(rhats):.2f}, smallest effective sample size "
                yield f"  {text}{min(sizes):.0f}"

        progress.get_renderables = renderables

    def _total_of(self, chain: int) -> int:
        """Iterations that the bar of a chain counts."""
        return sum(self._totals) if self.combined_progress else self._totals[chain]

    def _advance(
        self, chain: int, advance: int, shown: dict[str, Any], is_last: bool = False
    ) -> None:
        self._backend.update(
            task_id=0 if self.combined_progress else chain,
            advance=advance,
            failing=shown.pop("failing", False),
            stats=shown,
            is_last=is_last,
            total=self._total_of(chain),
        )
