"""Internal linkage for helper functions, so that all processes run the same machine code.

Numba emits functions that were not inlined as weak symbols, and the first definition that a process
loads serves all callers. In the process that compiled it, that definition was optimised alone; in a
process that loads it from disk, it was optimised again beside its caller, or belongs to another
library. Both are correct, but sums and products that may be reordered differ in their last digits.
With internal linkage every library calls the copies that it contains.
"""

from typing import Any
from uuid import uuid4

from llvmlite.binding import Linkage
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class _InternalLinkageLibrary(JITCodeLibrary):
    """A code library in which helper functions have internal linkage."""

    def _optimize_final_module(self) -> None:
        suffix = uuid4().hex
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == Linkage.linkonce_odr:
                function.linkage = Linkage.internal
                # LLVM's loader resolves even internal functions by name for other libraries, whose
                # calls may not match: LLVM may have removed arguments of an internal function.
                function.name = f"{function.name}.{suffix}"
        super()._optimize_final_module()


class InternalLinkageCompiler(Compiler):
    """Numba's compiler, for functions that machine code calls by address or symbol."""

    def __init__(
        self,
        typingctx: Any,
        targetctx: Any,
        library: Any,
        args: Any,
        return_type: Any,
        flags: Any,
        locals: Any,
    ):
        super().__init__(typingctx, targetctx, library, args, return_type, flags, locals)
        if library is None:
            self.state.library = _InternalLinkageLibrary(
                self.state.targetctx.codegen(), "internal_linkage"
            )
            self.state.library.enable_object_caching()


def with_internal_linkage(function: Any) -> Any:
    """Give the helper functions of a jitted function internal linkage; call before it compiles."""
    function._compiler.pipeline_class = InternalLinkageCompiler
    return function
