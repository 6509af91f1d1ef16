"""DRAM's columns in PyMC's progress bar."""

from collections.abc import Callable, Mapping
from typing import Any

from rich.progress import ProgressColumn, TextColumn
from rich.table import Column

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
