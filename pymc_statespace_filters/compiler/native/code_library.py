"""How compiled functions are put together: each is optimised once, and machine code made once.

A numba function is by default a library of its own. It contains all that it calls, is optimised as
a whole and becomes machine code, and so again at every level of callers. Here a function that only
compiled functions call is a `_LinkedLibrary`: it is optimised alone, where its loops vectorise, and
becomes machine code in its callers only.

An entry point is an `_InternalLinkageLibrary`, so that all processes run the same machine code.
Numba emits functions that were not inlined as weak symbols, and the first definition that a process
loads serves all callers. In the process that compiled it, that definition was optimised alone; in a
process that loads it from disk, it was optimised again beside its caller, or belongs to another
library. Both are correct, but sums and products that may be reordered differ in their last digits.
With internal linkage every library calls the copies that it contains.
"""

import ctypes
import gc
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any
from uuid import uuid4

from llvmlite.binding import Linkage
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.runtime.context import NRTContext

# Called from Python, a function without machine code is a TypeError. Its slot is called with an
# object that is not callable, the arguments and the keywords.
_NO_CODE = ctypes.cast(ctypes.pythonapi.PyObject_Call, ctypes.c_void_p).value or 0


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


class _LinkedLibrary(JITCodeLibrary):
    """The code of a function that only compiled functions call.

    ``inlined`` functions are optimised in their callers only: they end up inside loops.
    """

    inlined = False
    _with_callees: Any = None

    def _optimize_functions(self, ll_module: Any) -> None:
        """Leave it to the optimisation of the module, which does the same again."""
        ll_module.data_layout = self._codegen._data_layout

    def finalize(self) -> None:
        """Optimise the function, together with those that are inlined into it."""
        if not self.inlined:
            self._link(self._final_module, filter(_is_inlined, self._callees()))
            self._optimize_final_module()
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == Linkage.external:
                function.linkage = Linkage.linkonce_odr  # may be linked into several libraries
        self._finalize_dynamic_globals()
        self._finalized = True

    def _callees(self) -> dict[Any, None]:
        """All libraries that the function needs, in the order of linking.

        A library comes after all that call it: LLVM does not link what nothing refers to yet.
        """
        found: dict[Any, None] = {}
        for library in self._linking_libraries:
            below = library._callees() if isinstance(library, _LinkedLibrary) else {}
            for each in (library, *below):
                found.pop(each, None)
                found[each] = None
        return found

    def _link(self, module: Any, libraries: Iterable[Any]) -> None:
        for library in libraries:
            self._reload_init.update(library._reload_init)
            linked = isinstance(library, _LinkedLibrary)
            part = library._final_module if linked else library._get_module_for_linking()
            module.link_in(part, preserve=True)

    def _get_module_for_linking(self) -> Any:
        """The function with all that it calls: numba's own libraries link direct callees only."""
        if self._with_callees is None:
            self._with_callees = self._final_module.clone()
            self._link(self._with_callees, self._callees())
        return self._with_callees

    def get_pointer_to_function(self, name: str) -> int:
        """The address of what raises if Python calls the function."""
        return _NO_CODE

    @property
    def codegen(self) -> Any:
        """The code generator, as numba uses it after compilation."""
        return _NoMachineCode


class _NoMachineCode:
    @staticmethod
    def set_env(name: str, environment: Any) -> None:
        """Do nothing: the functions use no Python objects."""


def _is_inlined(library: Any) -> bool:
    return isinstance(library, _LinkedLibrary) and library.inlined


class _References(NRTContext):
    """What counts references, without instructions that take numbers out of tuples in vain.

    Of a tuple of arrays numba takes every size and every stride, and uses the owners of the memory.
    """

    def get_meminfos(self, builder: Any, ty: Any, val: Any) -> list:
        """The owners of memory in a value."""
        models = self._context.data_model_manager
        found = []
        if models[ty].has_nrt_meminfo():
            found.append((ty, models[ty].get_nrt_meminfo(builder, val)))
        for member, take in models[ty].traverse(builder):
            if models[member].contains_nrt_meminfo():
                found += self.get_meminfos(builder, member, take(val))
        return found


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Collect no garbage meanwhile: a tenth of a compilation, whose objects nearly all stay."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


class _LibraryCompiler(Compiler):
    """Numba's compiler with another kind of code library."""

    library: type[JITCodeLibrary]

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
            self.state.library = self.library(self.state.targetctx.codegen(), self.library.__name__)
            self.state.library.enable_object_caching()
        context = self.state.targetctx
        context.nrt = _References(context, context.enable_nrt)

    def compile_extra(self, func: Any) -> Any:
        """Compile a function, and what it calls."""
        with _no_garbage_collection():
            return super().compile_extra(func)


class InternalLinkageCompiler(_LibraryCompiler):
    """For functions that machine code calls by address or symbol."""

    library = _InternalLinkageLibrary


class LinkedCompiler(_LibraryCompiler):
    """For functions that only compiled functions call."""

    library = _LinkedLibrary

    def __init__(self, *arguments: Any):
        super().__init__(*arguments)
        if isinstance(self.state.library, _LinkedLibrary):
            self.state.library.inlined = self.state.flags.forceinline


def with_internal_linkage(function: Any) -> Any:
    """Give the helper functions of a jitted function internal linkage; call before it compiles."""
    function._compiler.pipeline_class = InternalLinkageCompiler
    return function
