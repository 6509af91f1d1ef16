"""Functions that neither make nor return arrays count no references to them.

What a function is given lives until it returns. Numba counts a reference to each array of a tuple
wherever the tuple or a part of it gets another name: an atomic addition, as long as twenty others.
"""

from typing import Any

from numba.core import ir, types
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.types.containers import BaseTuple
from numba.core.types.iterators import ArrayIterator

# Arrays that these expressions give are parts or views of others.
_VIEWS = {
    "getattr", "static_getitem", "getitem", "typed_getitem", "build_tuple", "cast", "exhaust_iter",
    "getiter", "iternext", "pair_first", "pair_second", "phi",
}  # fmt: skip
_KINDS = (types.Array, types.ArrayCTypes, ArrayIterator, types.BoundFunction)


@register_pass(mutates_CFG=False, analysis_only=True)
class CountNoReferences(AnalysisPass):
    """Count no references in a function all of whose arrays are those of its caller."""

    _name = "count_no_references"

    def __init__(self) -> None:
        super().__init__()

    def run_pass(self, state: Any) -> bool:
        """Decide for one function, whose types are known."""
        if _only_borrows(state):
            state.targetctx = state.targetctx.subtarget(enable_nrt=False)
        return False


def _only_borrows(state: Any) -> bool:
    counted = {name for name, kind in state.typemap.items() if _is_counted(state, kind)}
    if _is_counted(state, state.return_type) or not all(
        _is_borrowable(state, state.typemap[name]) for name in counted
    ):
        return False
    return all(
        _is_view(state, statement.value)
        for block in state.func_ir.blocks.values()
        for statement in block.find_insts(ir.Assign)
        if statement.target.name in counted
    )


def _is_counted(state: Any, kind: Any) -> bool:
    return bool(state.targetctx.data_model_manager[kind].contains_nrt_meminfo())


def _is_borrowable(state: Any, kind: Any) -> bool:
    """Whether it is an array, or a tuple of such; a list would keep one after the function."""
    if isinstance(kind, BaseTuple):
        return all(_is_borrowable(state, part) or not _is_counted(state, part) for part in kind)
    return isinstance(kind, _KINDS)


def _is_view(state: Any, value: Any) -> bool:
    """Whether a value with arrays is made of arrays that are there."""
    if not isinstance(value, ir.Expr):
        return True
    if value.op == "call":
        return isinstance(state.typemap[value.func.name], types.NamedTupleClass)
    if value.op in ("getitem", "typed_getitem"):  # arrays at other indices are copied
        return not _is_counted(state, state.typemap[value.index.name])
    return value.op in _VIEWS
