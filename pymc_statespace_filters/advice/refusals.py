"""A filter that cannot do what is asked of it: which others can."""

from typing import Any

from ..filters.catalog import filters_for
from ..filters.checks import Bias, Refusal, is_unbiased
from ..filters.protocol import System
from ..filters.written import listed
from ..ops.likelihood import NoGradient
from .words import sentences


@sentences.register
def _(fact: Refusal) -> list[str]:
    return [alternatives(fact.system, fact.filter)]


@sentences.register
def _(fact: Bias) -> list[str]:
    others = [f for f in filters_for(fact.system) if is_unbiased(fact.system, f)]
    if not others:
        return ["no filter of the package is without one"]
    return [f"{listed(others)} {'have' if len(others) > 1 else 'has'} none"]


@sentences.register
def _(fact: NoGradient) -> list[str]:
    others = listed(f for f in filters_for(fact.system) if f.has_gradient)
    return [f"take a filter with a gradient: {others}"] if others else []


def alternatives(system: System, filter: Any) -> str:
    """Say which other filters take a system, and which of them are exact."""
    filters = filters_for(system, without=filter)
    exact = [f for f in filters if f.is_exact_for(system)]
    others = [f for f in filters if f not in exact]
    kinds = (("exact", exact), ("approximate", others))
    texts = [f"{listed(of_kind)} ({name})" for name, of_kind in kinds if of_kind]
    return f"this system can be treated by {' and by '.join(texts)}"
