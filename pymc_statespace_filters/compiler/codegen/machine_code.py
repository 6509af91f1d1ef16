"""LLVM modules as machine code: linked with what they call, optimised once, kept on disk.

A module is a text. With the functions that are linked into it, the text identifies the machine
code, and so it is the key under which that is kept in PyTensor's folder.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple
from uuid import uuid4

import llvmlite.binding as llvm
from llvmlite import ir
from llvmlite.binding.newpassmanagers import NewPassManager
from numba import types
from numba.core import cgutils
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target
from pytensor import config
from pytensor.link.numba.cache import NUMBA_CACHE_PATH

from ...parallel.signals import held_interrupts
from ...progress import slow_compilation
from ..native.cache_key import key_of
from ..native.entry_point import F64_PTR, I64_PTR, EntryPoint

DOUBLE, INT, BOOL = ir.DoubleType(), ir.IntType(64), ir.IntType(1)
POINTER = DOUBLE.as_pointer()


def constant(number: int) -> ir.Constant:
    """A whole number."""
    return ir.Constant(INT, number)


_LLVM_TYPES = {
    types.float64: DOUBLE, types.int64: INT, types.intp: INT, F64_PTR: POINTER,
    I64_PTR: INT.as_pointer(),
}  # fmt: skip


class Module:
    """An LLVM module under construction, and what its functions call."""

    def __init__(self) -> None:
        self._ir = ir.Module("module")
        self._inlined: dict[str, tuple[Any, tuple]] = {}
        self._needs: dict[str, EntryPoint] = {}

    def function(self, name: str, arguments: Sequence[Any]) -> ir.Function:
        """Begin a function without result."""
        return ir.Function(self._ir, ir.FunctionType(ir.VoidType(), arguments), name)

    def main(self, arguments: Mapping[str, Any]) -> tuple[ir.IRBuilder, dict[str, ir.Value]]:
        """Begin the function of these arguments that the module is for, and name its values."""
        function = self.function("main", [_LLVM_TYPES[kind] for kind in arguments.values()])
        given = dict(zip(arguments, function.args, strict=True))
        return ir.IRBuilder(function.append_basic_block()), given

    def declared(self, name: str, arguments: Sequence[Any], result: Any) -> ir.Function:
        """A function that is defined elsewhere."""
        if name in self._ir.globals:
            return self._ir.globals[name]
        return ir.Function(self._ir, ir.FunctionType(result, arguments), name)

    def inlined(self, name: str, function: Any, arguments: Sequence[Any]) -> ir.Function:
        """A jitted function of numbers, linked into the module; its result has their type."""
        symbol = f"psf.{name}"
        self._inlined[symbol] = function, tuple(arguments)
        kinds = [_LLVM_TYPES[a] for a in arguments]
        return self.declared(symbol, kinds, kinds[0])

    def entry(self, entry: EntryPoint, arguments: Sequence[Any] = ()) -> ir.Function:
        """An entry point, known by its symbol."""
        self._needs[entry.symbol] = entry
        return self.declared(entry.symbol, arguments, ir.VoidType())

    def call(self, builder: ir.IRBuilder, entry: EntryPoint, values: Sequence[ir.Value]) -> None:
        """Call an entry point by its symbol."""
        builder.call(self.entry(entry, [value.type for value in values]), values)

    def distinct(self, names: Sequence[str]) -> dict[str, dict[str, Any]]:
        """Metadata of loads and stores at places that do not overlap."""
        add = self._ir.add_metadata
        domain = add(["places"])
        scopes = {name: add([name, domain]) for name in names}
        return {
            name: {
                "alias.scope": add([own]),
                "noalias": add([s for s in scopes.values() if s is not own]),
            }
            for name, own in scopes.items()
        }

    def finished(self) -> "Code":
        """The module as text."""
        needs = tuple(self._needs[symbol] for symbol in sorted(self._needs))
        return Code(str(self._ir), dict(sorted(self._inlined.items())), needs)


class Code(NamedTuple):
    """The text of a module, the functions that are linked into it, and what it calls by symbol."""

    text: str
    inlined: Mapping[str, tuple[Any, tuple]]
    needs: Sequence[EntryPoint]

    @property
    def key(self) -> str | None:
        """Identifies the code."""
        inlined = [function for function, _ in self.inlined.values()]
        return key_of(__name__, self.text, *inlined, *(entry.key for entry in self.needs))

    def linked(self) -> Any:
        """The module with what is linked into it, not optimised."""
        module = llvm.parse_assembly(self.text)
        module.triple, module.data_layout = _target()
        for name, (function, kinds) in self.inlined.items():
            module.link_in(llvm.parse_bitcode(_bitcode(name, function, kinds)))
        for function in module.functions:
            if function.name.startswith("psf.") and not function.is_declaration:
                function.linkage = "internal"
        return module

    def call(self, context: Any, builder: ir.IRBuilder, values: Sequence[ir.Value]) -> None:
        """Call ``main`` in code that numba compiles, and have it inlined there."""
        module = self.linked()
        main = module.get_function("main")
        main.name = f"psf_main_{self.key or uuid4().hex}"
        main.linkage = "linkonce_odr"
        main.add_function_attribute("alwaysinline")
        library = JITCodeLibrary(_codegen(), main.name)
        library._final_module, library._finalized = module, True
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in values])
        builder.call(cgutils.get_or_insert_function(builder.module, kind, main.name), values)
        context.add_linking_libs([library])


class ModuleEntryPoint(EntryPoint):
    """The one function of a module, which is named ``main``, as an entry point."""

    def __init__(self, code: Code, arguments: Mapping[str, Any], name: str):
        self.code, self._name, self._arguments = code, name, tuple(arguments.values())
        self._returns = types.void
        self.key = code.key
        self.symbol = f"psf_{name}_{self.key or uuid4().hex}"

    def compile(self) -> None:
        """Define the symbol in this process; load it from disk if it was compiled before."""
        if self.symbol in _addresses:
            return
        for needed in self.code.needs:
            needed.compile()
        with held_interrupts(), global_compiler_lock:
            # By its symbol: code of another name may be the same, as that which does nothing.
            content = kept(self.key and self.symbol, self._machine_code)
            engine = _codegen()._engine._ee
            engine.add_object_file(llvm.ObjectFileRef.from_data(content))
            engine.finalize_object()
            _addresses[self.symbol] = engine.get_function_address(self.symbol)
        llvm.add_symbol(self.symbol, self.address)

    @property
    def address(self) -> int:
        """Address of the compiled code."""
        return _addresses[self.symbol]

    def optimised(self) -> Any:
        """The module as LLVM has optimised it."""
        module = self.code.linked()
        module.get_function("main").name = self.symbol
        optimise(module)
        return module

    def _machine_code(self) -> bytes:
        with slow_compilation(self._name):
            return _codegen()._tm.emit_object(self.optimised())


_addresses: dict[str, int] = {}


def kept(key: str | None, make: Callable[[], bytes]) -> bytes:
    """What ``make`` returns, from PyTensor's folder if it was made before with this key."""
    if key is None or not config.numba__cache:
        return make()
    name = hashlib.sha256(repr((key, _codegen().magic_tuple())).encode()).hexdigest()
    path = NUMBA_CACHE_PATH / f"psf.{name}"
    try:
        content = path.read_bytes()
    except OSError:
        content = b""
    checksum, found = content[:32], content[32:]
    if hashlib.sha256(found).digest() == checksum:  # else there is no file, or a damaged one
        return found
    found = make()
    part = path.with_suffix(f".{uuid4().hex}")
    try:
        part.write_bytes(hashlib.sha256(found).digest() + found)
        part.replace(path)  # at once: other processes read it
    except OSError:  # a full disk; on Windows, another process that reads it now
        part.unlink(missing_ok=True)
    return found


@lru_cache(maxsize=256)
def _bitcode(name: str, function: Any, kinds: tuple) -> bytes:
    """A jitted function of numbers as LLVM's bitcode, by numba once in an installation."""

    def make() -> bytes:
        context = cpu_target.target_context
        function.compile(kinds)
        compiled = function.overloads[kinds]
        wrapper = ir.Module(name)
        types_of = [_LLVM_TYPES[kind] for kind in kinds]
        called = ir.Function(wrapper, ir.FunctionType(types_of[0], types_of), name)
        called.attributes.add("alwaysinline")
        builder = ir.IRBuilder(called.append_basic_block())
        callee = context.declare_function(wrapper, compiled.fndesc)
        result = compiled.signature.return_type
        _, value = context.call_conv.call_function(builder, callee, result, kinds, called.args)
        builder.ret(context.cast(builder, value, result, kinds[0]))
        module = llvm.parse_assembly(str(wrapper))
        module.triple, module.data_layout = _target()
        module.link_in(compiled.library._get_module_for_linking(), preserve=True)
        for each in module.functions:
            if not each.is_declaration and each.name != name:
                each.linkage = "internal"
        optimise(module)
        return module.as_bitcode()

    return kept(key_of(__name__, name, str(kinds), function), make)


def optimise(module: Any) -> None:
    """Optimise as numba does."""
    passes, builder = _codegen()._module_pass_manager()
    passes.run(module, builder)
    # In llvmlite 0.50 nothing else frees its half a megabyte.
    NewPassManager._dispose(passes)
    passes.detach()


def _codegen() -> Any:
    return cpu_target.target_context.codegen()


def _target() -> tuple[str, str]:
    return _codegen()._llvm_module.triple, _codegen()._data_layout
