"""Arrays that own no memory, to which no references are counted."""

from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


@intrinsic
def borrowed(typing_context, value):
    """The same value; its arrays, in tuples of any depth, own no memory.

    Numba counts a reference to each array of a tuple wherever the tuple or a part of it gets a
    name, by an atomic addition. Here LLVM sees that there is nothing to count. The owner has to
    live as long: what a function is given lives until it returns.
    """

    def generate(context, builder, signature, values):
        result = _without_owners(context, builder, value, values[0])
        context.nrt.incref(builder, value, result)  # of what is no array, such as a list
        return result

    return value(value), generate


def _without_owners(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    if isinstance(kind, types.BaseTuple):
        parts = zip(kind, cgutils.unpack_tuple(builder, value), strict=True)
        own_nothing = [_without_owners(context, builder, *part) for part in parts]
        return context.make_tuple(builder, kind, own_nothing)
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        array.parent = cgutils.get_null_value(array.parent.type)
        return array._getvalue()
    return value
