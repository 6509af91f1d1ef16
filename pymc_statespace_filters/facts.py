"""What calculations find out about themselves, and the way to the words for it.

A calculation states a `Fact` and knows no sentence about it. The room `advice` has the sentences.
To know what helps, it runs other filters and compiles them, so nothing imports it: the first fact
does, and a calculation without one never waits for it.
"""

from importlib import import_module
from typing import Any


class Fact:
    """What a calculation has found out; each kind is a dataclass beside that calculation.

    Of facts ``of_chains`` PyMC's logger has the words, as of its own warnings about chains. Other
    facts are warnings of Python at the user's call.
    """

    of_chains = False


def sentences(fact: Fact) -> list[str]:
    """The sentences about a fact, one for each cause; none if it does no harm."""
    return list(_advice().sentences(fact))


def in_words(fact: Fact) -> str:
    """The sentences about a fact, as a part of an error message."""
    return "; ".join(sentences(fact))


def tell(fact: Fact, begin: str = "") -> list[str]:
    """Warn of a fact, in sentences with this beginning; those that were said."""
    return list(_advice().tell(fact, begin))


def _advice() -> Any:
    return import_module(".advice", __package__)
