"""Keys of compiled code on disk, from the sources that modules reach by their imports."""

import ast
import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import NamedTuple
from uuid import uuid4

import llvmlite
import numba
import pytensor
from pytensor.link.numba.cache import NUMBA_CACHE_PATH

from .outside_code import UnknownValueError, identity_of
from .shipped_code import FOLDER

# Numba's own index on disk tells processors and versions of Python apart.
_COMPILERS = (numba.__version__, llvmlite.__version__, pytensor.__version__)
_THIS = Path(__file__)


class _File(NamedTuple):
    content: bytes
    package: str  # to which its relative imports refer


class _Source(NamedTuple):
    content: str  # digest of the file
    code: str  # digest of its code, without comments and docstrings
    imports: tuple[str, ...]  # dotted names, of modules or of names in modules


class Sources:
    """The sources of a package, all read at the first question.

    ``import`` statements are followed wherever they stand, inside functions too, but for those
    below ``if TYPE_CHECKING``. The ``__init__`` of a package counts only where a name is imported
    from it.

    It takes a second to parse all files. A file in ``folder`` therefore keeps what was found in
    them, for other processes that read the same contents in the same way: the name of the file
    follows from the text of this module. A wheel with machine code has such a file, too.
    """

    def __init__(self, package: Path, folder: Path):
        self._package = package
        # A tree of statements is written differently by different versions of Python.
        version = f"{sys.implementation.cache_tag}.{_digest(_THIS.read_bytes())[:16]}"
        self._kept = folder / f"{package.name}.{version}.json"
        self._sources: dict[str, _Source] = {}
        self._digests: dict[str, str] = {}

    def __contains__(self, module: str) -> bool:
        return module in self._files

    def digest_of(self, module: str) -> str:
        """Digest of the code of a module and of all modules of the package that it reaches."""
        if module not in self._digests:
            reached, pending = {module}, [module]
            while pending:
                imports = self._source(pending.pop()).imports
                found = {self._module_of(name) for name in imports} - reached
                reached |= found
                pending += found
            self._keep()
            # Names count: machine code is loaded through the module that it was compiled in.
            code = [(name, self._sources[name].code) for name in sorted(reached)]
            self._digests[module] = _digest(repr(code).encode())
        return self._digests[module]

    @cached_property
    def _files(self) -> dict[str, _File]:
        """The files by module. Later they may be those of another version than is running."""
        files = {}
        for path in self._package.rglob("*.py"):
            parts = path.relative_to(self._package.parent).with_suffix("").parts
            name, package = ".".join(parts), ".".join(parts[:-1])
            files[package if path.name == "__init__.py" else name] = _File(
                path.read_bytes(), package
            )
        return files

    @cached_property
    def _known(self) -> dict[str, _Source]:
        """What earlier processes kept, or the process that made the machine code of a wheel."""
        known: dict[str, _Source] = {}
        for file in (self._package / FOLDER.name / self._kept.name, self._kept):
            # There is no file, or a damaged one.
            with suppress(OSError, ValueError, TypeError, AttributeError):
                kept = json.loads(file.read_text(encoding="utf-8"))
                known |= {name: _Source(a, b, tuple(of)) for name, (a, b, of) in kept.items()}
        return known

    def _keep(self) -> None:
        if self._sources.items() <= self._known.items():
            return
        self._known |= self._sources
        own = self._kept.with_suffix(f".{uuid4().hex}")
        with suppress(OSError):  # the folder is read-only, or on Windows another process reads
            own.write_text(json.dumps(self._known), encoding="utf-8")
            os.replace(own, self._kept)

    def _source(self, module: str) -> _Source:
        if module not in self._sources:
            file = self._files[module]
            source = self._known.get(module)
            if source is None or source.content != _digest(file.content):
                source = self._parsed(file)
            self._sources[module] = source
        return self._sources[module]

    def _parsed(self, file: _File) -> _Source:
        tree = ast.parse(file.content)
        tree.body = [statement for statement in tree.body if not _is_for_types(statement)]
        imports = {name for node in ast.walk(tree) for name in _imported(node, file.package)}
        own = sorted(name for name in imports if name.partition(".")[0] == self._package.name)
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                node.body = [statement for statement in node.body if not _is_text(statement)]
        return _Source(_digest(file.content), _digest(ast.dump(tree).encode()), tuple(own))

    def _module_of(self, name: str) -> str:
        """The module that an imported name is, or is in."""
        while name not in self._files:
            name = name.rpartition(".")[0]
        return name


def _imported(node: ast.AST, package: str) -> Iterator[str]:
    """The dotted names that a statement imports."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        above = package.rsplit(".", node.level - 1)[0] if node.level else None
        origin = ".".join(name for name in (above, node.module) if name)
        yield from (f"{origin}.{alias.name}" for alias in node.names)


def _is_for_types(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.If) and ast.unparse(statement.test) == "TYPE_CHECKING"


def _is_text(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


_SOURCES = Sources(_THIS.parents[2], NUMBA_CACHE_PATH)


def key_of(module: str, *parts: str | Callable | None) -> str | None:
    """The key of machine code that a module makes; None if it cannot be cached on disk.

    It covers the compilers and the sources of all modules of this package that the module reaches
    by its imports. Other modules have no key, but their functions have, see `outside_code`.

    ``module`` is its ``__name__``. The ``parts`` are what else identifies the code: texts, the keys
    of code that it calls (None where that cannot be cached), and functions, which are covered as
    the module is, or by themselves.
    """
    if module not in _SOURCES:
        return None
    keys = [_key_of_function(part) if callable(part) else part for part in parts]
    if None in keys:
        return None
    return _digest(repr((_COMPILERS, _SOURCES.digest_of(module), keys)).encode())


def is_outside(function: Callable) -> bool:
    """Whether a function is of a user's file, not of this package."""
    return function.__module__ not in _SOURCES


def _key_of_function(function: Callable) -> str | None:
    if not is_outside(function):
        return key_of(function.__module__, function.__qualname__)
    try:
        return _digest(repr(identity_of(function, _known)).encode())
    except UnknownValueError:
        return None


def _known(function: Callable) -> str | None:
    return None if is_outside(function) else key_of(function.__module__, function.__qualname__)
