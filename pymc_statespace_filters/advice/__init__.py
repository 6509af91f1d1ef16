"""Facts in words: what a calculation has found, what it means for this system, and what helps.

Nothing imports this room: `facts` loads it with the first fact. Each module has the words for some
kinds of facts and registers them with `sentences`.
"""

from . import (
    choice,
    ended_dram,
    ended_nuts,
    filter_check,
    health,
    mobility,
    modes,
    noise,
    refusals,
)
from .words import sentences, tell

__all__ = [
    "choice", "ended_dram", "ended_nuts", "filter_check", "health", "mobility", "modes", "noise",
    "refusals", "sentences", "tell",
]  # fmt: skip
