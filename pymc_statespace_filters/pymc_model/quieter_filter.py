"""A filter with little noise or none, and the same likelihood, for a variable of a model."""

import pymc as pm

from ..compiler.lowering.compiled_system import compile_system
from ..filters.catalog import quiet_filter
from ..filters.protocol import Filter
from .inspection import state_space_nodes


def quieter_filter(model: pm.Model, name: str) -> Filter | None:
    """Such a filter for one variable, if there is one."""
    op = state_space_nodes(model)[name].op
    return quiet_filter(compile_system(op.system), op.filter)
