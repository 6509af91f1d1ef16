"""Messages between rank 0, which manages the chains of a run, and the other ranks."""

from collections.abc import Sequence
from enum import StrEnum, auto

from .model_task import ModelTask

LISTENING_SECONDS = 0.02


class Kind(StrEnum):
    """Kinds of messages."""

    # To rank 0, ...
    IDLE = auto()
    PROGRESS = auto()
    RECORD = auto()  # to be stored
    RESULT = auto()
    FAILED = auto()
    LEAVING = auto()
    # ... and from it.
    STORED = auto()  # a part of what is stored of the next chain
    CHAIN = auto()
    GO_ON = auto()
    NO_MORE = auto()
    STOP = auto()
    OVER = auto()


def place_of(tasks: Sequence[ModelTask], number: int) -> tuple[ModelTask, int]:
    """The model of a chain, and its number there; chains are numbered through all models."""
    model, chain = divmod(number, tasks[0].request.chains)
    return tasks[model], chain
