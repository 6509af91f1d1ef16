"""Names of places in a vector: in compiled functions each is a constant.

Where a function reads one number of a named tuple, numba builds the whole tuple: the plan's has 70
numbers, and building them was half of all the instructions that LLVM was given.
"""

from typing import Any

from numba import types
from numba.core.datamodel import models
from numba.core.imputils import lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import register_model, typeof_impl


class _Slots(types.Opaque):
    """The type of named integers, which has their values."""

    def __init__(self, slots: Any) -> None:
        super().__init__(repr(slots))
        self.slots = slots


register_model(_Slots)(models.OpaqueModel)


@infer_getattr
class _SlotsTemplate(AttributeTemplate):
    key = _Slots

    def generic_resolve(self, kind, name):
        return types.int64 if name in kind.slots._fields else None


@lower_getattr_generic(_Slots)
def _lower(context, builder, kind, value, name):
    return context.get_constant(types.int64, getattr(kind.slots, name))


def known_when_compiled[Cls: type](cls: Cls) -> Cls:
    """Make the fields of a class of named tuples of integers constants in compiled functions."""
    typeof_impl.register(cls)(lambda slots, context: _Slots(slots))
    return cls
