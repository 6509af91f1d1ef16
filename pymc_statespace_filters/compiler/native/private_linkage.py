"""Machine code that is the same to the bit in the process that compiles it and in all others.

Numba leaves functions that were not pasted into their caller under their names, as weak symbols:
the first definition that a process has loaded serves all its callers. In the process that compiled
it that is one that was optimised on its own; where the code comes from disk it is one that was
optimised again beside its caller, or that of another library. Both are right, but sums and products
that may be rearranged differ in their last digits. A closed library keeps its functions to itself.
"""

from typing import Any
from uuid import uuid4

from llvmlite.binding import Linkage
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class _ClosedLibrary(JITCodeLibrary):
    """A library whose functions, but for those that were compiled for it, are its own."""

    def _optimize_final_module(self) -> None:
        own = uuid4().hex
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == Linkage.linkonce_odr:
                function.linkage = Linkage.internal
                # LLVM's loader would give even these to other libraries that ask for the name,
                # and who calls them is no matter of theirs: arguments may have been left out.
                function.name = f"{function.name}.{own}"
        super()._optimize_final_module()


class InternalLinkageCompiler(Compiler):
    """Numba's compiler, for functions that machine code calls by address."""

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
            self.state.library = _ClosedLibrary(self.state.targetctx.codegen(), "closed")
            self.state.library.enable_object_caching()


def with_internal_linkage(function: Any) -> Any:
    """Have a jitted function compiled into a closed library, if it is not compiled yet."""
    function._compiler.pipeline_class = InternalLinkageCompiler
    return function
